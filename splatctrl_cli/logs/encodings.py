"""The pixel encodings of sensor_msgs/Image (sensor_msgs/image_encodings.hpp), how each becomes RGB, and RVL."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.logs.decoder import UndecodableMessageError
from splatctrl_cli.records import UInt8

DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
BAYER = {  # OpenCV names a pattern by the second row's second and third pixel
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}
BAYER_16 = {f"{name[:-1]}16": code for name, code in BAYER.items()}
_DEEP = {  # sixteen bits a channel
    "rgb16": None,
    "bgr16": cv2.COLOR_BGR2RGB,
    "16UC3": cv2.COLOR_BGR2RGB,
    "rgba16": cv2.COLOR_RGBA2RGB,
    "bgra16": cv2.COLOR_BGRA2RGB,
    "16UC4": cv2.COLOR_BGRA2RGB,
    **BAYER_16,
}
_NV24 = "nv24"  # a plane of Y, then as many pairs of U and V
_PLANAR = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}  # rows of Y, then half as many of UV
COLOR_CONVERSIONS = {
    "rgb8": None,
    "8UC3": cv2.COLOR_BGR2RGB,  # OpenCV's order
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "8UC4": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
    **BAYER,
    **_DEEP,
    **dict.fromkeys([*_PLANAR, _NV24]),  # converted as they are read
}
_LAYOUT = {  # channels and dtype by encoding
    **dict.fromkeys(["rgb8", "bgr8", "8UC3"], (3, "u1")),
    **dict.fromkeys(["rgba8", "bgra8", "8UC4"], (4, "u1")),
    **dict.fromkeys(["mono8", "8UC1", *BAYER, *_PLANAR, _NV24], (1, "u1")),
    **dict.fromkeys(["rgb16", "bgr16", "16UC3"], (3, "u2")),
    **dict.fromkeys(["rgba16", "bgra16", "16UC4"], (4, "u2")),
    **dict.fromkeys(BAYER_16, (1, "u2")),
    **dict.fromkeys(["yuv422", "uyvy", "yuv422_yuy2", "yuyv"], (2, "u1")),
    **dict.fromkeys(["16UC1", "mono16"], (1, "u2")),
    "32FC1": (1, "f4"),
}


def to_rgb(pixels: NDArray[Any], encoding: str) -> UInt8:
    """Colour (H, W, 3) uint8 of pixels as `raw_pixels` gives them; a Bayer mosaic is interpolated linearly.

    Of sixteen bits, 65535 becomes 255, as in cv_bridge (src/cv_bridge.cpp), whatever the sensor's own depth.
    """
    code = COLOR_CONVERSIONS[encoding]
    converted = pixels if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code)
    if converted.dtype == np.uint16:
        converted = (converted.astype(np.uint32) + 128) // 257
    return np.ascontiguousarray(converted, dtype=np.uint8)


def raw_pixels(message: Any) -> NDArray[Any]:
    """The pixels (H, W[, channels]) of a decoded sensor_msgs/Image, of no channel where the encoding is not known.

    Bytes between rows and behind the last are passed over, in either byte order. Raises UndecodableMessageError where
    the data do not hold the image.
    """
    width, height, step = int(message.width), int(message.height), int(message.step)
    name = f"image {width}x{height} {message.encoding}"
    if message.encoding not in _LAYOUT and width * height > 1 << 31:
        raise UndecodableMessageError(f"{name}: too large for an image")
    if message.encoding not in _LAYOUT:
        return np.zeros((height, width, 0), dtype=np.uint8)  # kind "other": described, never used
    if message.encoding == _NV24:
        return _nv24(message, name)
    channels, code = _LAYOUT[message.encoding]
    is_planar = message.encoding in _PLANAR
    if is_planar and (width % 2 or height % 2):
        raise UndecodableMessageError(f"{name}: expected even sizes")
    num_rows = height * 3 // 2 if is_planar else height
    dtype = np.dtype((">" if message.is_bigendian else "<") + code)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if width == 0 or height == 0 or step < row or data.size < step * (num_rows - 1) + row:
        raise UndecodableMessageError(f"{name}: {data.size} bytes with a row step of {step} do not hold it")
    step = row if num_rows == 1 else step  # a single row may announce any step: nothing follows it
    padded = np.zeros(step * num_rows, dtype=np.uint8)
    padded[: min(data.size, padded.size)] = data[: padded.size]
    rows = np.ascontiguousarray(padded.reshape(num_rows, step)[:, :row])
    if is_planar:
        return np.asarray(cv2.cvtColor(rows, _PLANAR[message.encoding]))
    pixels = rows.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return pixels.reshape(height, width) if channels == 1 else pixels.reshape(height, width, channels)


def _nv24(message: Any, name: str) -> UInt8:
    """RGB (H, W, 3); BT.601 of limited range, as OpenCV takes nv12."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if not 0 < width * height * 3 == data.size or step not in {width, 2 * width, 3 * width}:
        raise UndecodableMessageError(f"{name}: {data.size} bytes with a row step of {step} do not hold it")
    y = data[: width * height].reshape(height, width).astype(np.float32)
    u, v = np.moveaxis(data[width * height :].reshape(height, width, 2).astype(np.float32) - 128.0, 2, 0)
    luma = 1.164 * (y - 16.0)
    rgb = np.stack([luma + 1.596 * v, luma - 0.813 * v - 0.391 * u, luma + 2.018 * u], axis=2)
    return np.asarray(np.clip(np.rint(rgb), 0, 255), dtype=np.uint8)


def decode_rvl(data: bytes, num_pixels: int) -> NDArray[np.uint16]:
    """The pixels (num_pixels,) of an RVL stream of little-endian words, of compressed_depth_image_transport.

    A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017 (its listing is the definition): the image is runs
    of zeros and of values in turn, each value the zigzag-coded difference to the last one that was not zero; every
    number is written in groups of three bits, low ones first, in four-bit nibbles whose high bit says that another
    follows; nibbles fill 32-bit words from the top.

    Raises ValueError where it holds no such image. Memory is that of the image and a few times that of `data`.
    """
    numbers = _numbers(data)
    runs: list[tuple[int, int, int]] = []  # first pixel, first number, length
    pixel = position = 0
    while pixel < num_pixels:
        if position + 1 >= len(numbers):
            raise ValueError(f"RVL: {len(data)} bytes end after {pixel} of {num_pixels} pixels")
        zeros, values = int(numbers[position]), int(numbers[position + 1])
        pixel += zeros
        runs.append((pixel, position + 2, values))
        pixel, position = pixel + values, position + 2 + values
        if pixel > num_pixels or position > len(numbers) or zeros + values == 0:
            raise ValueError(f"RVL: runs of {len(data)} bytes do not fit {num_pixels} pixels")
    image = np.zeros(num_pixels, dtype=np.uint16)
    coded = np.concatenate([numbers[first : first + length] for _, first, length in runs] or [numbers[:0]])
    depth = np.cumsum((coded >> 1) ^ -(coded & 1))
    if depth.size and not (depth.min() >= 0 and depth.max() <= 65535):
        raise ValueError("RVL: values outside 0 to 65535")
    start = 0
    for first_pixel, _, length in runs:
        image[first_pixel : first_pixel + length] = depth[start : start + length]
        start += length
    return image


def _numbers(data: bytes) -> NDArray[np.int64]:
    """All numbers of a stream, those of the filling at its end too."""
    words = np.frombuffer(data, dtype="<u4", count=len(data) // 4)
    nibbles = ((words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)) & 15).astype(np.int64).ravel()
    ends = np.flatnonzero(nibbles < 8)
    if not ends.size:
        return np.zeros(0, dtype=np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    if place.max() > 10:  # a number of more than 33 bits
        raise ValueError("RVL: a number of more than 33 bits")
    result: NDArray[np.int64] = np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << (3 * place), starts)
    return result

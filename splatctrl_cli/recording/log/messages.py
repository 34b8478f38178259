"""Decoders of sensor_msgs images: colour (H, W, 3) uint8 RGB, depth (H, W) float32 [m].

The encodings follow sensor_msgs/image_encodings.hpp. A topic's name tells 16-bit infrared from depth: /ir (Azure
Kinect, Orbbec), /infra1 (RealSense), image_ir (Kinect 2), confidence (ZED, L515), amplitude and noise (time of
flight), aux (MultiSense), signal, reflec and nearir (Ouster).
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import refuse_faults, refuse_if, require
from splatctrl_cli.formats.image_file import JPEG, PNG, decode_file, image_head
from splatctrl_cli.recording.log.decoder import IMAGE, UndecodableMessageError, UnreadFormError, stamp_ns
from splatctrl_cli.records import MILLIMETRE, Float32, UInt8

GRAY = frozenset({"mono8", "8UC1"})  # colour images of one channel
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
    "YUYV": cv2.COLOR_YUV2RGB_YUY2,  # as the RealSense SDK writes it
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
    **dict.fromkeys(["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "YUYV"], (2, "u1")),
    **dict.fromkeys(["16UC1", "mono16"], (1, "u2")),
    "32FC1": (1, "f4"),
}
NO_RETURN = 65535  # counts by which a camera of 16 bits says that it measured nothing
NO_RETURN_M = np.float32(65.535)  # the same as metres
FARTHEST = np.float32(1e5)  # units, metres or millimetres: a float depth of this or more is no return
_DEPTH_HEAD = 12  # bytes of compressed_depth_image_transport before its image
_FILES = (JPEG, PNG, b"RIFF", b"II*\0", b"MM\0*", b"BM")  # how files begin that should decode
_MOSAICS = frozenset({*BAYER, *BAYER_16})
_MOST_PIXELS = 1 << 26  # of an image whose code can say it in a few bytes


@dataclass(frozen=True, kw_only=True)
class ImageMessage:
    """An image as recorded; `pixels` decodes it at first use.

    width, height [px]. decode: returns pixels (H, W[, channels]) in `encoding`, or raises UndecodableMessageError.
    compressed: JPEG or PNG bytes of `pixels`, if any. remark: a deviation from the format.
    """

    stamp_ns: int
    frame_id: str
    encoding: str
    width: int
    height: int
    decode: Callable[[], NDArray[Any]]
    compressed: bytes | None = None
    remark: str = ""

    @cached_property
    def pixels(self) -> NDArray[Any]:
        return self.decode()

    @property
    def is_counts(self) -> bool:
        return self.encoding != "32FC1"

    @property
    def kind(self) -> str:
        """``color``, ``depth`` or ``other``."""
        if self.encoding in DEPTH_ENCODINGS:
            return "depth"
        return "color" if self.encoding in COLOR_CONVERSIONS else "other"

    def unit(self, scale: float | None) -> float:
        """Metres per unit: `scale`, else 1 mm for counts, 1 m for floats (REP 118)."""
        return scale if scale is not None else MILLIMETRE if self.is_counts else 1.0


def read_image(message: Any, type_name: str, *, lazily: bool = False) -> ImageMessage:
    """Read a decoded sensor_msgs/Image or CompressedImage. Raises UndecodableMessageError.

    lazily: a plain JPEG or PNG stays undecoded; only its markers and checksums are checked.
    """
    if type_name == IMAGE:
        pixels = raw_pixels(message)
        return _image(message, message.encoding, pixels.shape, lambda: pixels, None)
    packed = _packed(message.format, bytes(message.data))
    if lazily and (plain := _plain(packed)) is not None:
        encoding, size, color = plain
        return _image(message, encoding, size, partial(_decode, packed, color=color), packed.file)
    pixels, encoding, compressed = _compressed_depth(packed) if packed.is_depth else _compressed_pixels(packed)
    return _image(message, encoding, pixels.shape, lambda: pixels, compressed, packed.remark)


def _image(
    message: Any,
    encoding: str,
    size: tuple[int, ...],
    decode: Callable[[], NDArray[Any]],
    compressed: bytes | None,
    remark: str = "",
) -> ImageMessage:
    return ImageMessage(
        stamp_ns=stamp_ns(message.header),
        frame_id=message.header.frame_id.strip("/"),
        encoding=encoding,
        height=int(size[0]),
        width=int(size[1]),
        decode=decode,
        compressed=compressed,
        remark=remark,
    )


class _Packed(NamedTuple):
    """An image file, and compressedDepth's bytes before it."""

    form: str
    file: bytes
    is_depth: bool = False
    head: bytes = b""
    remark: str = ""

    @property
    def recorded(self) -> str:
        return self.form.partition(";")[0].strip()

    @property
    def is_rvl(self) -> bool:
        return "rvl" in self.form.lower()


def _packed(form: str, data: bytes) -> _Packed:
    """Find the image file by its first bytes, as publishers misuse `format`.

    Raises UnreadFormError for depth in a JPEG, and for RVL under another name.
    """
    says_depth, head, file = "compressedDepth" in form, data[:_DEPTH_HEAD], data[_DEPTH_HEAD:]
    plain, behind = _Packed(form, data), _Packed(form, file, True, head)
    if plain.recorded in DEPTH_ENCODINGS or says_depth:
        refuse_if(
            data.startswith(JPEG) or (says_depth and file.startswith(JPEG)),
            f"depth in a JPEG ({form}): JPEG loses depth: record PNG",
            error=UnreadFormError,
        )
        refuse_if(
            plain.is_rvl and not says_depth,
            f"RVL under the format {form!r}: expected {plain.recorded}; compressedDepth rvl",
            error=UnreadFormError,
        )
    if says_depth and data.startswith(PNG):
        refuse_if(
            plain.recorded == "32FC1",
            f"compressed depth ({form}): 32FC1 without the 12 bytes that say what a count is",
            error=UnreadFormError,
        )
        return _Packed(form, data, True, remark=f"compressed depth ({form}): its PNG begins at byte 0, not 12")
    refuse_if(
        says_depth and not plain.is_rvl and not file.startswith(PNG) and _is_rvl(file),
        f"RVL under the format {form!r}: expected {plain.recorded}; compressedDepth rvl",
        error=UnreadFormError,
    )
    if not says_depth and file.startswith(PNG):
        return behind._replace(remark=f"compressed image ({form}): a PNG behind 12 bytes, read as compressedDepth")
    return behind if says_depth else plain


def _is_rvl(file: bytes) -> bool:
    try:
        return bool(_rvl_counts(file).any())
    except UndecodableMessageError:
        return False


def _plain(packed: _Packed) -> tuple[str, tuple[int, int], bool] | None:
    """Encoding, (height, width) and is_color; None if only decoding shows them."""
    is_depth = packed.is_depth
    if is_depth and (packed.is_rvl or packed.recorded == "32FC1"):
        return None
    head = image_head(packed.file)
    if head is None or (is_depth and head.channels != 1) or packed.recorded in _MOSAICS:
        return None
    size = (head.height, head.width)
    if is_depth or (head.channels, head.bits) == (1, 16):
        return ("16UC1", size, False) if head.bits == 16 else None
    return ("mono8" if head.channels == 1 else "rgb8", size, head.channels != 1)


def _decode(packed: _Packed, *, color: bool) -> NDArray[Any]:
    what = f"compressed image ({packed.form}): {len(packed.file)} bytes that are not an image file"
    error = UndecodableMessageError if packed.file.startswith(_FILES) else UnreadFormError
    return require(decode_file(packed.file, color=color), what, error=error)


def to_rgb(pixels: NDArray[Any], encoding: str) -> UInt8:
    """Convert `raw_pixels` to colour (H, W, 3) uint8; Bayer mosaics are interpolated linearly.

    In 16-bit channels, 65535 becomes 255, as in cv_bridge (src/cv_bridge.cpp).
    """
    code = COLOR_CONVERSIONS[encoding]
    converted = pixels if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code)
    if converted.dtype == np.uint16:
        converted = (converted.astype(np.uint32) + 128) // 257
    return np.ascontiguousarray(converted, dtype=np.uint8)


def raw_pixels(message: Any) -> NDArray[Any]:
    """Pixels (H, W[, channels]) of a sensor_msgs/Image; zero channels for an unknown encoding.

    Skips row padding; reads either byte order. Raises UndecodableMessageError for too few data or a wrong size.
    """
    width, height, step = int(message.width), int(message.height), int(message.step)
    name = f"image {width}x{height} {message.encoding}"
    refuse_if(
        message.encoding not in _LAYOUT and width * height > 1 << 31,
        f"{name}: too large for an image",
        error=UndecodableMessageError,
    )
    if message.encoding not in _LAYOUT:
        return np.zeros((height, width, 0), dtype=np.uint8)  # kind "other": described, never used
    if message.encoding == _NV24:
        return _nv24(message, name)
    channels, code = _LAYOUT[message.encoding]
    is_planar = message.encoding in _PLANAR
    refuse_if(is_planar and (width % 2 or height % 2), f"{name}: expected even sizes", error=UndecodableMessageError)
    num_rows = height * 3 // 2 if is_planar else height
    dtype = np.dtype((">" if message.is_bigendian else "<") + code)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    refuse_if(
        width == 0 or height == 0 or step < row or data.size < step * (num_rows - 1) + row,
        f"{name}: {data.size} bytes with a row step of {step} do not hold it",
        error=UndecodableMessageError,
    )
    step = row if num_rows == 1 else step  # a single row may announce any step: nothing follows it
    padded = np.zeros(step * num_rows, dtype=np.uint8)
    padded[: min(data.size, padded.size)] = data[: padded.size]
    rows = np.ascontiguousarray(padded.reshape(num_rows, step)[:, :row])
    if is_planar:
        return np.asarray(cv2.cvtColor(rows, _PLANAR[message.encoding]))
    pixels = rows.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return pixels.reshape(height, width) if channels == 1 else pixels.reshape(height, width, channels)


def _nv24(message: Any, name: str) -> UInt8:
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    refuse_if(
        not 0 < width * height * 3 == data.size or step not in {width, 2 * width, 3 * width},
        f"{name}: {data.size} bytes with a row step of {step} do not hold it",
        error=UndecodableMessageError,
    )
    y = data[: width * height].reshape(height, width).astype(np.float32)
    u, v = np.moveaxis(data[width * height :].reshape(height, width, 2).astype(np.float32) - 128.0, 2, 0)
    luma = 1.164 * (y - 16.0)
    rgb = np.stack([luma + 1.596 * v, luma - 0.813 * v - 0.391 * u, luma + 2.018 * u], axis=2)
    return np.asarray(np.clip(np.rint(rgb), 0, 255), dtype=np.uint8)


def color_of(image: ImageMessage) -> UInt8:
    return to_rgb(image.pixels, image.encoding)


def depth_of(image: ImageMessage, scale: float | None) -> Float32:
    """Depth (H, W) float32 [m], 0 = no return; `scale` as for `ImageMessage.unit`."""
    return (metres if image.is_counts else convert_floats)(image.pixels, image.unit(scale))


def num_invalid(depth: NDArray[Any]) -> int:
    """Count depths (H, W) that are negative, NaN, a no-return code, or beyond `FARTHEST`."""
    is_invalid = depth == NO_RETURN
    if depth.dtype.kind != "u":
        is_invalid |= ~(depth >= 0) | (np.abs(depth - NO_RETURN_M) < 1e-4) | (depth >= FARTHEST)
    return int(is_invalid.sum())


def convert_floats(depth: NDArray[Any], scale: float) -> Float32:
    """Convert float depth (H, W) to float32 [m]; 0 = no return.

    No return: 0, negative or non-finite (REP 118), 65535, 65.535 (65535 mm), or from `FARTHEST` on.
    """
    is_code = (depth == NO_RETURN) | (np.abs(depth - NO_RETURN_M) < 1e-4)
    return np.where((depth > 0) & (depth < FARTHEST) & ~is_code, depth * np.float32(scale), 0).astype(np.float32)


def metres(counts: NDArray[Any], scale: float) -> Float32:
    """Convert depth counts (H, W) to float32 [m], 0 at `NO_RETURN`."""
    depth = counts.astype(np.float32)
    depth[counts == NO_RETURN] = 0.0
    depth *= np.float32(scale)
    return depth


def _compressed_pixels(packed: _Packed) -> tuple[NDArray[Any], str, bytes | None]:
    form, data, recorded = packed.form, packed.file, packed.recorded
    if data.startswith(JPEG) and (head := image_head(data)) is not None and head.channels == 3:
        return _decode(packed, color=True), "rgb8", data
    pixels = _decode(packed, color=False)
    if pixels.ndim == 2 and recorded in _MOSAICS and pixels.dtype == (np.uint8 if recorded in BAYER else np.uint16):
        return pixels, recorded, None  # a mosaic in a file: its bytes are not a colour image
    if pixels.ndim == 2 and pixels.dtype == np.uint16:
        return pixels, "16UC1", data
    if pixels.ndim == 2 and pixels.dtype == np.float32:  # TIFF, as compressed_image_transport stores 32FC1
        return pixels, "32FC1", None
    if pixels.ndim == 3 and (pixels.dtype != np.uint8 or pixels.shape[2] != 3):
        return _decode(packed, color=True), "rgb8", data
    refuse_if(
        pixels.dtype != np.uint8,
        f"compressed image ({form}): pixels of {pixels.dtype}, neither colour nor depth",
        error=UndecodableMessageError,
    )
    return pixels, "mono8" if pixels.ndim == 2 else "bgr8", data


def _compressed_depth(packed: _Packed) -> tuple[NDArray[Any], str, bytes | None]:
    """Decode compressed_depth_image_transport (its codec.cpp and rvl_codec.cpp).

    After 12 bytes (int32, float32 A and B) comes a PNG, or width and height (int32) and RVL. 32FC1 depth is A /
    (count - B).
    """
    counts = _rvl_counts(packed.file) if packed.is_rvl else decode_file(packed.file, color=False)
    if counts is None or counts.ndim != 2:
        what = f"compressed depth ({packed.form}): {len(packed.file)} bytes that hold no depth image"
        is_cut = packed.file.startswith(_FILES) and counts is None
        raise (UndecodableMessageError if is_cut else UnreadFormError)(what)
    if packed.recorded != "32FC1":
        return counts, "16UC1", None if packed.is_rvl or counts.dtype != np.uint16 else packed.file
    _, a, b = struct.unpack("<iff", packed.head)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(counts > 0, a / (counts.astype(np.float64) - b), 0.0)
    return depth.astype(np.float32), "32FC1", None


def _rvl_counts(data: bytes) -> NDArray[np.uint16]:
    with refuse_faults("compressed depth", ValueError, struct.error, error=UndecodableMessageError):
        width, height = struct.unpack_from("<ii", data)
        refuse_if(
            not (width > 0 and height > 0 and width * height <= _MOST_PIXELS),
            f"RVL: an image of {width}x{height}",
            error=ValueError,
        )
        return decode_rvl(data[8:], width * height).reshape(height, width)


def decode_rvl(data: bytes, num_pixels: int) -> NDArray[np.uint16]:
    """Decode an RVL stream of little-endian words to pixels (num_pixels,).

    A. D. Wilson, ISS 2017 (RVL). Runs of zeros and of values alternate. A value is the zigzag-coded difference from
    the last nonzero pixel. Numbers are stored in nibbles: three bits each, lowest first, and a high bit if another
    follows. Nibbles fill 32-bit words from the top. Raises ValueError if invalid.
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
    refuse_if(
        depth.size and not (depth.min() >= 0 and depth.max() <= 65535),
        "RVL: values outside 0 to 65535",
        error=ValueError,
    )
    start = 0
    for first_pixel, _, length in runs:
        image[first_pixel : first_pixel + length] = depth[start : start + length]
        start += length
    return image


def _numbers(data: bytes) -> NDArray[np.int64]:
    words = np.frombuffer(data, dtype="<u4", count=len(data) // 4)
    nibbles = ((words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)) & 15).astype(np.int64).ravel()
    ends = np.flatnonzero(nibbles < 8)
    if not ends.size:
        return np.zeros(0, dtype=np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    refuse_if(place.max() > 10, "RVL: a number of more than 33 bits", error=ValueError)
    return np.asarray(np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << (3 * place), starts), dtype=np.int64)


DEPTH = "depth"
_COLORS = frozenset({"color", "colour", "rgb", "bgr"})
OTHERS = frozenset(
    {
        *("ir", "infra", "infrared", "nir", "nearir", "swir", "lwir", "thermal", "aux", "mono", "gray", "grey"),
        *(
            "amplitude",
            "amplitudes",
            "amp",
            "intensity",
            "intensities",
            "reflectivity",
            "reflec",
            "signal",
            "ambient",
        ),
        *("confidence", "conf", "uncertainty", "variance", "noise", "disparity", "disparities"),
        *("mask", "label", "labels", "segmentation", "semantic", "instance"),
    }
)
_WORDS = OTHERS | _COLORS | {DEPTH}
_CAMERAS = frozenset({"camera", "cam"})  # words of parts that name a device, which may give more than depth


def word_of(parts: tuple[str, ...], *, is_device: bool = True) -> str:
    """Image kind, such as "depth" or "infra", that a topic names; "" if none.

    The last part with a kind counts; of ``a_to_b``, only ``a``. is_device: parts such as ``depth_camera`` count too.
    """
    for part in reversed(parts):
        words = re.findall("[a-z]+", part.lower())
        words = words[: words.index("to")] if "to" in words[1:] else words
        matches = [word for word in words if word in _WORDS or word.removesuffix("map") == DEPTH]
        if matches and (is_device or _CAMERAS.isdisjoint(words)):
            return DEPTH if matches[-1].startswith(DEPTH) else matches[-1]
    return ""

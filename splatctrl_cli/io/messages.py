"""Images of sensor_msgs messages as arrays: colour (H, W, 3) uint8 RGB, depth (H, W) float32 [m]."""

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.io.decoder import IMAGE, UndecodableMessageError, stamp_ns
from splatctrl_cli.io.encodings import BAYER, COLOR_CONVERSIONS, DEPTH_ENCODINGS, raw_pixels, to_rgb
from splatctrl_cli.io.rvl import decode_rvl
from splatctrl_cli.records import Float32, UInt8

__all__ = [
    "COLOR_CONVERSIONS",
    "DEPTH_ENCODINGS",
    "ImageMessage",
    "color_of",
    "decode_file",
    "depth_of",
    "read_image",
]

MILLIMETRE = 1e-3  # what 16UC1 and mono16 depth counts (REP 118)
_CLOSING_MARKS = ((b"\xff\xd8\xff", b"\xff\xd9"), (b"\x89PNG", b"IEND"))
_MOST_PIXELS = 1 << 26  # of an image whose code can say it in a few bytes
_TAIL = 64  # bytes in which the closing mark of a file stands; some encoders pad


@dataclass(frozen=True, kw_only=True)
class ImageMessage:
    """An image as recorded.

    pixels (H, W[, channels]) in `encoding`; compressed is the image file's bytes where the message held one
    (JPEG, PNG), which decode to `pixels` in OpenCV's BGR order.
    """

    stamp_ns: int
    frame_id: str
    encoding: str
    pixels: NDArray[Any]
    compressed: bytes | None = None

    @property
    def width(self) -> int:
        """Columns [px]."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Rows [px]."""
        return int(self.pixels.shape[0])

    @property
    def kind(self) -> str:
        """``color``, ``depth`` or ``other``."""
        if self.encoding in DEPTH_ENCODINGS:
            return "depth"
        return "color" if self.encoding in COLOR_CONVERSIONS else "other"

    @property
    def is_gray(self) -> bool:
        """Whether a colour image has one channel only."""
        return self.encoding in {"mono8", "8UC1"}


def read_image(message: Any, type_name: str) -> ImageMessage:
    """The image of a decoded sensor_msgs/Image or CompressedImage. Raises UndecodableMessageError."""
    if type_name == IMAGE:
        pixels, encoding, compressed = raw_pixels(message), message.encoding, None
    else:
        pixels, encoding, compressed = _compressed_pixels(message.format, bytes(message.data))
    return ImageMessage(
        stamp_ns=stamp_ns(message.header),
        frame_id=message.header.frame_id.strip("/"),
        encoding=encoding,
        pixels=pixels,
        compressed=compressed,
    )


def color_of(image: ImageMessage) -> UInt8:
    """Colour (H, W, 3) uint8 RGB."""
    return to_rgb(image.pixels, image.encoding)


def depth_of(image: ImageMessage, scale: float | None) -> Float32:
    """Depth (H, W) float32 [m]; 0, negative and non-finite values (REP 118: no measurement) become 0 = none.

    `scale` [m per count]: default 1 mm for integers, 1 for floats.
    """
    if image.pixels.dtype.kind == "u":
        return metres(image.pixels, MILLIMETRE if scale is None else scale)
    values = image.pixels * np.float32(1.0 if scale is None else scale)
    return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)


def num_invalid(depth: NDArray[Any]) -> int:
    """Pixels of a depth image (H, W) as recorded that are NaN, infinite or negative: what no camera measured."""
    return 0 if depth.dtype.kind == "u" else int((~np.isfinite(depth) | (depth < 0)).sum())


def metres(counts: NDArray[Any], scale: float) -> Float32:
    """Integer depth counts (H, W) as float32 [m]; the one formula, so that re-reading gives the same bits."""
    return counts.astype(np.float32) * np.float32(scale)


def decode_file(data: bytes, *, color: bool) -> NDArray[Any] | None:
    """Pixels of a JPEG, PNG, WebP, ... file as OpenCV reads it (BGR), its orientation tag ignored.

    None if it is none, or was cut: OpenCV would fill the missing rows of a JPEG with grey.
    """
    if any(data.startswith(start) and end not in data[-_TAIL:] for start, end in _CLOSING_MARKS):
        return None
    if data[:4] == b"RIFF" and len(data) < 8 + int.from_bytes(data[4:8], "little"):  # a WebP, and its length
        return None
    flags = cv2.IMREAD_COLOR if color else cv2.IMREAD_UNCHANGED
    buffer = np.frombuffer(data, dtype=np.uint8)
    if buffer.size == 0:
        return None
    try:
        pixels = cv2.imdecode(buffer, flags | cv2.IMREAD_IGNORE_ORIENTATION if color else flags)
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(pixels)


def _compressed_pixels(form: str, data: bytes) -> tuple[NDArray[Any], str, bytes | None]:
    if "compressedDepth" in form:
        return _compressed_depth(form, data)
    pixels = decode_file(data, color=False)
    if pixels is None:
        raise UndecodableMessageError(f"compressed image ({form}): {len(data)} bytes that are no image file")
    if pixels.ndim == 2 and pixels.dtype == np.uint16:
        return pixels, "16UC1", data
    color = decode_file(data, color=pixels.ndim != 2)
    assert color is not None
    recorded = form.partition(";")[0].strip()
    if color.ndim == 2 and recorded in BAYER:
        return color, recorded, None  # a mosaic in a file: its bytes are no colour image
    return color, "mono8" if color.ndim == 2 else "bgr8", data


def _compressed_depth(form: str, data: bytes) -> tuple[NDArray[Any], str, None]:
    """compressed_depth_image_transport: 12 bytes (int32, two float32 A, B), then a PNG or the sizes (two int32) and
    RVL; 32FC1 is A / (count - B) (its codec.cpp and rvl_codec.cpp).
    """
    counts = _rvl_counts(data[12:]) if "rvl" in form.lower() else decode_file(data[12:], color=False)
    if counts is None or counts.ndim != 2:
        raise UndecodableMessageError(f"compressed depth ({form}): {len(data)} bytes that hold no depth image")
    if not form.strip().startswith("32FC1"):
        return counts, "16UC1", None
    _, a, b = struct.unpack_from("<iff", data)
    with np.errstate(divide="ignore"):
        depth = np.where(counts > 0, a / (counts.astype(np.float64) - b), 0.0)
    return depth.astype(np.float32), "32FC1", None


def _rvl_counts(data: bytes) -> NDArray[np.uint16]:
    try:
        width, height = struct.unpack_from("<ii", data)
        if not (width > 0 and height > 0 and width * height <= _MOST_PIXELS):
            raise ValueError(f"RVL: an image of {width}x{height}")
        return decode_rvl(data[8:], width * height).reshape(height, width)
    except (ValueError, struct.error) as error:
        raise UndecodableMessageError(f"compressed depth: {error}") from None

"""Images of sensor_msgs messages as arrays: colour (H, W, 3) uint8 RGB, depth (H, W) float32 [m]."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.files.image_file import JPEG, PNG, TAIL, image_head
from splatctrl_cli.logs.decoder import IMAGE, UndecodableMessageError, stamp_ns
from splatctrl_cli.logs.encodings import (
    BAYER,
    BAYER_16,
    COLOR_CONVERSIONS,
    DEPTH_ENCODINGS,
    decode_rvl,
    raw_pixels,
    to_rgb,
)
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
_CLOSING_MARKS = ((JPEG, b"\xff\xd9"), (PNG[:4], b"IEND"))
_DEPTH_HEAD = 12  # bytes of compressed_depth_image_transport before its image
_PNG_HEAD = struct.Struct(">16xIIB")
_PNG_CHUNKS = {b"IHDR", b"PLTE", b"IDAT", b"IEND"}  # that must be understood
_MOST_EXPANSION = 1100  # deflate's is 1032
_MOSAICS = frozenset({*BAYER, *BAYER_16})
_MOST_PIXELS = 1 << 26  # of an image whose code can say it in a few bytes


@dataclass(frozen=True, kw_only=True)
class ImageMessage:
    """An image as recorded.

    width, height [px]; decode gives pixels (H, W[, channels]) in `encoding`, or raises UndecodableMessageError;
    compressed is the image file's bytes where the message held one (JPEG, PNG) that decodes to `pixels`.
    """

    stamp_ns: int
    frame_id: str
    encoding: str
    width: int
    height: int
    decode: Callable[[], NDArray[Any]]
    compressed: bytes | None = None

    @cached_property
    def pixels(self) -> NDArray[Any]:
        """Those of `decode`, once."""
        return self.decode()

    @property
    def is_counts(self) -> bool:
        """Whether depth is whole counts of a unit."""
        return self.encoding != "32FC1"

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


def read_image(message: Any, type_name: str, *, lazily: bool = False) -> ImageMessage:
    """The image of a decoded sensor_msgs/Image or CompressedImage. Raises UndecodableMessageError.

    lazily: leave a JPEG or PNG of a plain kind undecoded until its pixels are asked for; it is whole as far as its
    marks and checksums say.
    """
    if type_name == IMAGE:
        pixels = raw_pixels(message)
        return _image(message, message.encoding, pixels.shape, lambda: pixels, None)
    data = bytes(message.data)
    if lazily and (found := _plain(message.format, data)) is not None:
        encoding, size, file, color = found
        return _image(message, encoding, size, partial(_decoded, message.format, file, color=color), file)
    pixels, encoding, compressed = _compressed_pixels(message.format, data)
    return _image(message, encoding, pixels.shape, lambda: pixels, compressed)


def _image(
    message: Any, encoding: str, size: tuple[int, ...], decode: Callable[[], NDArray[Any]], compressed: bytes | None
) -> ImageMessage:
    return ImageMessage(
        stamp_ns=stamp_ns(message.header),
        frame_id=message.header.frame_id.strip("/"),
        encoding=encoding,
        height=int(size[0]),
        width=int(size[1]),
        decode=decode,
        compressed=compressed,
    )


def _plain(form: str, data: bytes) -> tuple[str, tuple[int, int], bytes, bool] | None:
    """Encoding, (height, width), file and whether it is colour of a file that needs no decoding to be kept."""
    is_depth = "compressedDepth" in form
    recorded = form.partition(";")[0].strip()
    if is_depth and ("rvl" in form.lower() or recorded == "32FC1"):
        return None
    file = data[_DEPTH_HEAD:] if is_depth else data
    head = image_head(file)
    if head is None or (is_depth and head.channels != 1) or recorded in _MOSAICS:
        return None
    size = (head.height, head.width)
    if is_depth or (head.channels, head.bits) == (1, 16):
        return ("16UC1", size, file, False) if head.bits == 16 else None
    return ("mono8" if head.channels == 1 else "rgb8", size, file, head.channels != 1)


def _decoded(form: str, data: bytes, *, color: bool) -> NDArray[Any]:
    pixels = decode_file(data, color=color)
    if pixels is None:
        raise UndecodableMessageError(f"compressed image ({form}): {len(data)} bytes that are not an image file")
    return pixels


def color_of(image: ImageMessage) -> UInt8:
    """Colour (H, W, 3) uint8 RGB."""
    return to_rgb(image.pixels, image.encoding)


def depth_of(image: ImageMessage, scale: float | None) -> Float32:
    """Depth (H, W) float32 [m]; 0, negative and non-finite values (REP 118: no measurement) become 0 = none.

    `scale` [m per count]: default 1 mm for integers, 1 for floats.
    """
    if image.is_counts:
        return metres(image.pixels, MILLIMETRE if scale is None else scale)
    values = image.pixels * np.float32(1.0 if scale is None else scale)
    return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)


def num_invalid(depth: NDArray[Any]) -> int:
    """Pixels of a depth image (H, W) as recorded that are NaN, infinite or negative: what no camera measured."""
    return 0 if depth.dtype.kind == "u" else int((~np.isfinite(depth) | (depth < 0)).sum())


def metres(counts: NDArray[Any], scale: float) -> Float32:
    """Integer depth counts (H, W) as float32 [m]; the one formula, so that re-reading gives the same bits."""
    depth = counts.astype(np.float32)
    depth *= np.float32(scale)
    return depth


def decode_file(data: bytes, *, color: bool) -> NDArray[Any] | None:
    """Pixels of a JPEG, PNG, WebP, ... file, its orientation tag ignored: RGB of eight bits, or (not color) as OpenCV
    has them, of three channels in its order BGR.

    None if it is none, or was cut: OpenCV would fill the missing rows of a JPEG with grey.
    """
    if any(data.startswith(start) and end not in data[-TAIL:] for start, end in _CLOSING_MARKS):
        return None
    if data.startswith(PNG) and _says_more_than_it_holds(data):
        return None
    if data[:4] == b"RIFF" and len(data) < 8 + int.from_bytes(data[4:8], "little"):  # a WebP, and its length
        return None
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION if color else cv2.IMREAD_UNCHANGED
    buffer = np.frombuffer(data, dtype=np.uint8)
    if buffer.size == 0:
        return None
    try:
        pixels = cv2.imdecode(buffer, flags)
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(pixels)


def _says_more_than_it_holds(png: bytes) -> bool:
    """Whether a PNG announces an image, or a chunk, that its bytes do not hold: OpenCV takes memory for either.

    So it does for one without pixels, or with a chunk that must be understood and that no PNG has.
    """
    if len(png) < _PNG_HEAD.size:
        return True
    width, height, bits = _PNG_HEAD.unpack_from(png)
    at, end, has_pixels = len(PNG), len(png), False
    while at < end and (kind := png[at + 4 : at + 8]) != b"IEND":
        has_pixels |= kind == b"IDAT"
        if kind[:1].isupper() and kind not in _PNG_CHUNKS:
            return True
        at += 12 + int.from_bytes(png[at : at + 4], "big")
    return bool(not has_pixels or at + 12 > end or width * height * bits // 8 > _MOST_EXPANSION * end)


def _compressed_pixels(form: str, data: bytes) -> tuple[NDArray[Any], str, bytes | None]:
    if "compressedDepth" in form:
        return _compressed_depth(form, data)
    if data.startswith(JPEG) and (head := image_head(data)) is not None and head.channels == 3:
        return _decoded(form, data, color=True), "rgb8", data
    pixels = _decoded(form, data, color=False)
    recorded = form.partition(";")[0].strip()
    if pixels.ndim == 2 and recorded in _MOSAICS and pixels.dtype == (np.uint8 if recorded in BAYER else np.uint16):
        return pixels, recorded, None  # a mosaic in a file: its bytes are not a colour image
    if pixels.ndim == 2 and pixels.dtype == np.uint16:
        return pixels, "16UC1", data
    if pixels.ndim == 2 and pixels.dtype == np.float32:  # TIFF, as compressed_image_transport stores 32FC1
        return pixels, "32FC1", None
    if pixels.ndim == 3 and (pixels.dtype != np.uint8 or pixels.shape[2] != 3):
        return _decoded(form, data, color=True), "rgb8", data
    if pixels.dtype != np.uint8:
        raise UndecodableMessageError(
            f"compressed image ({form}): pixels of {pixels.dtype}, neither colour nor depth"
        )
    return pixels, "mono8" if pixels.ndim == 2 else "bgr8", data


def _compressed_depth(form: str, data: bytes) -> tuple[NDArray[Any], str, bytes | None]:
    """compressed_depth_image_transport: 12 bytes (int32, two float32 A, B), then a PNG or the sizes (two int32) and
    RVL; 32FC1 is A / (count - B) (its codec.cpp and rvl_codec.cpp).
    """
    is_rvl, file = "rvl" in form.lower(), data[_DEPTH_HEAD:]
    counts = _rvl_counts(file) if is_rvl else decode_file(file, color=False)
    if counts is None or counts.ndim != 2:
        raise UndecodableMessageError(f"compressed depth ({form}): {len(data)} bytes that hold no depth image")
    if not form.strip().startswith("32FC1"):
        return counts, "16UC1", None if is_rvl or counts.dtype != np.uint16 else file
    _, a, b = struct.unpack_from("<iff", data)
    with np.errstate(divide="ignore", invalid="ignore"):
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

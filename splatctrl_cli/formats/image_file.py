"""Image files: heads of JPEG and PNG without decoding, pixels, portable float maps.

PFM: one float32 channel, as MVSNet's depth, rows from the bottom.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.errors import refuse_if, require
from splatctrl_cli.formats.unpacking import read_bytes
from splatctrl_cli.records import Array, Float32

JPEG, PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
TAIL = 64  # bytes in which the closing mark of a file stands; some encoders pad
MOST_PIXELS = 1 << 27  # of an image that is left undecoded; OpenCV's own bound is 2^30
_JPEG_FRAMES = frozenset({0xC0, 0xC1, 0xC2})  # baseline, extended, progressive; Huffman coded
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length
_PNG_CHANNELS = {0: 1, 2: 3}  # by colour type: grey, RGB
_CLOSING_MARKS = ((JPEG, b"\xff\xd9"), (PNG[:4], b"IEND"))
_PNG_HEAD = struct.Struct(">16xIIB")
_PNG_CHUNKS = {b"IHDR", b"PLTE", b"IDAT", b"IEND"}  # that must be understood


@dataclass(frozen=True, kw_only=True)
class ImageHead:
    """Size [px], channels (1 or 3) and bits per channel."""

    width: int
    height: int
    channels: int
    bits: int


def image_head(data: bytes) -> ImageHead | None:
    """Read the head of a whole, plain JPEG or PNG; None for others.

    Plain: Huffman-coded 8-bit JPEG of one or three channels, with its end; grey or RGB PNG without transparency or
    interlace, all checksums right (ITU-T T.81; W3C PNG).
    """
    head = (_jpeg_head if data.startswith(JPEG) else _png_head)(data)
    return None if head is None or not 0 < head.width * head.height <= MOST_PIXELS else head


def _jpeg_head(data: bytes) -> ImageHead | None:
    if b"\xff\xd9" not in data[-TAIL:]:
        return None
    at, head = 2, None
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or marker in _JPEG_BARE:  # a byte of filling, or a marker
            at += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if length < 2 or marker == 0xD9:
            return None
        if marker == 0xDA:  # the picture begins
            return head
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            if marker not in _JPEG_FRAMES or head is not None or at + 10 > len(data):
                return None
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            if bits != 8 or channels not in {1, 3}:
                return None
            head = ImageHead(width=width, height=height, channels=channels, bits=bits)
        at += 2 + length
    return None


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, start and end of a PNG's chunks; the end may exceed the data."""
    at, kind = len(PNG), b""
    while at + 12 <= len(data) and kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, at)
        yield kind, at, at + 12 + length
        at += 12 + length


def _png_head(data: bytes) -> ImageHead | None:
    head, has_pixels, view = None, False, memoryview(data)
    for kind, at, end in _png_chunks(data) if data.startswith(PNG) else ():
        is_whole = end <= len(data) and zlib.crc32(view[at + 4 : end - 4]) == int.from_bytes(
            data[end - 4 : end], "big"
        )
        if not is_whole or (kind == b"IHDR") != (head is None) or kind == b"tRNS":
            return None
        if kind == b"IHDR":
            width, height, bits, color, _, _, interlace = struct.unpack_from(">IIBBBBB", data, at + 8)
            if end - at != 25 or interlace or bits not in {8, 16} or color not in _PNG_CHANNELS:
                return None
            head = ImageHead(width=width, height=height, channels=_PNG_CHANNELS[color], bits=bits)
        has_pixels |= kind == b"IDAT"
        if kind == b"IEND":
            return head if has_pixels else None
    return None


def decode_file(data: bytes, *, color: bool) -> Array | None:
    """Decode a JPEG, PNG, WebP, ..., ignoring its orientation tag; None if invalid or truncated.

    color: 8-bit RGB; else as OpenCV reads it, in BGR.
    """
    if (
        not data
        or any(data.startswith(start) and end not in data[-TAIL:] for start, end in _CLOSING_MARKS)
        or (data.startswith(PNG) and _says_more_than_it_holds(data))
        or (data[:4] == b"RIFF" and len(data) < 8 + int.from_bytes(data[4:8], "little"))  # a WebP, and its length
    ):
        return None
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION if color else cv2.IMREAD_UNCHANGED
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(pixels)


def _says_more_than_it_holds(png: bytes) -> bool:
    """True if a PNG announces more than its bytes, or an unknown critical chunk."""
    if len(png) < _PNG_HEAD.size:
        return True
    width, height, bits = _PNG_HEAD.unpack_from(png)
    kinds = [kind for kind, _, _ in _png_chunks(png)]
    is_known = all(kind in _PNG_CHUNKS for kind in kinds if kind[:1].isupper())
    is_whole = b"IDAT" in kinds and kinds[-1] == b"IEND"
    return not (is_known and is_whole) or width * height * bits // 8 > 1100 * len(png)  # deflate's is 1032


def write_pfm(path: Path, image: Float32) -> None:
    """Write (H, W) as little-endian grey PFM."""
    header = f"Pf\n{image.shape[1]} {image.shape[0]}\n-1.0\n".encode()
    path.write_bytes(header + np.ascontiguousarray(image[::-1], dtype="<f4").tobytes())


def read_pfm(path: Path) -> Float32:
    """Read a grey PFM (H, W) float32 of either byte order; |scale| must be 1.

    Raises InputError if missing, of another format or length.
    """
    content = read_bytes(path)
    header = require(
        re.match(rb"(PF|Pf)\s+(\d+)\s+(\d+)\s+([-+.\deE]+)\s", content[:128]),
        f"{path}: expected a PFM image, got another format",
    )
    width, height, start = int(header[2]), int(header[3]), header.end()
    refuse_if(
        header[1] != b"Pf" or header[4].lstrip(b"+-").rstrip(b"0").rstrip(b".") != b"1",
        f"{path}: expected one channel (Pf) of scale 1, got {header[1].decode()} of scale {header[4].decode()}",
    )
    refuse_if(
        width == 0 or height == 0, f"{path}: expected pixels, got {width}x{height}", remedy="copy the file anew"
    )
    refuse_if(
        len(content) - start != 4 * width * height,
        f"{path}: expected {4 * width * height} bytes for {width}x{height}, got {len(content) - start}",
        remedy="copy the file anew",
    )
    values = np.frombuffer(content, dtype="<f4" if header[4].startswith(b"-") else ">f4", offset=start)
    return np.ascontiguousarray(values.reshape(height, width)[::-1], dtype=np.float32)

"""Portable float maps: one float32 channel, as MVSNet stores depth. Rows are kept bottom first in the file."""

import re
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Float32


def write_pfm(path: Path, image: Float32) -> None:
    """Write an image (H, W) as little-endian grey PFM."""
    header = f"Pf\n{image.shape[1]} {image.shape[0]}\n-1.0\n".encode()
    path.write_bytes(header + np.ascontiguousarray(image[::-1], dtype="<f4").tobytes())


def read_pfm(path: Path) -> Float32:
    """The image (H, W) float32 of a grey PFM of either byte order; |scale| must be 1.

    Raises InputError for a missing file, another format, or a length other than the header's.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    header = re.match(rb"(PF|Pf)\s+(\d+)\s+(\d+)\s+([-+.\deE]+)\s", content[:128])
    if header is None:
        raise InputError(f"{path}: expected a PFM image, got another format")
    width, height = int(header[2]), int(header[3])
    is_little = header[4].startswith(b"-")
    if header[1] != b"Pf" or header[4].lstrip(b"+-").rstrip(b"0").rstrip(b".") != b"1":
        raise InputError(
            f"{path}: expected one channel (Pf) of scale 1, got {header[1].decode()} of scale {header[4].decode()}"
        )
    if width == 0 or height == 0:
        raise InputError(f"{path}: expected pixels, got {width}x{height}", remedy="copy the file anew")
    start = header.end()
    if len(content) - start != 4 * width * height:
        raise InputError(
            f"{path}: expected {4 * width * height} bytes for {width}x{height}, got {len(content) - start}",
            remedy="copy the file anew",
        )
    values = np.frombuffer(content, dtype="<f4" if is_little else ">f4", offset=start)
    return np.ascontiguousarray(values.reshape(height, width)[::-1], dtype=np.float32)

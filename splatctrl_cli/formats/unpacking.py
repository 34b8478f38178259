"""File reads, and decompression to no more than announced."""

import bz2
import tomllib
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard

from splatctrl_cli.errors import refuse_faults, refuse_if

PIECE = 1 << 20  # bytes that are read at a time
MAX_BLOCK = 128 << 20  # bytes; of one chunk or record, as stored and as unpacked
FREE_BYTES = 256 << 20  # that the blocks of any file may unpack to, and beside it:
MOST_RATIO = 1000  # times the file's size; colour and depth as recorded compress 2 to 20 times
MAX_WINDOW = 1 << 27  # bytes a zstd frame may refer back to: what its own command line accepts
_PLAIN = ("", "none")
_FAILURES = (zstandard.ZstdError, RuntimeError, OSError, EOFError, ValueError, MemoryError)


def read_bytes(path: Path, most: int = -1) -> bytes:
    """Read all or the first `most` bytes. Raises InputError if unreadable."""
    with (
        refuse_faults(lambda error: f"{path}: cannot be read: {error.strerror}", OSError),
        path.open("rb") as stream,
    ):
        return stream.read(most)


def read_text(path: Path, remedy: str) -> str:
    """Read UTF-8 text. Raises InputError with the remedy if unreadable, UnicodeDecodeError for other bytes."""
    with refuse_faults(lambda error: f"{path}: cannot be read: {error.strerror}", OSError, remedy=remedy):
        return path.read_text(encoding="utf-8")


def read_toml(path: Path, remedy: str) -> dict[str, Any]:
    """Read TOML. Raises InputError with the remedy if unreadable or other text."""
    with refuse_faults(f"{path}: not valid TOML", tomllib.TOMLDecodeError, UnicodeDecodeError, remedy=remedy):
        return tomllib.loads(read_text(path, remedy))


class BadBlockError(ValueError):
    """A skipped block, and why."""


class Budget:
    """A bound on what a file unpacks to."""

    def __init__(self, file_size: int) -> None:
        self._left = FREE_BYTES + MOST_RATIO * file_size

    def unpacked(self, data: bytes, compression: str, size: int) -> bytes:
        """Unpack within the budget. Raises BadBlockError."""
        if size <= MAX_BLOCK:
            self._left -= size
            refuse_if(
                self._left < 0, f"the file so far unpacks to over {MOST_RATIO} times its size", error=BadBlockError
            )
        return unpacked(data, compression, size)


def unpacked(data: bytes, compression: str, size: int, largest: int = MAX_BLOCK) -> bytes:
    """Unpack the announced `size` bytes of `data`, never more.

    Raises BadBlockError for unknown or damaged compression, or a size over `largest` or other than announced.
    """
    refuse_if(size > largest, f"announces {size} bytes unpacked, at most {largest} are read", error=BadBlockError)
    content = _unpacked_up_to(data, compression, size + 1)
    refuse_if(
        len(content) != size,
        f"announces {size} bytes unpacked, holds {'more' if len(content) > size else len(content)}",
        error=BadBlockError,
    )
    return content


def unpacked_start(data: bytes, compression: str, size: int) -> bytes:
    """Unpack a cut block: at most `size` bytes and MAX_BLOCK, perhaps none."""
    try:
        return _unpacked_up_to(data, compression, min(size, MAX_BLOCK))
    except BadBlockError:
        return b""


def _unpacked_up_to(data: bytes, compression: str, most: int) -> bytes:
    if compression in _PLAIN:
        return data[:most]
    with refuse_faults(lambda _: "cannot be decompressed", *_FAILURES, error=BadBlockError):
        match compression:
            case "zstd":
                decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
                with decompressor.stream_reader(data, read_across_frames=True) as stream:
                    return stream.read(most)
            case "lz4":
                return _unpack_lz4(data, most)
            case "bz2":
                return bz2.BZ2Decompressor().decompress(data, max_length=most)
    raise BadBlockError(f"compression {compression!r} is unknown; expected zstd, lz4 or bz2")


def _unpack_lz4(data: bytes, most: int) -> bytes:
    parts, length = [], 0
    while data and length < most:
        decompressor = lz4.frame.LZ4FrameDecompressor()
        parts.append(decompressor.decompress(data, max_length=most - length))
        length += len(parts[-1])
        data = decompressor.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)

"""Arrays in a ``.npz`` without the clock in it: the same arrays give the same bytes; and arrays out of one, no more
than may be meant: ten megabytes of a ``.npz`` can hold ten gigabytes of zeros.
"""

import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.files.unpacking import PIECE

DAMAGE = (  # what reading a damaged or foreign .npz raises; an OSError where a place in it lies before its start
    *(zipfile.BadZipFile, zlib.error, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError),
    *(SyntaxError, tokenize.TokenError, OverflowError),
)


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """An array that is made while it is written: its dtype and shape, and its values in C order, piece by piece."""

    dtype: str
    shape: tuple[int, ...]
    make: Callable[[], Iterable[NDArray[np.generic]]]


def savez(path: Path, arrays: Mapping[str, NDArray[np.generic] | Pieces], *, level: int = 6) -> None:
    """What `np.savez_compressed` writes, at zlib's `level` (0: stored), one array at a time."""
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method, compresslevel=level) as archive:
        for name, array in arrays.items():
            size = np.dtype(array.dtype).itemsize * int(np.prod(array.shape))
            with archive.open(f"{name}.npy", "w", force_zip64=size >= 2**30) as stream:
                if isinstance(array, Pieces):
                    layout = {"descr": array.dtype, "fortran_order": False, "shape": array.shape}
                    np.lib.format.write_array_header_1_0(stream, layout)
                    for piece in array.make():
                        stream.write(piece.tobytes())
                else:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)


def read_arrays(path: Path, names: Collection[str] | None = None, *, most: int) -> dict[str, NDArray[np.generic]]:
    """The arrays `names` (default: all) of a ``.npz``, of together at most `most` bytes.

    Raises OSError, KeyError for an array that is not there, ValueError for objects, for more bytes than
    `most` and for other bytes than the array's own head says, and what is in `DAMAGE`.
    """
    with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        chosen = (
            [n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy")] if names is None else names
        )
        left, found = most, {}
        for name in dict.fromkeys(chosen):
            with archive.open(f"{name}.npy") as member:
                found[name] = _array(member, name, archive.getinfo(f"{name}.npy").file_size, left)
            left -= found[name].nbytes
    return found


def has_arrays(path: Path, head: bytes, names: Collection[str]) -> bool:
    """Whether a file, whose first bytes are `head`, is a ``.npz`` with all of these arrays."""
    if not head.startswith(b"PK\x03\x04"):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in names} <= set(archive.namelist())
    except (*DAMAGE, OSError):
        return False


def npy_head(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether by columns, and type of the array whose ``.npy`` begins here; the stream is left behind it.

    Raises ValueError for none.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(stream)
    if any(not isinstance(n, int) or n < 0 for n in shape):
        raise ValueError(f"shape {shape}, expected whole numbers")
    return tuple(shape), is_fortran, dtype


def check_numbers(dtype: np.dtype[Any]) -> None:
    """Raise ValueError for objects, which would be unpickled."""
    if dtype.hasobject:
        raise ValueError("objects, expected numbers")


def _array(member: IO[bytes], name: str, file_size: int, most: int) -> NDArray[np.generic]:
    shape, is_fortran, dtype = npy_head(member)
    check_numbers(dtype)
    size = prod(shape) * dtype.itemsize
    if size > most:
        raise ValueError(f"{name}: {size} bytes, expected at most {most}")
    if size != file_size - member.tell():
        raise ValueError(f"{name}: announces {size} bytes, holds {file_size - member.tell()}")
    content = bytearray(size)
    view, at = memoryview(content), 0
    while at < size and (piece := member.read(min(size - at, PIECE))):
        view[at : at + len(piece)] = piece
        at += len(piece)
    if at < size or member.read(1):  # reading to the end is what checks the sum
        raise ValueError(f"{name}: expected {size} bytes, got {'more' if at == size else at}")
    values: NDArray[np.generic] = np.frombuffer(content, dtype) if size else np.zeros(0, dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")


def npy_of(data: bytes) -> NDArray[np.generic]:
    """The array of a ``.npy`` file's bytes. Raises ValueError for one that announces more than there is, or objects.

    `np.load` allocates what the header announces before it looks.
    """
    stream = BytesIO(data)
    shape, is_fortran, dtype = npy_head(stream)
    check_numbers(dtype)
    size = prod(shape) * dtype.itemsize
    if size != len(data) - stream.tell():
        raise ValueError(f"announces {size} bytes, holds {len(data) - stream.tell()}")
    values = np.frombuffer(data, dtype, offset=stream.tell()) if size else np.zeros(0, dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")

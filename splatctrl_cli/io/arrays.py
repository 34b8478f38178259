"""Arrays in a ``.npz`` without the clock in it: the same arrays give the same bytes."""

import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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


def savez(path: Path, arrays: Mapping[str, NDArray[np.generic] | Pieces], *, level: int = 1) -> None:
    """What `np.savez_compressed` writes, at zlib's `level` (0: stored), one array at a time."""
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method, compresslevel=level) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = method
            size = np.dtype(array.dtype).itemsize * int(np.prod(array.shape))
            with archive.open(entry, "w", force_zip64=size >= 2**30) as stream:
                if isinstance(array, Pieces):
                    layout = {"descr": array.dtype, "fortran_order": False, "shape": array.shape}
                    np.lib.format.write_array_header_1_0(stream, layout)
                    for piece in array.make():
                        stream.write(piece.tobytes())
                else:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)


def npy_of(data: bytes) -> NDArray[np.generic]:
    """The array of a ``.npy`` file's bytes. Raises ValueError for one that announces more than there is, or objects.

    `np.load` allocates what the header announces before it looks.
    """
    stream = BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(stream)
    if dtype.hasobject:
        raise ValueError("objects, expected numbers")
    size = prod(shape) * dtype.itemsize
    if size != len(data) - stream.tell():
        raise ValueError(f"announces {size} bytes, holds {len(data) - stream.tell()}")
    values = np.frombuffer(data, dtype, offset=stream.tell()) if size else np.zeros(0, dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")

"""The arrays of an NPZ file as columns, read a block of rows at a time."""

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.files.array_columns import ArrayFile
from splatctrl_cli.files.arrays import DAMAGE, npy_head
from splatctrl_cli.files.spilled_rows import BLOCK

_MOST_BY_COLUMNS = 1 << 28  # bytes, as they are in memory at once
_DAMAGE = (OSError, *DAMAGE)


class NpzFile(ArrayFile):
    def __init__(self, path: Path) -> None:
        """Raises InputError for a file of another kind."""
        super().__init__(path)
        try:
            with zipfile.ZipFile(path) as archive:
                self.names = [name.removesuffix(".npy") for name in archive.namelist()]
        except _DAMAGE as error:
            raise self._unreadable("NPZ", error) from None

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        if name not in self.names:
            return None
        with ExitStack() as stack:
            shape, dtype, _, _ = self._opened(stack, name)
            return shape, dtype

    def _blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """One that is stored by columns is read at once."""
        with ExitStack() as stack:
            shape, dtype, is_by_columns, stream = self._opened(stack, name)
            try:
                if is_by_columns:
                    if prod(shape) * dtype.itemsize > _MOST_BY_COLUMNS:
                        raise ValueError(f"{name}: over {_MOST_BY_COLUMNS} bytes by columns, expected rows")
                    whole = np.frombuffer(_read(stream, prod(shape) * dtype.itemsize), dtype).reshape(
                        shape, order="F"
                    )
                    yield from (whole[first : first + BLOCK] for first in range(0, shape[0], BLOCK))
                    return
                row = prod(shape[1:]) * dtype.itemsize
                for first in range(0, shape[0], BLOCK):
                    num = min(BLOCK, shape[0] - first)
                    yield np.frombuffer(_read(stream, num * row), dtype).reshape(num, *shape[1:])
            except _DAMAGE as error:
                raise self._unreadable("NPZ", error) from None

    def _opened(self, stack: ExitStack, name: str) -> tuple[tuple[int, ...], np.dtype[Any], bool, IO[bytes]]:
        """Shape, type, whether by columns, and the stream behind the header."""
        try:
            archive = stack.enter_context(zipfile.ZipFile(self.path))
            stream = stack.enter_context(archive.open(f"{name}.npy"))
            shape, is_by_columns, dtype = npy_head(stream)
        except _DAMAGE as error:
            raise self._unreadable("NPZ", error) from None
        return shape, dtype, is_by_columns and len(shape) > 1, stream


def _read(stream: IO[bytes], num: int) -> bytes:
    content = stream.read(num)
    if len(content) < num:
        raise EOFError(f"expected {num} bytes, got {len(content)}")
    return content

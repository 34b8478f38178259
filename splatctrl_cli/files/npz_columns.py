"""The arrays of an NPZ file as columns, read a block of rows at a time."""

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.arrays import DAMAGE, npy_head
from splatctrl_cli.files.spilled_rows import BLOCK, RowFile, Rows
from splatctrl_cli.records import Float64, Stamps

FREE_BYTES = 1 << 30  # of an array, unpacked, and beside it:
MOST_RATIO = 100  # times the file's size; joint states as recorded compress 2 to 20 times
_MOST_BY_COLUMNS = 1 << 28  # bytes, as they are in memory at once
_DAMAGE = (OSError, *DAMAGE)


class NpzFile:
    """An NPZ file of columns: arrays (T, ...), of which each row is flattened."""

    def __init__(self, path: Path) -> None:
        """Raises InputError for a file of another kind."""
        self._path = path
        try:
            with zipfile.ZipFile(path) as archive:
                self.names = [name.removesuffix(".npy") for name in archive.namelist()]
        except _DAMAGE as error:
            raise self._unreadable(error) from None

    def columns(self, names: Sequence[str]) -> Rows:
        """(T, K) of the columns of arrays side by side. Raises InputError for arrays that are not there, hold no
        numbers, or are of several lengths.
        """
        headers = [self._header(name) for name in names]
        lengths = [shape[0] for shape, _ in headers]
        if len(set(lengths)) > 1:
            said = ", ".join(f"{name} {length}" for name, length in zip(names, lengths, strict=True))
            raise InputError(f"{self._path}: expected arrays of one length, got {said}", remedy="check the file")
        file = RowFile((sum(prod(shape[1:]) for shape, _ in headers),))
        for blocks in zip(*(self._blocks(name) for name in names), strict=True):
            file.append(np.hstack([block.reshape(len(block), -1).astype(np.float64) for block in blocks]))
        return Rows(file)

    def read(
        self, time: str, unit_ns: int, groups: Mapping[str, Sequence[str]], epoch_ns: int
    ) -> tuple[Stamps, dict[str, Rows]]:
        """`stamps`, and of each group of names its `columns`."""
        found = {key: self.columns(names) for key, names in groups.items()}
        return self.stamps(time, unit_ns, epoch_ns), found

    def numbers(self, names: Sequence[str]) -> Float64:
        """`columns`, all rows at once."""
        rows = self.columns(names)
        return rows[: len(rows)]

    def rows(self, name: str) -> Rows:
        """An array (T, ...), each row in its shape; T may be 0. Raises InputError where it holds no numbers."""
        shape, _ = self._header(name, least=0)
        file = RowFile(shape[1:])
        for block in self._blocks(name):
            file.append(block.astype(np.float64))
        return Rows(file)

    def stamps(self, name: str, unit_ns: int, epoch_ns: int, *, least: int = 1) -> Stamps:
        """Stamps (T,) [ns] of an array of times in units of `unit_ns`."""
        _, dtype = self._header(name, least=least)
        times = np.concatenate([np.zeros(0, dtype), *(block.reshape(-1) for block in self._blocks(name))])
        if times.dtype.kind in "iu":
            return np.asarray(times.astype(np.int64) * unit_ns + epoch_ns)
        if not np.isfinite(times).all():
            raise InputError(f"{self._path}: {name}: expected times, got NaN or infinity", remedy="check the file")
        whole = np.floor(times)
        parts = np.round((times - whole) * unit_ns).astype(np.int64)
        return np.asarray(whole.astype(np.int64) * unit_ns + parts + epoch_ns)

    def _header(self, name: str, *, least: int = 1) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Shape and type of an array of `least` rows or more."""
        found = "none"
        if name in self.names:
            with ExitStack() as stack:
                shape, dtype, _, _ = self._opened(stack, name)
                if dtype.kind in "iuf" and shape and shape[0] >= least:
                    return shape, dtype
                if dtype.kind in "iuf" and shape and not shape[0]:
                    raise InputError(f"{self._path}: {name}: expected rows, got none", remedy="record it again")
                found = f"{dtype} of shape {shape}"
        raise InputError(
            f"{self._path}: {name!r}: expected an array of numbers, got {found}",
            remedy=f"arrays there: {', '.join(self.names)}",
        )

    def _blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """The rows of an array, BLOCK at a time; one that is stored by columns is read at once."""
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
                raise self._unreadable(error) from None

    def _opened(self, stack: ExitStack, name: str) -> tuple[tuple[int, ...], np.dtype[Any], bool, IO[bytes]]:
        """Shape, type, whether by columns, and the stream behind the header."""
        try:
            archive = stack.enter_context(zipfile.ZipFile(self._path))
            stream = stack.enter_context(archive.open(f"{name}.npy"))
            shape, is_by_columns, dtype = npy_head(stream)
            self._check_size(name, prod(shape) * dtype.itemsize)
        except _DAMAGE as error:
            raise self._unreadable(error) from None
        return shape, dtype, is_by_columns and len(shape) > 1, stream

    def _check_size(self, name: str, size: int) -> None:
        """Raise ValueError for an array that no recording packs so small: it is kept on disk, unpacked."""
        most = FREE_BYTES + MOST_RATIO * self._path.stat().st_size
        if size > most:
            raise ValueError(f"{name}: {size} bytes unpacked, over {MOST_RATIO} times the size of the file")

    def _unreadable(self, error: Exception) -> InputError:
        return InputError(f"{self._path}: cannot be read as NPZ: {error}", remedy="check the file")


def _read(stream: IO[bytes], num: int) -> bytes:
    content = stream.read(num)
    if len(content) < num:
        raise EOFError(f"expected {num} bytes, got {len(content)}")
    return content

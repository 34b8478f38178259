"""Rows of numbers, and objects, in unnamed files, read by blocks to bound memory."""

import os
import pickle
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar, cast, overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

from splatctrl_cli.errors import refuse_if
from splatctrl_cli.records import Float64, Index

IN_MEMORY = 2**20  # [bytes] up to which a file is memory
BLOCK = 4096  # rows at once
FEW = 4096  # unrequested rows that may be read along
T = TypeVar("T")


def scratch_folder() -> Path:
    """Folder for unnamed files: TMPDIR, else /var/tmp (on disk, unlike some /tmp), else the default."""
    folder, on_disk = os.environ.get("TMPDIR"), Path("/var/tmp")
    return Path(tempfile.gettempdir()) if folder or not os.access(on_disk, os.W_OK) else on_disk


def ranges(num: int) -> Iterator[tuple[int, int]]:
    """First and one past the last row of each `BLOCK`."""
    yield from ((first, min(first + BLOCK, num)) for first in range(0, num, BLOCK))


class RowFile:
    """Rows of one shape, appended; reads return copies without memory mapping."""

    def __init__(
        self, shape: tuple[int, ...] = (), blocks: Iterable[Float64] = (), dtype: DTypeLike = np.float64
    ) -> None:
        """Start with `blocks` of rows (T, ...); shape: of a row; dtype: float64 or int64."""
        self.row_shape, self._dtype = shape, np.dtype(dtype)
        self._row_bytes = 8 * int(np.prod(shape, dtype=np.int64))
        self._num = 0
        self._waiting: list[bytes] = []  # rows that are not in the file yet
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY, dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        for block in blocks:
            self.append(block)

    def __len__(self) -> int:
        return self._num

    def append(self, rows: Float64) -> None:
        block = np.ascontiguousarray(rows, dtype=self._dtype)
        refuse_if(
            block.shape[1:] != self.row_shape,
            f"rows: expected {self.row_shape}, got {block.shape[1:]}",
            error=ValueError,
        )
        self._waiting.append(block.tobytes())
        self._num += len(block)
        if len(block) > 1 or len(self._waiting) == BLOCK:
            self._flush()

    def read(self, first: int, last: int) -> Float64:
        """Rows (last - first, ...)."""
        self._flush()
        num = max(min(last, self._num) - first, 0)
        self._file.seek(first * self._row_bytes)
        return np.frombuffer(bytearray(self._file.read(num * self._row_bytes)), dtype=self._dtype).reshape(
            num, *self.row_shape
        )

    def _flush(self) -> None:
        if self._waiting:
            self._file.seek(0, os.SEEK_END)
            self._file.write(b"".join(self._waiting))
            self._waiting = []

    def take(self, index: Index) -> Float64:
        """Rows of an index (T,), in its order."""
        if not len(index):
            return self.read(0, 0)
        first, last = int(index.min()), int(index.max()) + 1
        if last - first <= 2 * len(index) + FEW:
            return self.read(first, last)[index - first]
        return np.concatenate([self.read(i, i + 1) for i in index.tolist()])


class Rows:
    """Rows (T, ...) of a file, optionally of an index (T,) and some `columns`.

    ``rows[first:last]``, ``rows[index]`` and ``rows[number]`` read like an array's.
    """

    def __init__(self, file: RowFile, index: Index | None = None, columns: Index | None = None) -> None:
        self._file, self._index, self._columns = file, index, columns

    def __len__(self) -> int:
        return len(self._file) if self._index is None else len(self._index)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self), *(self._file.row_shape if self._columns is None else (len(self._columns),)))

    def __getitem__(self, which: int | slice | NDArray[np.integer]) -> Float64:
        if isinstance(which, slice):
            first, last, _ = which.indices(len(self))
            return self._read(first, last)
        if isinstance(which, int | np.integer):
            number = int(which) + (len(self) if which < 0 else 0)
            return cast("Float64", self._read(number, number + 1)[0])
        index = which.astype(np.int64)
        return self._narrowed(self._file.take(index if self._index is None else self._index[index]))

    def __iter__(self) -> Iterator[Float64]:
        for first, last in ranges(len(self)):
            yield from self[first:last]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Float64:
        return np.asarray(self[: len(self)], dtype=dtype)

    def select(self, index: Index | None = None, columns: Index | None = None) -> "Rows":
        """Rows of an index (K,), and of columns, in their order."""
        choices = ((self._index, index), (self._columns, columns))
        return Rows(self._file, *(old if new is None else new if old is None else old[new] for old, new in choices))

    def _read(self, first: int, last: int) -> Float64:
        if self._index is None:
            return self._narrowed(self._file.read(first, last))
        return self._narrowed(self._file.take(self._index[first:last]))

    def _narrowed(self, rows: Float64) -> Float64:
        return rows if self._columns is None else np.ascontiguousarray(rows[:, self._columns])


class ObjectFile(Sequence[T], Generic[T]):
    """Objects in an unnamed file, read by blocks."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY, dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._starts: list[int] = []  # first object of each block; `_places`: its file offset
        self._places: list[int] = []
        self._num = 0
        self._read: tuple[int, list[T]] = (-1, [])

    def append(self, one: T) -> None:
        self.extend([one])

    def extend(self, objects: Sequence[T]) -> None:
        if not objects:
            return
        self._starts.append(self._num)
        self._places.append(self._file.seek(0, 2))
        pickle.dump(list(objects), self._file, protocol=pickle.HIGHEST_PROTOCOL)
        self._num += len(objects)

    def __len__(self) -> int:
        return self._num

    def __iter__(self) -> Iterator[T]:
        for number in range(len(self._starts)):
            yield from self._block(number)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._num))]
        at = index + (self._num if index < 0 else 0)
        if not 0 <= at < self._num:
            raise IndexError(f"{index} of {self._num}")
        number = int(np.searchsorted(self._starts, at, side="right")) - 1
        return self._block(number)[at - self._starts[number]]

    def _block(self, number: int) -> list[T]:
        if self._read[0] != number:
            self._file.seek(self._places[number])
            self._read = number, pickle.load(self._file)
        return self._read[1]


Table = Float64 | Rows
"""Rows (T, ...) by number, slice or index: in memory, or in a file."""


def select(table: Table, index: Index | None = None, columns: Index | None = None) -> Table:
    """Rows and columns in the order of their indices; files are read later."""
    if isinstance(table, Rows):
        return table.select(index, columns)
    rows = table if index is None else table[index]
    return rows if columns is None else rows[:, columns]


def blocks_of(table: Table) -> Iterator[Float64]:
    yield from (table[first:last] for first, last in ranges(len(table)))


def absent(num: int, width: int) -> Rows:
    """(num, width) NaN."""
    return Rows(RowFile((width,), (np.full((last - first, width), np.nan) for first, last in ranges(num))))


def scaled(rows: Rows, factor: float) -> Rows:
    return rows if factor == 1.0 else Rows(RowFile(rows.shape[1:], (block * factor for block in blocks_of(rows))))

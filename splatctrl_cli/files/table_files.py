"""Arrays of HDF5 and Parquet files as columns (extra `tables`: h5py, pyarrow).

An array of HDF5 is named by its path (``observations/qpos``), one of Parquet by its column; a column of lists of one
length is an array (T, K).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.array_columns import ArrayFile
from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.libraries import of_extra

_RAGGED = "write rows of one length: an array (T, K), or a column for each joint"
_EXTRA = "tables"


class Hdf5File(ArrayFile):
    def __init__(self, path: Path) -> None:
        """Raises InputError for a file of another kind."""
        super().__init__(path)
        self._h5py = of_extra("h5py", _EXTRA, "HDF5 files")
        found: list[str] = []

        def visit(name: str, item: Any) -> None:
            if isinstance(item, self._h5py.Dataset):
                found.append(name)

        with self._opened() as file:
            file.visititems(visit)
        self.names = found

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        name = name.strip("/")
        if name not in self.names:
            return None
        with self._opened() as file:
            array = file[name]
            if self._h5py.check_vlen_dtype(array.dtype) not in {None, str, bytes}:
                raise InputError(f"{self.path}: {name}: ragged: its rows differ in length", remedy=_RAGGED)
            return array.shape, array.dtype

    def _blocks(self, name: str) -> Iterator[NDArray[Any]]:
        with self._opened() as file:
            array = file[name]
            for first in range(0, array.shape[0], BLOCK):
                yield np.asarray(array[first : first + BLOCK])

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            with self._h5py.File(self.path, "r") as file:
                yield file
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise self._unreadable("HDF5", error) from None


class ParquetFile(ArrayFile):
    """A Parquet file, or of one its rows whose column `only` has a value."""

    def __init__(self, path: Path, only: tuple[str, int] | None = None) -> None:
        """Raises InputError for a file of another kind."""
        super().__init__(path)
        self._arrow, self._parquet = (
            of_extra(name, _EXTRA, "Parquet files") for name in ("pyarrow", "pyarrow.parquet")
        )
        self._only = only
        with self._opened() as file:
            self.names = list(file.schema_arrow.names)
            self._num: int = file.metadata.num_rows
        if only is not None:
            if only[0] not in self.names:
                raise InputError(f"{path}: no column {only[0]}", remedy=f"columns there: {', '.join(self.names)}")
            self._num = sum(len(block) for block in self._blocks(only[0]))

    def __len__(self) -> int:
        return self._num

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        if name not in self.names:
            return None
        block = next(self._blocks(name), None)
        return ((0,), np.dtype(np.float64)) if block is None else ((self._num, *block.shape[1:]), block.dtype)

    def _blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """Raises InputError for a column whose lists differ in length."""
        shape: tuple[int, ...] | None = None
        names = [name] if self._only is None else list(dict.fromkeys([name, self._only[0]]))
        with self._opened() as file:
            for batch in file.iter_batches(batch_size=BLOCK, columns=names):
                values = self._values(batch.column(name), name)
                if self._only is not None:
                    values = values[self._values(batch.column(self._only[0]), self._only[0]) == self._only[1]]
                if shape not in (None, values.shape[1:]):
                    raise self._ragged(name)
                shape = values.shape[1:]
                if len(values):
                    yield values

    def _values(self, column: Any, name: str) -> NDArray[Any]:
        """A column (T, ...), of floats NaN where it has no value."""
        if not hasattr(column.type, "value_type") or self._arrow.types.is_dictionary(column.type):
            return np.asarray(column.to_numpy(zero_copy_only=False))
        lengths = column.value_lengths().to_numpy(zero_copy_only=False)
        if column.null_count or len(set(lengths.tolist())) > 1:
            raise self._ragged(name)
        inner = self._values(column.flatten(), name)
        return inner.reshape(len(column), -1, *inner.shape[1:])

    def _ragged(self, name: str) -> InputError:
        return InputError(f"{self.path}: {name}: ragged: its rows differ in length, or have none", remedy=_RAGGED)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            with self._parquet.ParquetFile(self.path) as file:
                yield file
        except (OSError, ValueError, KeyError, self._arrow.ArrowException) as error:
            raise self._unreadable("Parquet", error) from None

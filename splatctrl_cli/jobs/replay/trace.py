"""The trace of a replay: one table of its states, in files."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from splatctrl_cli.control.columns import NamedColumns
from splatctrl_cli.files.spilled_rows import ObjectFile, RowFile, Rows
from splatctrl_cli.records import Stamps

BLOCK = 1024  # states that are replayed at once


class Trace(Mapping[str, Any]):
    """T states as `NamedColumns`, appended in blocks.

    Words name who or where: `nearest_exact` of `clearance_exact`.
    """

    def __init__(self) -> None:
        self._columns: dict[str, RowFile | ObjectFile[Any]] = {}

    def append(self, columns: NamedColumns) -> None:
        """Append a block to some columns."""
        for name, values in columns.items():
            if name not in self._columns:
                dtype = np.int64 if name == "stamp_ns" else np.float64
                is_words = isinstance(values, list)
                self._columns[name] = ObjectFile() if is_words else RowFile(values.shape[1:], dtype=dtype)
            file = self._columns[name]
            if isinstance(file, RowFile):
                file.append(values)
            else:
                file.extend(values)

    def __len__(self) -> int:
        """The number of columns."""
        return len(self._columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __getitem__(self, name: str) -> Any:
        """All numbers (T, ...) of a column, or its words (T,), read where needed."""
        column = self.rows(name)
        return np.asarray(column) if isinstance(column, Rows) else column

    def rows(self, name: str) -> Any:
        """A column (T, ...), read where needed: `Rows` of numbers, or words."""
        file = self._columns[name]
        return Rows(file) if isinstance(file, RowFile) else file

    @property
    def stamp_ns(self) -> Stamps:
        """Stamps (T,) [ns]."""
        return np.asarray(self["stamp_ns"], dtype=np.int64)

    def seconds(self, index: int) -> float:
        """Time [s] of a state since the first."""
        stamps = self.rows("stamp_ns")
        return float(stamps[index] - stamps[0]) * 1e-9

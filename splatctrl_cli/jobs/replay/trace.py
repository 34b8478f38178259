"""The trace of a replay: one table of its states, in files."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from splatctrl_cli.control.columns import Columns
from splatctrl_cli.files.spilled_rows import ObjectFile, RowFile, Rows
from splatctrl_cli.records import Float64, Stamps

BLOCK = 1024  # states that are replayed at once


class Trace:
    """T states by named column, appended in blocks.

    Numbers (T, ...) are NaN without a value. Words, empty without any, name who or where a value is from:
    `nearest_exact` of `clearance_exact`.
    """

    def __init__(self) -> None:
        self._numbers: dict[str, RowFile] = {}
        self._words: dict[str, ObjectFile[Any]] = {}

    def append(self, columns: Columns) -> None:
        """Append a block to some columns; the others follow, or are absent."""
        for name, values in columns.items():
            if isinstance(values, np.ndarray):
                dtype = np.int64 if name == "stamp_ns" else np.float64
                self._numbers.setdefault(name, RowFile(values.shape[1:], dtype=dtype)).append(values)
            else:
                self._words.setdefault(name, ObjectFile()).extend(values)

    def __len__(self) -> int:
        return len(self._numbers["stamp_ns"])

    def __iter__(self) -> Iterator[str]:
        return iter((*self._numbers, *self._words))

    def __contains__(self, name: str) -> bool:
        return name in self._numbers or name in self._words

    def __getitem__(self, name: str) -> Float64:
        """A whole column of numbers (T, ...)."""
        return np.asarray(self.rows(name))

    def block(self, name: str, which: slice) -> Float64 | list[Any]:
        """Numbers (K, ...) or words of some states."""
        return self.rows(name)[which] if name in self._numbers else self._words[name][which]

    def rows(self, name: str) -> Rows:
        """A column of numbers (T, ...), read where needed."""
        return Rows(self._numbers[name])

    def words(self, name: str) -> Sequence[Any]:
        """A column of words (T,), read where needed."""
        return self._words[name]

    @property
    def stamp_ns(self) -> Stamps:
        """Stamps (T,) [ns]."""
        return np.asarray(self.rows("stamp_ns"), dtype=np.int64)

    def seconds(self, index: int) -> float:
        """Time [s] of a state since the first."""
        stamps = self.rows("stamp_ns")
        return float(stamps[index] - stamps[0]) * 1e-9

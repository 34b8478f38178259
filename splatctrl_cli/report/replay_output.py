"""The table of a replay: one row per step, numbers to nine digits, nothing where there is no value."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

Columns = Mapping[str, Sequence[object]]

_SPECIAL = re.compile('[,"\r\n]')


def write_steps(path: Path, chunks: Iterable[Columns]) -> None:
    """Write chunks of rows, each as equally long columns of the same names, as one CSV.

    Floats have nine digits; NaN and infinity are nothing.
    """
    with path.open("w", encoding="utf-8", newline="") as stream:
        for index, columns in enumerate(chunks):
            if index == 0:
                stream.write(",".join(map(_quoted, columns)) + "\n")
            parts = [_formatted(values) for values in columns.values()]
            row = ",".join(form for form, _ in parts) + "\n"
            stream.write("".join(map(row.__mod__, zip(*(cells for _, cells in parts), strict=True))))


def _formatted(values: Sequence[object]) -> tuple[str, Sequence[object]]:
    """How to format a column's cells, so that a row is formatted at once, and the cells."""
    kinds = set(map(type, values))
    if kinds == {float} and all(map(math.isfinite, values)):  # type: ignore[arg-type]
        return "%.9g", values
    if kinds == {int}:
        return "%d", values
    if kinds == {str}:
        known = {value: _quoted(str(value)) for value in set(values)}
        return "%s", [known[value] for value in values]
    return "%s", [_cell(value) for value in values]


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return _quoted(str(value))


def _quoted(text: str) -> str:
    """A cell as CSV has it: between quotes where it holds a comma, a quote or the end of a line."""
    return '"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text

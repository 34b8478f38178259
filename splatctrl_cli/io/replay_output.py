"""The table of a replay: one row per step, numbers to nine digits, nothing where there is no value."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

Columns = Mapping[str, Sequence[object]]


def write_steps(path: Path, chunks: Iterable[Columns]) -> None:
    """Write chunks of rows, each as equally long columns of the same names, as one CSV.

    Floats have nine digits; NaN and infinity are nothing.
    """
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        for index, columns in enumerate(chunks):
            if index == 0:
                writer.writerow(columns)
            writer.writerows([_cell(value) for value in row] for row in zip(*columns.values(), strict=True))


def _cell(value: object) -> object:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return value

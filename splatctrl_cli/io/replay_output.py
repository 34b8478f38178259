"""The table of a replay: one row per step, numbers to nine digits, nothing where there is no value."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path


def write_steps(path: Path, columns: Mapping[str, Sequence[object]]) -> None:
    """Write equally long columns as CSV; floats to nine digits, NaN and infinity as nothing."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_cell(value) for value in row] for row in zip(*columns.values(), strict=True))


def _cell(value: object) -> object:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return value

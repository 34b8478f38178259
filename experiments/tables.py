"""Tables as an experiment prints them."""

from collections.abc import Iterable, Sequence
from typing import Any


def aligned(header: Sequence[Any], rows: Iterable[Sequence[Any]]) -> list[str]:
    """Lines of a table whose columns are aligned."""
    cells = [[*map(str, header)], *([*map(str, row)] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in cells]


def shown(value: float | None, form: str, factor: float = 1.0) -> str:
    """A figure times `factor`, - where there is none."""
    return "-" if value is None else f"{factor * value:{form}}"

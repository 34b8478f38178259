"""Values and intervals over a time that may have more states than a picture has columns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.records import Float64, FloatRows

COLUMNS = 1000  # of a picture; more states than twice as many become ranges
BLOCK = 4096  # rows at once
SHORTEST = 1.0 / 400.0  # share of the axis: an interval is drawn no shorter


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """K columns: middle time (K,) [s], lowest and highest value (K,) of the states in each, NaN where none is."""

    seconds: Float64
    lowest: Float64
    highest: Float64

    @property
    def is_exact(self) -> bool:
        """True where every column is one state."""
        return self.lowest is self.highest


def envelope(seconds: Float64, values: Float64, columns: int = COLUMNS) -> Envelope:
    """The range of values (T,) in each of `columns` equal parts of the time (T,); the values themselves where there
    are no more than two states to a column. A column without a state is left out, as a gap.
    """
    values = np.asarray(values, dtype=np.float64)
    if len(values) <= 2 * columns:
        return Envelope(seconds=seconds, lowest=values, highest=values)
    edges = np.linspace(seconds[0], seconds[-1], columns + 1)
    first = np.searchsorted(seconds, edges[:-1], side="left")
    ends = np.append(first[1:], len(values))
    is_filled = ends > first
    starts = first[is_filled]
    lowest, highest = np.full(columns, np.nan), np.full(columns, np.nan)
    lowest[is_filled], highest[is_filled] = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return Envelope(seconds=0.5 * (edges[:-1] + edges[1:]), lowest=lowest, highest=highest)


def column(rows: FloatRows, number: int) -> Float64:
    """A column (T,) of rows (T, K), which are read a block at a time."""
    parts = [rows[first : first + BLOCK][:, number] for first in range(0, len(rows), BLOCK)]
    return np.concatenate([np.zeros(0), *parts])


def spans(intervals: Sequence[tuple[float, float]], span_s: tuple[float, float]) -> list[tuple[float, float]]:
    """Start and length [s] of intervals (first and last time) as they are drawn over an axis from and to `span_s`:
    none shorter than `SHORTEST`, those that then touch joined.
    """
    least = SHORTEST * (span_s[1] - span_s[0])
    drawn: list[tuple[float, float]] = []
    for start, end in sorted(intervals):
        end = max(end, start + least)  # noqa: PLW2901
        if drawn and start <= drawn[-1][1]:
            drawn[-1] = drawn[-1][0], max(end, drawn[-1][1])
        else:
            drawn.append((start, end))
    return [(start, end - start) for start, end in drawn]

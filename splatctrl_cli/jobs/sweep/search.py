"""Search for a change of outcome over one or several values."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from splatctrl_cli.config.fixed import SWEEP_DIRECTIONS, SWEEP_SAMPLES, SWEEP_SEARCHED

P = TypeVar("P")


@dataclass(frozen=True, kw_only=True)
class Flip(Generic[P]):
    """Change of outcome nearest to the start, between the points `last` and `first`.

    last, first: None without a flip. tried: points by distance from the start. is_monotone: at most one flip was
    found. spacing: largest gap tried before the flip (without one, anywhere).
    """

    start: P
    end: P
    last: P | None
    first: P | None
    tried: Sequence[P]
    is_monotone: bool
    spacing: float


def find_flip(
    judge: Callable[[Sequence[float]], Sequence[str]],
    start: float,
    end: float,
    *,
    tolerance: float,
    is_whole: bool = False,
    is_monotone: bool = False,
) -> Flip[float]:
    """Find the flip nearest to `start`, to within `tolerance` (1 for whole values).

    judge: outcomes of several values, in parallel. It tries the ends and SWEEP_SAMPLES values between, or
    SWEEP_SEARCHED if the outcome may or does change more than once. Then it bisects the nearest pair with different
    outcomes.
    """
    known: dict[float, str] = {}

    def rounded(value: float) -> float:
        return float(round(value)) if is_whole else float(f"{value:.6g}")

    def tried(values: Sequence[float]) -> list[float]:
        """Try new values; return all tried values by distance from the start."""
        new = [value for value in dict.fromkeys(values) if value not in known]
        known.update(zip(new, judge(new), strict=True) if new else ())
        return sorted(known, key=lambda value: abs(value - start))

    def num_changes() -> int:
        is_first = [known[value] == known[start] for value in values]
        return sum(a != b for a, b in itertools.pairwise(is_first))

    searched = [rounded(start + (end - start) * ((k + 1) / (SWEEP_SEARCHED + 1))) for k in range(SWEEP_SEARCHED)]
    sampled = [rounded(start + (end - start) * ((k + 1) / (SWEEP_SAMPLES + 1))) for k in range(SWEEP_SAMPLES)]
    values = tried([start, end, *(sampled if is_monotone else searched)])
    if is_monotone and num_changes() > 1:
        values = tried(searched)
    is_single = num_changes() <= 1
    index = next((k for k, value in enumerate(values) if known[value] != known[start]), None)
    spacing = max([abs(b - a) for a, b in itertools.pairwise(values[:index])], default=0.0)
    last, first = (None, None) if index is None else values[index - 1 : index + 1]
    while (
        last is not None and first is not None and abs(first - last) > (1.0 if is_whole else tolerance) * (1 + 1e-9)
    ):
        middle = rounded((last + first) / 2)
        if middle in (last, first):  # as near as six digits come
            break
        values = tried([middle])
        last, first = (middle, first) if known[middle] == known[start] else (last, middle)
    return Flip(start=start, end=end, last=last, first=first, tried=values, is_monotone=is_single, spacing=spacing)


@dataclass(frozen=True, kw_only=True)
class LeastChange(Generic[P]):
    """Points before and after a flip along one direction.

    length: Euclidean norm of `first`, in shares of the ranges.
    """

    length: float
    last: P
    first: P


Shares = tuple[float, ...]
"""A point, as a share of each range."""


def find_least(
    judge: Callable[[Sequence[Sequence[float]]], Sequence[str]],
    alone: Sequence[float | None],
    *,
    tolerance: float,
) -> LeastChange[Shares] | None:
    """Find the shortest joint change that flips the outcome of (0, ..., 0), or None.

    Points lie in the unit cube. alone: share at which each value alone flips the outcome, or None. It tries the
    diagonal and SWEEP_DIRECTIONS of Halton's sequence. Then it turns the best direction by a quarter and an eighth
    towards and away from each axis. Each direction is tried at the best length, and bisected to `tolerance` if it
    flips.
    """
    num = len(alone)
    start = judge([(0.0,) * num])[0]
    best: LeastChange[Shares] | None = None
    if axes := [(share, k) for k, share in enumerate(alone) if share is not None]:
        share, k = min(axes)
        best = LeastChange(
            last=(0.0,) * num, first=tuple(share if each == k else 0.0 for each in range(num)), length=share
        )

    def improved(way: np.ndarray, best: LeastChange[Shares] | None) -> LeastChange[Shares] | None:
        length = min(1.0 / way.max(), np.inf if best is None else best.length - tolerance)
        if length <= 0 or judge([_point(way, length)])[0] == start:
            return best
        low, high = 0.0, float(length)
        while high - low > tolerance:
            middle = (low + high) / 2
            low, high = (middle, high) if judge([_point(way, middle)])[0] == start else (low, middle)
        return LeastChange(last=_point(way, low), first=_point(way, high), length=high)

    for way in _directions(num):
        best = improved(way, best)
    for turn in (0.25, 0.125):
        if best is not None:
            middle = np.asarray(best.first) / best.length
            for side in [sign * turn * axis for axis in np.eye(num) for sign in (1.0, -1.0)]:
                way = np.maximum(middle + side, 0.0)
                best = improved(way / np.linalg.norm(way), best)
    return best


def _directions(num: int) -> Iterator[np.ndarray]:
    """Non-negative unit vectors (num,): the diagonal, then Halton's points."""
    points = qmc.Halton(num, scramble=False).random(SWEEP_DIRECTIONS + 1)[1:]
    for way in (np.ones(num), *ndtri((1.0 + points) / 2.0)):
        yield way / np.linalg.norm(way)


def _point(way: np.ndarray, length: float) -> Shares:
    return tuple(float(f"{value:.6g}") for value in np.minimum(way * length, 1.0))

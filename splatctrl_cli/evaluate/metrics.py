"""Folds of columns, scales of figures, mean changes; clearances against the truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np

from splatctrl_cli.config.fixed import CLEARANCE_NEAR, MAP_ALLOWANCE
from splatctrl_cli.evaluate.views import seen_by
from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.records import Bool, Float64, FloatRows, RgbdFrame, Stamps


class Better(StrEnum):
    HIGHER = "higher"
    LOWER = "lower"
    NEITHER = "neither"


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Scale of a figure: worsening counts beyond absolute + relative times the earlier value."""

    unit: str = ""
    better: Better = Better.NEITHER
    absolute: float = 0.0
    relative: float = 0.0

    def tolerance(self, before: float) -> float:
        return self.absolute + self.relative * abs(before)

    def harm(self, before: float, after: float) -> float:
        """Worsening from `before` to `after`, negative if better; 0 without a direction."""
        sign = {Better.HIGHER: -1.0, Better.LOWER: 1.0, Better.NEITHER: 0.0}[self.better]
        return sign * (after - before)


DESCRIBES = Scale()
"""A figure that is neither good nor bad."""
GAP = Scale(unit="m", better=Better.HIGHER, absolute=1e-3)  # as far as a map that is being fitted moves in a frame
ERROR = Scale(unit="m", better=Better.LOWER, absolute=1e-3, relative=0.02)
FAULTS = Scale(better=Better.LOWER, relative=0.05)  # 0 must stay 0; of 100, some may cross a limit
BAD_SHARE = Scale(better=Better.LOWER, absolute=0.005, relative=0.02)
GOOD_SHARE = Scale(better=Better.HIGHER, absolute=0.005)
DECIBELS = Scale(unit="dB", better=Better.HIGHER, absolute=0.2)  # spread of four seeds
SIMILARITY = Scale(better=Better.HIGHER, absolute=0.005)
AGE = Scale(unit="s", better=Better.LOWER, absolute=0.01, relative=0.02)
LENGTH, TIME = Scale(unit="m"), Scale(unit="s")


@dataclass(frozen=True, kw_only=True)
class Fold:
    """A rule that makes one value of a column (T,).

    pick: the value that contributes most, "largest" or "least". accumulate: values up to each state, from `start`.
    """

    of: Callable[[Float64], float | None]
    pick: str = "largest"
    start: float = np.nan
    accumulate: Callable[[Float64], Float64] | None = None


def _fold_known(fold: Callable[[Float64], np.floating], values: Float64) -> float | None:
    there = values[~np.isnan(values)]
    return float(fold(there)) if len(there) else None


def least(values: Float64) -> float | None:
    """The smallest finite value, or None."""
    finite = values[np.isfinite(values)]
    return float(finite.min()) if len(finite) else None


def lowest(values: Float64) -> float | None:
    """The least value that is not NaN, perhaps infinite; None without one."""
    return _fold_known(np.min, values)


def largest(values: Float64) -> float | None:
    """The largest value; None if a value is infinite, or all are NaN."""
    there = values[~np.isnan(values)]
    return float(np.max(there)) if len(there) and np.isfinite(there).all() else None


def last(values: Float64) -> float | None:
    """The last finite value, or None."""
    there = values[np.isfinite(values)]
    return float(there[-1]) if len(there) else None


LEAST = Fold(of=least, pick="least", start=np.inf, accumulate=np.fmin.accumulate)
LOWEST = Fold(of=lowest, pick="least", start=np.inf, accumulate=np.fmin.accumulate)
LARGEST = Fold(of=largest, start=-np.inf, accumulate=np.fmax.accumulate)
MEAN, P95 = (Fold(of=partial(_fold_known, fold)) for fold in (np.mean, partial(np.percentile, q=95)))
LAST = Fold(of=last)
TOTAL = Fold(of=lambda values: int(np.nansum(values)))
NUMBER = Fold(of=TOTAL.of, pick="least", start=0.0, accumulate=lambda values: np.asarray(np.nancumsum(values)))


FEWEST = 8  # recordings; fewer have too few different resamples for meaningful percentiles
RESAMPLES = 10_000
CONFIDENCE = 0.95
SEED = 0


@dataclass(frozen=True, kw_only=True)
class MeanChange:
    """The mean of num_pairs differences, and its CONFIDENCE interval."""

    mean: float
    low: float
    high: float
    num_pairs: int


def mean_change(differences: Sequence[float]) -> MeanChange | None:
    """The mean of paired differences with its percentile interval; None below FEWEST pairs.

    The interval is of RESAMPLES draws with replacement, by SEED (Efron and Tibshirani 1993, section 13.3).
    """
    values, num = np.asarray(differences, dtype=np.float64), len(differences)
    if num < FEWEST:
        return None
    means = values[np.random.default_rng(SEED).integers(num, size=(RESAMPLES, num))].mean(axis=1)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return MeanChange(mean=float(values.mean()), low=float(low), high=float(high), num_pairs=num)


FIGURES = ("num_compared", "median", "p95", "largest", "largest_over", "tolerance", "share_within")


def clearance_agreement(
    clearance: Float64, truth: Float64, is_seen: Bool, median_radius: float
) -> dict[str, float | None]:
    """Agreement of clearance with truth (T,) [m], within 10 cm of seen surface.

    By `FIGURES`: number of states; median, 95 % quantile and largest of |clearance - truth|; largest over-estimate;
    tolerance, and share within it. Errors are None without states.
    """
    tolerance = MAP_ALLOWANCE + median_radius
    compared = (truth < CLEARANCE_NEAR) & is_seen & np.isfinite(clearance)
    error = clearance[compared] - truth[compared]
    if not len(error):
        return dict.fromkeys(FIGURES) | {"num_compared": 0, "tolerance": tolerance}
    size = np.abs(error)
    over, share = max(error.max(), 0.0), np.mean(size <= tolerance)
    figures = (len(error), np.median(size), np.percentile(size, 95), size.max(), over, tolerance, share)
    return {
        name: value if name == "num_compared" else float(value) for name, value in zip(FIGURES, figures, strict=True)
    }


def mark_seen(
    seen: Bool, points_world: FloatRows, stamp_ns: Stamps, frame: RgbdFrame, *, has_clock: bool = True
) -> None:
    """Set `seen` (T,) for points [m] that `frame` saw by the point's stamp.

    points_world (T, 3) not yet seen are read in blocks.
    """
    for first in range(0, len(seen), BLOCK):
        part = slice(first, first + BLOCK)
        candidates = first + np.flatnonzero(~seen[part] & ((stamp_ns[part] >= frame.stamp_ns) | (not has_clock)))
        if len(candidates):
            seen[candidates] = seen_by(points_world[candidates], [frame])

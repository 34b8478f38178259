"""A bound on how far a map misses surface, from depth that did not train it: split conformal prediction over time.

Each held-out frame set has one number, its largest miss. Neighbouring sets see the same surface at nearly the same
moment and are not independent, so they are joined to stretches of the misses' autocorrelation time that
begin that long after the one before has ended. A stretch's score is the largest miss in it. Of n scores that are
exchangeable with a new one, the k-th smallest, ``k = ceil((n + 1) * confidence)``, is not exceeded by the new one
with a probability of at least `confidence`, whatever their distribution (Vovk, Gammerman and Shafer 2005; Lei et al.
2018, section 2). There is such a k up to a confidence of ``n / (n + 1)``: that is the one given where more is asked.

What is promised is about a further stretch of the kind that was measured, before any is recorded; it is no
probability for each state. Nothing is said of surface from which the held-out camera returns no depth, of a scene or
a camera that changes between what was measured and what is judged, or of a moment unlike all that were measured:
stretches are only as exchangeable as the scene.
"""

import math
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import FEWEST_STRETCHES
from splatctrl_cli.records import Float64, Index

ROUNDING = 1e-9  # of (n + 1) * confidence, which is a whole number where it should be


@dataclass(frozen=True, kw_only=True)
class ConformalBound:
    """A score [m] that a further stretch does not exceed with `confidence`, from num_stretches of `length` sets each.

    at: the set that decides it, an index into the misses.
    """

    bound: float
    confidence: float
    num_stretches: int
    length: int
    at: int


def conformal_bound(misses: Float64, confidence: float) -> ConformalBound | None:
    """The bound of misses (T,) [m] by time, one a frame set, NaN where a set has none; None where they make fewer
    than FEWEST_STRETCHES stretches. `confidence` is lowered to what their number allows.
    """
    if not np.isfinite(misses).any():
        return None
    length = autocorrelation_time(misses)
    scores, deciding = stretch_scores(misses, stretches(len(misses), length))
    if len(scores) < FEWEST_STRETCHES:
        return None
    allowed = min(confidence, len(scores) / (len(scores) + 1))
    chosen = int(np.argsort(scores, kind="stable")[conformal_rank(len(scores), allowed) - 1])
    return ConformalBound(
        bound=float(scores[chosen]),
        confidence=allowed,
        num_stretches=len(scores),
        length=length,
        at=int(deciding[chosen]),
    )


def conformal_rank(num_scores: int, confidence: float) -> int:
    """Which of n scores, counted from 1 by size, bounds a further one: ``ceil((n + 1) * confidence)``, n + 1 where
    none of them does.
    """
    return math.ceil((num_scores + 1) * confidence - ROUNDING)


def autocorrelation_time(misses: Float64) -> int:
    """Frame sets, at least 1, over which misses (T,) stay alike: ``1 + 2 sum_k rho_k`` up to the first lag k at which
    the autocorrelation rho is not positive (Geyer 1992, its initial sequence by single lags), rounded up.

    NaN takes no part. Misses that do not vary say nothing of time: 1.
    """
    is_there = np.isfinite(misses)
    apart = np.where(is_there, misses, 0.0) - is_there * (np.mean(misses[is_there]) if is_there.any() else 0.0)
    variance = float(apart @ apart) / max(int(is_there.sum()), 1)
    if variance <= np.finfo(np.float64).eps * float(np.max(np.square(misses[is_there]), initial=0.0)):
        return 1
    total = 1.0
    for lag in range(1, len(misses)):
        num = int(np.count_nonzero(is_there[lag:] & is_there[:-lag]))
        covariance = 0.0 if num == 0 else float(apart[lag:] @ apart[:-lag]) / num
        rho = (1 - lag / len(misses)) * covariance / variance  # the biased estimate, where nothing is missing
        if rho <= 0:
            break
        total += 2 * rho
    return math.ceil(total - ROUNDING)


def stretches(num_sets: int, length: int) -> Index:
    """Which stretch (T,) each of the frame sets counts to: one of `length` sets begins `length` sets after the last
    of the one before. The sets in between, and those after the last whole stretch, count to the one before as well:
    that only raises its score, so that no miss is lost, and what holds of stretches without them still holds.
    """
    period = 2 * length - 1
    whole = max((num_sets + period - length) // period, 1)
    return np.minimum(np.arange(num_sets) // period, whole - 1)


def stretch_scores(misses: Float64, stretch: Index) -> tuple[Float64, Index]:
    """The largest miss (n,) of every stretch that has any, and which set (n,) it is of."""
    known = np.flatnonzero(np.isfinite(misses))
    order = known[np.lexsort((-misses[known], stretch[known]))]
    first = order[np.unique(stretch[order], return_index=True)[1]]
    return misses[first], first

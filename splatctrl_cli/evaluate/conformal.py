"""A bound on a map's error from held-out depth: split conformal prediction over time.

A frame set's miss is its largest distance from held-out points to the map. Frame sets form stretches, as long as the
misses' autocorrelation time and as far apart; a stretch's score is its largest miss. If n scores and a new one are
exchangeable, the k-th smallest bounds the new one with probability at least `confidence`. There,
``k = ceil((n + 1) * confidence)`` (Vovk, Gammerman and Shafer 2005; Lei et al. 2018, section 2).

The bound is for a further stretch, not each state, and not for surface without depth, or another scene or camera.
"""

import math
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import FEWEST_STRETCHES
from splatctrl_cli.records import Float64, Index

ROUNDING = 1e-9  # error of (n + 1) * confidence where that is a whole number


@dataclass(frozen=True, kw_only=True)
class ConformalBound:
    """A score [m] that a further stretch does not exceed with `confidence`.

    num_stretches: of `length` frame sets; at: index of the frame set with this score.
    """

    bound: float
    confidence: float
    num_stretches: int
    length: int
    at: int


def conformal_bound(misses: Float64, confidence: float) -> ConformalBound | None:
    """The bound from misses (T,) [m] of frame sets by time, NaN for none.

    None below FEWEST_STRETCHES stretches. n stretches allow a `confidence` up to n / (n + 1).
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
    """Rank of the bounding score, from 1: ``ceil((n + 1) * confidence)``.

    n + 1 if no score bounds.
    """
    return math.ceil((num_scores + 1) * confidence - ROUNDING)


def autocorrelation_time(misses: Float64) -> int:
    """Number of frame sets, at least 1, over which misses (T,) correlate.

    ``1 + 2 sum_k rho_k``, rounded up; the sum ends before the first lag k with autocorrelation rho_k <= 0 (Geyer
    1992, by single lags). NaN is left out; constant misses give 1.
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
        rho = (1 - lag / len(misses)) * covariance / variance  # the biased estimate, if no value is missing
        if rho <= 0:
            break
        total += 2 * rho
    return math.ceil(total - ROUNDING)


def stretches(num_sets: int, length: int) -> Index:
    """Stretch (T,) of each frame set; stretches are `length` sets long and `length` apart.

    Sets between two stretches count to the earlier one, which can only raise its score.
    """
    period = 2 * length - 1
    whole = max((num_sets + period - length) // period, 1)
    return np.minimum(np.arange(num_sets) // period, whole - 1)


def stretch_scores(misses: Float64, stretch: Index) -> tuple[Float64, Index]:
    """Largest miss (n,) of each stretch, and index (n,) of its frame set."""
    known = np.flatnonzero(np.isfinite(misses))
    order = known[np.lexsort((-misses[known], stretch[known]))]
    first = order[np.unique(stretch[order], return_index=True)[1]]
    return misses[first], first

"""A bound on a map's error from held-out depth: split conformal prediction over time.

A frame set's residual is its largest distance from held-out points to the map. Frame sets form blocks, as long as the
residuals' autocorrelation time and as far apart. A block's score is its largest residual. If n scores and a new one
are exchangeable, the k-th smallest bounds the new one with probability at least `confidence`. There,
``k = ceil((n + 1) * confidence)`` (Vovk, Gammerman and Shafer 2005; Lei et al. 2018, section 2).

The bound is for a further block, not each state, and not for surface without depth, or another scene or camera.
"""

import math
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import FEWEST_BLOCKS
from splatctrl_cli.records import Float64, Index

ROUNDING = 1e-9  # error of (n + 1) * confidence where that is a whole number


@dataclass(frozen=True, kw_only=True)
class ConformalBound:
    """A score [m] that a further block does not exceed with `confidence`.

    num_blocks: of `length` frame sets; at: index of the frame set with this score.
    """

    bound: float
    confidence: float
    num_blocks: int
    length: int
    at: int


def conformal_bound(residuals: Float64, confidence: float) -> ConformalBound | None:
    """The bound from residuals (T,) [m] of frame sets by time, NaN for none.

    None below FEWEST_BLOCKS blocks. n blocks allow a `confidence` up to n / (n + 1).
    """
    if not np.isfinite(residuals).any():
        return None
    length = autocorrelation_time(residuals)
    scores, deciding = block_scores(residuals, block_of_sets(len(residuals), length))
    if len(scores) < FEWEST_BLOCKS:
        return None
    allowed = min(confidence, len(scores) / (len(scores) + 1))
    chosen = int(np.argsort(scores, kind="stable")[conformal_rank(len(scores), allowed) - 1])
    return ConformalBound(
        bound=float(scores[chosen]),
        confidence=allowed,
        num_blocks=len(scores),
        length=length,
        at=int(deciding[chosen]),
    )


def conformal_rank(num_scores: int, confidence: float) -> int:
    """Rank of the bounding score, from 1: ``ceil((n + 1) * confidence)``.

    n + 1 if no score bounds.
    """
    return math.ceil((num_scores + 1) * confidence - ROUNDING)


def autocorrelation_time(residuals: Float64) -> int:
    """Number of frame sets, at least 1, over which residuals (T,) correlate.

    ``1 + 2 sum_k rho_k``, rounded up; the sum ends before the first lag k with autocorrelation rho_k <= 0 (Geyer
    1992, by single lags). NaN is left out; constant residuals give 1.
    """
    is_there = np.isfinite(residuals)
    apart = np.where(is_there, residuals, 0.0) - is_there * (np.mean(residuals[is_there]) if is_there.any() else 0.0)
    variance = float(apart @ apart) / max(int(is_there.sum()), 1)
    if variance <= np.finfo(np.float64).eps * float(np.max(np.square(residuals[is_there]), initial=0.0)):
        return 1
    total = 1.0
    for lag in range(1, len(residuals)):
        num = int(np.count_nonzero(is_there[lag:] & is_there[:-lag]))
        covariance = 0.0 if num == 0 else float(apart[lag:] @ apart[:-lag]) / num
        rho = (1 - lag / len(residuals)) * covariance / variance  # the biased estimate, if no value is missing
        if rho <= 0:
            break
        total += 2 * rho
    return math.ceil(total - ROUNDING)


def block_of_sets(num_sets: int, length: int) -> Index:
    """Block (T,) of each frame set; blocks are `length` sets long and `length` apart.

    Sets between two blocks count to the earlier one, which can only raise its score.
    """
    period = 2 * length - 1
    whole = max((num_sets + period - length) // period, 1)
    return np.minimum(np.arange(num_sets) // period, whole - 1)


def block_scores(residuals: Float64, block: Index) -> tuple[Float64, Index]:
    """Largest residual (n,) of each block, and index (n,) of its frame set."""
    known = np.flatnonzero(np.isfinite(residuals))
    order = known[np.lexsort((-residuals[known], block[known]))]
    first = order[np.unique(block[order], return_index=True)[1]]
    return residuals[first], first

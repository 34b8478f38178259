"""Kernels of the Gaussian-process distance field (paper, III-D)."""

from typing import Protocol

import numpy as np

from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.clusters import ClusteredPoints
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import Float64

MAX_TRUNCATION = 0.1
WEIGHT_TRUNCATION = 1e-6  # of a row sum: weights are made once, and 1e-6 of l is below a float's rounding


class Kernel(Protocol):
    """A stationary kernel k(d) and the two things a field needs of it, both in the log domain."""

    @property
    def name(self) -> str: ...

    @property
    def length(self) -> float:
        """l [m]."""
        ...

    def log_row_sums(self, points: ClusteredPoints, *, threads: int) -> Float64:
        """``log sum_j k(p_i, p_j)`` (N,), j = i included."""
        ...

    def truncation_bound(self) -> float:
        """By how much leaving out small terms can raise the distance, at worst [m]."""
        ...

    def offsets(self, radii: Float64, log_weights: Float64) -> Float64:
        """Per-splat offsets (N,) [m] that carry radius and weight into the exponent."""
        ...


class Matern12:
    """``k(d) = exp(-d / l)``, the paper's kernel: its inverse is ``r(o) = -l log o``."""

    name = "matern"

    def __init__(self, length: float, *, truncation: float) -> None:
        self.length = length
        self.truncation = truncation

    def log_row_sums(self, points: ClusteredPoints, *, threads: int = 0) -> Float64:
        """``log sum_j exp(-|p_i - p_j| / l)`` (N,): a log-sum-exp over the points themselves."""
        itself = points.with_offsets(np.zeros(points.num_points))
        at = np.ascontiguousarray(points.centers.T[~points.is_spare])
        score, _ = native.soft_min(itself, self.length, WEIGHT_TRUNCATION, at, threads=threads)
        sums = np.empty(len(score))
        sums[points.source[~points.is_spare]] = -score.astype(np.float64) / self.length
        return sums

    def offsets(self, radii: Float64, log_weights: Float64) -> Float64:
        """``o_i = r_i + l log w_i``, so that the field is the soft minimum of ``|x - p_i| - o_i``."""
        return radii + self.length * log_weights

    def truncation_bound(self) -> float:
        """By how much leaving out small terms can raise the distance, at worst [m]: ``-l log(1 - truncation)``."""
        return -self.length * float(np.log1p(-self.truncation))


def kernel_named(name: str, length: float, truncation: float) -> Matern12:
    """The kernel that the configuration names. Raises UsageError for one that is not there, or a bad length."""
    if not (np.isfinite(length) and length > 0):
        raise UsageError(f"field.length_scale: expected a length above 0 m, got {length}")
    if not 0 < truncation <= MAX_TRUNCATION:
        raise UsageError(f"field.truncation: expected a share above 0, at most {MAX_TRUNCATION}, got {truncation}")
    if name != Matern12.name:
        raise UsageError(f"field.kernel: expected {Matern12.name}, got {name}")
    return Matern12(length, truncation=truncation)

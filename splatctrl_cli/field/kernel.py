"""Kernels of the Gaussian-process distance field (paper, III-D)."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from splatctrl_cli.config.fixed import KERNEL_MAX_SHARE
from splatctrl_cli.field.clusters import ClusteredPoints
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import Float64


class Kernel(Protocol):
    """A stationary kernel k(d) of length scale l [m] with k(0) = 1."""

    @property
    def length(self) -> float: ...

    def value(self, distance: Float64) -> Float64:
        """k(d) for distances of any shape [m]."""
        ...

    def log_row_sums(self, points: ClusteredPoints, *, threads: int = 0) -> Float64:
        """``log sum_j k(|p_i - p_j|)`` (N,), j = i included."""
        ...


@dataclass(frozen=True)
class Matern12:
    """``k(d) = exp(-d / l)``, the paper's kernel: its inverse is ``r(o) = -l log o``."""

    length: float

    def value(self, distance: Float64) -> Float64:
        """k(d)."""
        return np.asarray(np.exp(-distance / self.length))

    def log_row_sums(self, points: ClusteredPoints, *, threads: int = 0) -> Float64:
        """``log sum_j exp(-|p_i - p_j| / l)`` (N,)."""
        return _log_row_sums(points, self.length, is_matern=True, threads=threads)

    def share(self, tolerance: float) -> float:
        """The share of the sum whose loss raises the distance by t [m], ``1 - exp(-t / l)``; 0.01 at most."""
        return min(-float(np.expm1(-tolerance / self.length)), KERNEL_MAX_SHARE)


@dataclass(frozen=True)
class SquaredExponential:
    """``k(d) = exp(-d^2 / (2 l^2))``, the paper's Gaussian kernel: its inverse is ``r(o) = sqrt(-2 l^2 log o)``."""

    length: float

    def value(self, distance: Float64) -> Float64:
        """k(d)."""
        return np.asarray(np.exp(-0.5 * (distance / self.length) ** 2))

    def log_row_sums(self, points: ClusteredPoints, *, threads: int = 0) -> Float64:
        """``log sum_j exp(-|p_i - p_j|^2 / (2 l^2))`` (N,)."""
        return _log_row_sums(points, self.length, is_matern=False, threads=threads)


def _log_row_sums(points: ClusteredPoints, length: float, *, is_matern: bool, threads: int) -> Float64:
    sums = native.row_sums(points.clusters, points.is_point, length, is_matern=is_matern, threads=threads)
    return np.asarray(np.log(points.gathered(sums)))

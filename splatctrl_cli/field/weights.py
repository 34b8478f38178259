"""Kernels of the Gaussian-process distance field, and weights of the splats in it (paper, III-D)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from splatctrl_cli.config.fixed import KERNEL_MAX_SHARE
from splatctrl_cli.field.clusters import ClusteredPoints, Spheres
from splatctrl_cli.field.full_gp import solve_process
from splatctrl_cli.field.voxel_density import voxel_row_sums
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import Float32, Float64


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


NO_LOG = -1e4  # of a weight that is exactly zero: too small to matter, and finite


@dataclass(frozen=True, kw_only=True)
class Weights:
    """w (N,) as ``sign exp(log_size)``: the occupancy is ``o(x) = sum_i w_i k_d(-r_i) k(x, p_i)``.

    Without ``k_d(-r_i)`` for the Gaussian kernel, where radii enter by the shares of the terms. log_size (N,)
    float64; sign (N,) float32 of +-1, None where all are positive; num_iterations and residual of what was solved
    for them, None where nothing was.
    """

    log_size: Float64
    sign: Float32 | None
    num_iterations: int | None = None
    residual: float | None = None


def row_sum_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """``w_i = 1 / (noise + sum_j k(p_i, p_j))``, j = i included: the mass-lumped inverse of eq. 15.

    The diagonal of row sums stands for the kernel matrix, so that M of eq. 12 is ``w_i k_d(-r_i)``.
    """
    return _lumped(kernel.log_row_sums(spheres.points, threads=threads), noise)


def voxel_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """`row_sum_weights` with the sums read from a voxel grid, in time linear in the number of splats (III-D)."""
    return _lumped(np.log(voxel_row_sums(_centers(spheres), kernel.length, kernel.value)), noise)


def process_weights(spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """The full Gaussian process of eq. 8, ``M = (K + noise I)^-1 y``: weights of either sign.

    y is ``k_d(-r)`` for the Matern kernel, and ``w_i = M_i / k_d(-r_i)``; it is 1 for the Gaussian kernel, whose
    ``k_d(-r) = k_d(r)`` loses the radius's sign, and ``w = M``.
    """
    log_values = spheres.radii / kernel.length if isinstance(kernel, Matern12) else np.zeros(len(spheres.radii))
    solution = solve_process(_centers(spheres), log_values, kernel.length, kernel.value, noise)
    is_zero = solution.scaled == 0.0
    size = np.log(np.abs(np.where(is_zero, 1.0, solution.scaled)))
    return Weights(
        log_size=np.where(is_zero, NO_LOG, size + solution.log_scale - log_values),
        sign=np.where(solution.scaled < 0.0, -1.0, 1.0).astype(np.float32),
        num_iterations=solution.num_iterations,
        residual=solution.residual,
    )


Method = Callable[[Spheres, Kernel, float, int], Weights]
METHODS: Mapping[str, Method] = {"rowsum": row_sum_weights, "voxel": voxel_weights, "cg": process_weights}


def weights_named(name: str, spheres: Spheres, kernel: Kernel, noise: float, threads: int) -> Weights:
    """The weights that the configuration names."""
    return METHODS[name](spheres, kernel, noise, threads)


def _lumped(log_sums: Float64, noise: float) -> Weights:
    with np.errstate(divide="ignore"):  # log 0 = -inf is the right log of no noise
        return Weights(log_size=np.asarray(-np.logaddexp(log_sums, np.log(noise))), sign=None)


def _centers(spheres: Spheres) -> Float64:
    """Centres (N, 3) [m] relative to the anchor, as the kernels have them."""
    points = spheres.points
    return np.stack([points.gathered(axis.astype(np.float64)) for axis in points.clusters.centers], axis=1)

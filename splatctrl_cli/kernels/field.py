"""Distances to spheres and on baked grids: typed wrappers.

N spheres as C clusters of `LANES`, in G groups of as many clusters; Q points, (X, Y, Z) cells. float32 wants an
origin near the data.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from splatctrl_cli.kernels import Float32, Float64, Int32, Int64, UInt8, native, num_threads

LANES = 16
BLOCK = 8  # cells of a block along each axis
SPARE_OFFSET = -1e30  # of a spare entry: too far away to be nearest
SPARE_PLACE = 1e15


class Clusters(NamedTuple):
    """Spheres in boxed clusters of 16, and groups of clusters.

    C is a multiple of 16, G of 8; spare ones are far away.
    centers (3, 16 C) [m]; boxes (6, C + G) [m], lower then upper corner, clusters then groups.
    """

    centers: Float32
    boxes: Float32


class Offsets(NamedTuple):
    """Values (16 C,): o of ``|x - p| - o`` [m], or b of ``|x - p|^2 - b`` [m^2]; spare -1e30.

    maxima (C + G,): the largest of clusters, then groups.
    """

    values: Float32
    maxima: Float32


@dataclass(frozen=True, kw_only=True)
class GridSpan:
    """The cells centred at ``origin + voxel (i, j, k)``, i in [first, last), of a grid.

    origin (3,) [m], in the spheres' frame; `first`: a multiple of `BLOCK`; `last`: another, or the grid's end; mask
    (blocks of the grid): zero where a block keeps its values.
    """

    origin: Float64
    voxel: float
    shape: tuple[int, int, int]
    first: int
    last: int
    mask: UInt8 | None = None

    @property
    def shape_of_channel(self) -> tuple[int, int, int]:
        """(last - first, Y, Z)."""
        return (self.last - self.first, self.shape[1], self.shape[2])

    @property
    def arrays(self) -> tuple[Float64, float, Int64, UInt8 | None]:
        sizes = np.array([*self.shape, self.first, self.last], dtype=np.int64)
        return self.origin, self.voxel, sizes, self.mask


@dataclass(frozen=True, kw_only=True)
class LogSumExp:
    """The terms of a kernel field.

    offsets: for culling; exact (16 C,): offsets [m] of Matern, log weights of the Gaussian; radii (16 C,) [m];
    tolerance: largest omitted share of Matern's sum, or largest rise [m] of the Gaussian.
    """

    is_matern: bool
    offsets: Offsets
    exact: Float64
    radii: Float32
    sign: Float32 | None
    length: float
    tolerance: float


def nearest(
    spheres: Clusters, radii: Offsets, points: Float32, *, threads: int = 0
) -> tuple[Float32, Float32, Int32]:
    """``min_i |x - p_i| - r_i`` (Q,), its gradient (Q, 3), 0 at a centre, and entry (Q,)."""
    score, gradient = np.empty(len(points), np.float32), np.empty((len(points), 3), np.float32)
    entry = np.empty(len(points), np.int32)
    native.field_nearest(*spheres, *radii, points, num_threads(threads), score, gradient, entry)
    return score, gradient, entry


def matern(
    spheres: Clusters,
    offsets: Offsets,
    sign: Float32 | None,
    length: float,
    truncation: float,
    points: Float32,
    *,
    threads: int = 0,
) -> tuple[Float32, Float32]:
    """``-l log sum_i c_i exp(-(|x - p_i| - o_i) / l)`` (Q,) and its gradient (Q, 3).

    sign (16 C,): c, 1 if None. Omitted terms are at most the share `truncation` of the sum of sizes: without signs,
    the result rises by at most ``-l log(1 - truncation)``. NaN where the sum is not positive.
    """
    score, gradient = np.empty(len(points), np.float32), np.empty((len(points), 3), np.float32)
    native.field_matern(*spheres, *offsets, sign, length, truncation, points, num_threads(threads), score, gradient)
    return score, gradient


def gaussian(
    spheres: Clusters,
    offsets: Offsets,
    radii: Float32,
    sign: Float32 | None,
    common: float,
    length: float,
    tolerance: float,
    points: Float32,
    *,
    threads: int = 0,
) -> tuple[Float32, Float32]:
    """``sqrt(-2 l^2 L) - sum_i pi_i r_i`` (Q,) and its gradient (Q, 3).

    ``L = log sum_i c_i w_i exp(-|x - p_i|^2 / (2 l^2))``, pi the terms' shares. offsets: ``2 l^2 log w_i - common``
    [m^2]; radii (16 C,) [m]; sign (16 C,): c, 1 if None. Without signs, truncation raises the result by at most
    `tolerance` [m]. NaN unless the root's argument is positive.
    """
    score, gradient = np.empty(len(points), np.float32), np.empty((len(points), 3), np.float32)
    native.field_gaussian(
        *spheres,
        *offsets,
        radii,
        sign,
        common,
        length,
        tolerance,
        points,
        num_threads(threads),
        score,
        gradient,
    )
    return score, gradient


def safe(
    spheres: Clusters,
    offsets: Offsets,
    radii: Offsets,
    sign: Float32 | None,
    common: float,
    length: float,
    tolerance: float,
    anchor: Float64,
    points: Float64,
    *,
    threads: int = 0,
) -> tuple[Float64, Float64] | None:
    """The smaller of `gaussian` and `nearest` (Q,), its gradient (Q, 3); `nearest` if equal or NaN.

    points (Q, 3), in anchor's (3,) frame. None if one is not finite.
    """
    score, gradient = np.empty(len(points)), np.empty((len(points), 3))
    is_finite = native.field_safe(
        *spheres,
        *offsets,
        *radii,
        sign,
        common,
        length,
        tolerance,
        anchor,
        points,
        num_threads(threads),
        score,
        gradient,
    )
    return (score, gradient) if is_finite else None


def row_sums(spheres: Clusters, has_sphere: UInt8, length: float, *, is_matern: bool, threads: int = 0) -> Float64:
    """``sum_j k(p_i, p_j)`` (16 C,) over entries in `has_sphere` (16 C,), j = i included; else 0.

    Terms are rounded to 2^-24 and added as integers.
    """
    total = np.empty(len(has_sphere))
    native.field_density(*spheres, has_sphere, is_matern, length, num_threads(threads), total)
    return total


def bake_hard(
    spheres: Clusters,
    radii: Offsets,
    span: GridSpan,
    distance: Float32,
    gradient: Float32 | None = None,
    entry: Int32 | None = None,
    *,
    threads: int = 0,
) -> None:
    """Write `nearest` at the cells of `span`; gradient is (X, Y, Z, 3)."""
    native.field_bake_hard(*spheres, *radii, *span.arrays, num_threads(threads), distance, gradient, entry)


def bake_kernel(
    spheres: Clusters,
    terms: LogSumExp,
    span: GridSpan,
    distance: Float32,
    gradient: Float32 | None = None,
    *,
    threads: int = 0,
) -> None:
    """Write `matern` or `gaussian` at the cells of `span`.

    Matern: exact are offsets in float64. Gaussian: exact are ``log |w_i|``, offsets ``2 l^2 log |w_i|``.
    """
    bake = native.field_bake_matern if terms.is_matern else native.field_bake_gaussian
    bake(
        *spheres,
        *terms.offsets,
        terms.exact,
        *(() if terms.is_matern else (terms.radii,)),
        terms.sign,
        terms.length,
        terms.tolerance,
        *span.arrays,
        num_threads(threads),
        distance,
        gradient,
    )


def interpolate(values: Float32, origin: Float64, voxel: float, points: Float64) -> tuple[Float64, Float64]:
    """Trilinear value (Q,) and that interpolant's gradient (Q, 3), for points (Q, 3).

    values (X, Y, Z) at ``origin + voxel (i, j, k)``. Outside: the value at the box's nearest point minus the
    distance.
    """
    value, gradient = np.empty(len(points)), np.empty((len(points), 3))
    native.grid_interpolate(values, origin, voxel, points, value, gradient)
    return value, gradient


def lipschitz_bound(values: Float32, origin: Float64, voxel: float, points: Float64) -> Float64:
    """The largest ``value(corner) - |x - corner|`` (Q,) over corners of the cell."""
    bound = np.empty(len(points))
    native.grid_bound(values, origin, voxel, points, bound)
    return bound

"""Distances to spheres and on baked grids: typed wrappers, numpy in, numpy out.

Shapes: N spheres laid out as C clusters of `LANES`, Q points, (X, Y, Z) cells. Frames are the caller's; float32
wants an origin near the data.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import native, num_threads

LANES = 16

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Clusters:
    """Spheres in groups of 16 neighbours, each with its bounding box; spare entries have an offset of -1e30.

    centers (3, 16 C) float32 [m]; bounds (6, C) float32 [m], lower then upper; offsets (16 C,) float32 [m], the o of
    the score ``|x - p| - o``; max_offsets (C,) float32 [m].
    """

    centers: Float32
    bounds: Float32
    offsets: Float32
    max_offsets: Float32


def nearest(spheres: Clusters, points: Float32, *, threads: int = 0) -> tuple[Float32, Float32]:
    """``min_i |x - p_i| - o_i`` (Q,) and its gradient (Q, 3), zero at a centre, for points (Q, 3) float32."""
    score, gradient = np.empty(len(points), np.float32), np.empty((len(points), 3), np.float32)
    native.field_nearest(
        spheres.centers,
        spheres.offsets,
        spheres.bounds,
        spheres.max_offsets,
        points,
        num_threads(threads),
        score,
        gradient,
    )
    return score, gradient


def soft_min(
    spheres: Clusters, length: float, truncation: float, points: Float32, *, threads: int = 0
) -> tuple[Float32, Float32]:
    """``-l log sum_i exp(-(|x - p_i| - o_i) / l)`` (Q,) and its gradient (Q, 3), for points (Q, 3) float32.

    The terms left out are at most the share `truncation` of the sum: too large by at most ``-l log(1 - truncation)``.
    """
    score, gradient = np.empty(len(points), np.float32), np.empty((len(points), 3), np.float32)
    native.field_soft(
        spheres.centers,
        spheres.offsets,
        spheres.bounds,
        spheres.max_offsets,
        length,
        truncation,
        points,
        num_threads(threads),
        score,
        gradient,
    )
    return score, gradient


@dataclass(frozen=True, kw_only=True)
class BakedChannels:
    """float32, per cell: hard, gpdf and their minimum sdf (X, Y, Z); gradient (X, Y, Z, 3), that of sdf."""

    sdf: Float32
    gpdf: Float32
    hard: Float32
    gradient: Float32


def bake(
    hard: Clusters,
    soft: Clusters,
    soft_common_offset: float,
    length: float,
    truncation: float,
    origin: Float64,
    voxel: float,
    shape: tuple[int, int, int],
    *,
    threads: int = 0,
) -> BakedChannels:
    """Both distances at the cell centres ``origin + voxel (i, j, k)``; `hard` and `soft` share centres and bounds.

    soft_common_offset [m] is left out of the offsets of `soft`, and taken off its distance at the end. The terms left
    out make up at most the share `truncation`: gpdf is too large by ``-l log(1 - truncation)`` at most.
    """
    sdf, gpdf, exact = (np.empty(shape, np.float32) for _ in range(3))
    gradient = np.empty((*shape, 3), np.float32)
    native.field_bake(
        hard.centers,
        hard.offsets,
        hard.max_offsets,
        soft.offsets,
        soft.max_offsets,
        hard.bounds,
        soft_common_offset,
        length,
        truncation,
        origin,
        voxel,
        num_threads(threads),
        sdf,
        gpdf,
        exact,
        gradient,
    )
    return BakedChannels(sdf=sdf, gpdf=gpdf, hard=exact, gradient=gradient)


def interpolate(values: Float32, origin: Float64, voxel: float, points: Float64) -> tuple[Float64, Float64]:
    """Trilinear value (Q,) and the gradient (Q, 3) of that interpolant, for points (Q, 3) float64.

    values (X, Y, Z) float32 at the nodes ``origin + voxel (i, j, k)``. Outside: the value at the nearest point of the
    box less the distance to it.
    """
    value, gradient = np.empty(len(points)), np.empty((len(points), 3))
    native.grid_interpolate(values, origin, voxel, points, value, gradient)
    return value, gradient


def lipschitz_bound(values: Float32, origin: Float64, voxel: float, points: Float64) -> Float64:
    """The largest ``value(corner) - |x - corner|`` (Q,) over the corners of each point's cell."""
    bound = np.empty(len(points))
    native.grid_bound(values, origin, voxel, points, bound)
    return bound

"""Queries of many points: views through them, cubes, nearby splats and solids.

Bytes equal tests/reference/points.py, at any thread count.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatctrl_cli.kernels import Bool, Float32, Float64, Floats, Int32, Int64, native


def back_projected(camera: Float64, depth: Float32, chosen: Bool | None = None, num_threads: int = 1) -> Float64:
    """Points (K, 3) [m], world, of chosen (H, W) pixels of depth (H, W) [m], in row order.

    camera (18,): `pack_camera`, with the transform from camera to world.
    """
    points = np.empty((depth.size if chosen is None else int(np.count_nonzero(chosen)), 3))
    pixels = None if chosen is None else np.ascontiguousarray(chosen).view(np.uint8)
    native.back_project(camera, np.ascontiguousarray(depth, np.float32), pixels, points, num_threads)
    return points


def are_inside(
    camera: Float64, depth: Float32, low: Float64, high: Float64, min_range: float, num_threads: int = 1
) -> Bool:
    """Pixels (H, W) whose points lie in a box, low and high (3,) [m], world.

    Their depth is at least `min_range` [m]. camera, depth: as in `back_projected`.
    """
    out = np.empty(depth.shape, np.uint8)
    box = np.array([low, high], np.float64)
    native.mark_inside(camera, np.ascontiguousarray(depth, np.float32), box, min_range, out, num_threads)
    return out.view(bool)


def pixels_at(points: Floats, camera: Float64) -> tuple[Int64, Float32]:
    """Flat pixel indices (N,), -1 outside, and depths (N,) [m] of points (N, 3).

    Points [m], world; camera (18,): `pack_camera`.
    """
    pixel, depth = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
    native.pixels_at(np.ascontiguousarray(points, np.float64), camera, pixel, depth)
    return pixel, depth


def seen_through(
    points: Float32, cameras: Sequence[Float64], nearest: Sequence[Float32], tolerance: float, num_threads: int = 1
) -> Bool:
    """Points (N, 3) [m], world, more than `tolerance` [m] before the depth in some view.

    Views: `pack_camera` cameras (18,), depths (H, W) [m], infinite if none.
    """
    out = np.empty(len(points), np.uint8)
    points = np.ascontiguousarray(points, np.float32)
    native.seen_through(points, list(cameras), list(nearest), tolerance, out, num_threads)
    return out.view(bool)


@dataclass(frozen=True, kw_only=True)
class CubeMeans:
    """Statistics of K cubes ordered by place, x first.

    count (K,); mean center, color, color^2 (K, 3); covariance (K, 6) xx, xy, xz, yy, yz, zz; nearest (K,): first
    point nearest to the mean.
    """

    count: Float64
    center: Float64
    color: Float64
    square: Float64
    covariance: Float64
    nearest: Int64


class Cubes:
    """K occupied cubes of `edge` [m] over points (N, 3) [m]."""

    def __init__(self, points: Float32, edge: float, num_threads: int) -> None:
        self._points, self._num_threads = np.ascontiguousarray(points, np.float32), num_threads
        self._native: Any = native.Cubes(self._points, edge, num_threads)

    def __len__(self) -> int:
        return len(self._native)

    def members(self) -> tuple[Int32, Int64]:
        """Cube (N,) of each point, and first point (K,) of each cube."""
        of_point, first = np.empty(len(self._points), np.int32), np.empty(len(self), np.int64)
        self._native.members(of_point, first, self._num_threads)
        return of_point, first

    def means(self, colors: Float32) -> CubeMeans:
        """Each cube's statistics."""
        num = len(self)
        count, nearest, covariance = np.empty(num), np.empty(num, np.int64), np.empty((num, 6))
        center, color, square = (np.empty((num, 3)) for _ in range(3))
        colors = np.ascontiguousarray(colors, np.float32)
        self._native.measure(
            self._points, colors, count, center, color, square, covariance, nearest, self._num_threads
        )
        return CubeMeans(
            count=count, center=center, color=color, square=square, covariance=covariance, nearest=nearest
        )


class SplatTree:
    """Balls, centers (N, 3), radii (N,) [m]. Raises ValueError for centres not finite."""

    def __init__(self, centers: Float32, radii: Float32, num_threads: int) -> None:
        self._num_threads = num_threads
        self._native: Any = native.SplatTree(np.ascontiguousarray(centers), np.ascontiguousarray(radii))

    def are_further(self, points: Floats, gap: float) -> Bool:
        """Points (K, 3) over `gap` [m] from each of the eight balls with nearest centres."""
        out = np.empty(len(points), np.uint8)
        self._native.are_further(np.ascontiguousarray(points, np.float64), gap, out, self._num_threads)
        return out.view(bool)


def solid_distance(points: Floats, solids: Float64, num_threads: int = 1) -> Float64:
    """Signed distance (N,) [m] of points (N, 3) to solids (P, 16) of `SurfaceScene`.

    Negative inside; infinite without any.
    """
    distance, links = np.empty(len(points)), np.zeros(len(solids), np.int16)
    points = np.ascontiguousarray(points, np.float64)
    native.solid_distance(points, np.ascontiguousarray(solids), links, distance, num_threads)
    return distance

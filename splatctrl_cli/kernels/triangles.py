"""Distances to triangles; the same bytes at any thread count."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import Bool, Float64, Int64, native

INSIDE = 0.5  # winding number above which a point is inside


class TriangleTree:
    """Triangles (F, 3, 3) [m], counter-clockwise from outside; open or in pieces, too."""

    def __init__(self, corners: Float64, num_threads: int = 1) -> None:
        self._num_threads = num_threads
        self._native: Any = native.TriangleTree(np.ascontiguousarray(corners, np.float64))

    def closest(self, points: Float64, bound: Float64 | float = np.inf) -> tuple[Float64, Int64, Float64]:
        """Distance (N,) [m] and number (N,) of the triangle nearest to points (N, 3) [m].

        Also its nearest points, barycentric (N, 3). Beyond `bound` (N,) [m]: infinite, -1, 0.
        """
        points = np.ascontiguousarray(points, np.float64)
        most = np.array(np.broadcast_to(np.float64(bound), len(points)))
        distance, face, shares = np.empty(len(points)), np.empty(len(points), np.int64), np.empty((len(points), 3))
        self._native.closest(points, most, distance, face, shares, self._num_threads)
        return distance, face, shares

    def holds(self, points: Float64) -> Bool:
        """Points (N, 3) [m] more than half surrounded (winding number)."""
        number = np.empty(len(points))
        self._native.winding(np.ascontiguousarray(points, np.float64), number, self._num_threads)
        return np.asarray(number > INSIDE)

    def gaps(
        self, poses: Float64, centers: NDArray[np.floating], radii: NDArray[np.floating]
    ) -> tuple[Float64, Int64]:
        """Signed gap (T,) [m] from the nearest ball to the triangles, negative inside, and that ball's number (T,).

        Balls (N, 3), (N,) [m]; poses (T, 4, 4): from their frame to the triangles'. Infinite and -1 without any.
        """
        gap, ball = np.empty(len(poses)), np.empty(len(poses), np.int64)
        self._native.gaps(
            np.ascontiguousarray(poses[:, :3], np.float64), np.ascontiguousarray(centers, np.float64),
            np.ascontiguousarray(radii, np.float64), gap, ball, self._num_threads,
        )  # fmt: skip
        return gap, ball


def better(
    distance: Float64,
    points: NDArray[np.floating],
    trees: Sequence[TriangleTree],
    poses: Sequence[Float64],
    *,
    within: NDArray[np.floating] | float,
    enough: NDArray[np.floating] | float,
    outside: Bool | None,
    num_threads: int,
) -> None:
    """Lower signed distances (N,) [m] of points (N, 3), in place, where triangles are nearer.

    poses (4, 4): from points to each tree. Triangles beyond `within` (N,) [m] do not count, nor the inside for
    points `outside` (N,). If `enough` (N,) [m] >= 0, any distance on the same side of `enough` and `within` will
    do.
    """
    num = len(distance)
    native.signed_distance(
        [tree._native for tree in trees], np.array(poses, np.float64).reshape(-1, 4, 4)[:, :3].copy(),
        np.ascontiguousarray(points, np.float64), np.full(num, within, np.float64), np.full(num, enough, np.float64),
        np.full(num, 1, np.uint8) if outside is None else (~outside).view(np.uint8), distance, num_threads,
    )  # fmt: skip

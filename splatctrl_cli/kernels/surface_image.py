"""Solids and triangles: rendered depth, and distances; same bytes at any thread count."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatctrl_cli.kernels import Bool, Float32, Float64, Floats, Int16, Int64, native

BOX, CYLINDER, BALL, CAPSULE = 0.0, 1.0, 2.0, 3.0


SurfaceMesh: Any = native.SurfaceMesh
"""SurfaceMesh(corners, links): triangles (F, 3, 3) float64 [m], counter-clockwise seen from outside, in the frames of
links (F,) int16, numbers of at least 0. Corners that triangles of a link share are kept once.
"""


@dataclass(frozen=True, kw_only=True)
class SurfaceScene:
    """Solids (P) in a camera's optical frame and a mesh in link frames (L) [m].

    solids (P, 16): kind, rotation (9) and shift (3) from optical to own frame, size: half edges of a box; radius,
    half length along z, 0 of a cylinder or capsule; radius, 0, 0 of a ball. link_poses (L, 3, 4): link to optical
    frame; solid_links (P,): at least 0.
    """

    solids: Float64
    solid_links: Int16
    mesh: Any
    link_poses: Float64


@dataclass(frozen=True, kw_only=True)
class SurfaceImage:
    """Depth (H, W) [m] of the nearest surface, 0 = none; link (H, W) of it.

    inside (H, W): link of the solid around the measured point. -1 = none.
    """

    depth: Float32
    link: Int16
    inside: Int16


def render_surface(
    scene: SurfaceScene,
    intrinsics: Float64,
    measured: Float32,
    *,
    tolerance: float,
    quadratic: float,
    num_threads: int = 1,
) -> SurfaceImage:
    """Cast a ray through every pixel's centre; intrinsics (6,): fx, fy, cx, cy, width, height.

    measured (H, W) [m], 0 = none: a point is inside a solid if over `tolerance` + `quadratic` depth^2 [m] behind its
    front and before its back; triangles contain none. Solids around the camera and triangles reaching behind it do
    not count.
    """
    shape = (int(intrinsics[5]), int(intrinsics[4]))
    depth, link, inside = np.empty(shape, np.float32), np.empty(shape, np.int16), np.empty(shape, np.int16)
    native.render_surface(
        intrinsics, scene.solids, scene.solid_links, scene.mesh, scene.link_poses, measured,
        tolerance, quadratic, depth, link, inside, num_threads,
    )  # fmt: skip
    return SurfaceImage(depth=depth, link=link, inside=inside)


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

    def gaps(self, poses: Float64, centers: Floats, radii: Floats) -> tuple[Float64, Int64]:
        """Signed gap (T,) [m] from the nearest ball, negative inside, and its number (T,).

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
    points: Floats,
    trees: Sequence[TriangleTree],
    poses: Sequence[Float64],
    *,
    within: Floats | float,
    enough: Floats | float,
    outside: Bool | None,
    num_threads: int,
) -> None:
    """Lower signed distances (N,) [m] of points (N, 3), in place, where triangles are nearer.

    poses (4, 4): from points to each tree. Triangles beyond `within` (N,) [m] do not count, nor the inside for points
    `outside` (N,). With `enough` (N,) [m] >= 0, any distance on the same side of both.
    """
    num = len(distance)
    native.signed_distance(
        [tree._native for tree in trees], np.array(poses, np.float64).reshape(-1, 4, 4)[:, :3].copy(),
        np.ascontiguousarray(points, np.float64), np.full(num, within, np.float64), np.full(num, enough, np.float64),
        np.full(num, 1, np.uint8) if outside is None else (~outside).view(np.uint8), distance, num_threads,
    )  # fmt: skip

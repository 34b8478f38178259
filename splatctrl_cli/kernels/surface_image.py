"""Rendered depth of solids and triangles: typed wrapper."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from splatctrl_cli.kernels import Float32, Float64, Int16, native

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
    """depth (H, W) [m] of the nearest surface, 0 = none; link (H, W) of it.

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

    measured (H, W) [m], 0 = none: a point is inside a solid if over `tolerance` + `quadratic` depth^2 [m] behind
    its front and before its back; triangles contain none. Solids around the camera and triangles that reach behind
    it are not seen.
    """
    shape = (int(intrinsics[5]), int(intrinsics[4]))
    depth, link, inside = np.empty(shape, np.float32), np.empty(shape, np.int16), np.empty(shape, np.int16)
    native.render_surface(
        intrinsics, scene.solids, scene.solid_links, scene.mesh, scene.link_poses, measured,
        tolerance, quadratic, depth, link, inside, num_threads,
    )  # fmt: skip
    return SurfaceImage(depth=depth, link=link, inside=inside)

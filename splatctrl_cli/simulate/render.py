"""Exact RGB-D images of primitives by ray casting: depth at pixel centres, colour from four rays a pixel."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Float32, Float64, Intrinsics, UInt8
from splatctrl_cli.simulate.primitives import Primitive, hit, normals

# Offsets of the rays of a pixel from its centre [px]: the centre (depth) first, then four for colour.
OFFSETS = ((0.0, 0.0), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])  # direction to the light, world
AMBIENT = 0.62


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A fixed camera: T_world_camera (4, 4) of its optical frame; is_training False for scoring only."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: Float64
    is_training: bool


class Renderer:
    """Renders one camera; what never moves is cast once.

    A pixel's ray is scaled to one metre along the optical axis, so that its parameter is the depth. `color_rays` of
    the four make a pixel's colour; with 0 it is that of the depth's ray.
    """

    def __init__(self, camera: Camera, static: Sequence[Primitive], *, color_rays: int = 4) -> None:
        self.camera = camera
        k = camera.intrinsics
        v, u = np.mgrid[: k.height, : k.width].astype(np.float64)
        rays = [
            np.stack([(u + du - k.cx) / k.fx, (v + dv - k.cy) / k.fy, np.ones_like(u)], -1)
            for du, dv in OFFSETS[: 1 + color_rays]
        ]
        self._directions = np.stack(rays) @ camera.T_world_camera[:3, :3].T  # (5, H, W, 3), world
        shape = self._directions.shape[:3]
        self._depth = np.full(shape, np.inf)
        self._color = np.zeros((*shape, 3))
        self._cast(static, self._depth, self._color)

    def image(self, moving: Sequence[Primitive]) -> tuple[UInt8, Float32]:
        """color (H, W, 3) uint8 and depth (H, W) float32 [m], 0 = nothing there, with `moving` in the scene."""
        depth, color = self._depth.copy(), self._color.copy()
        self._cast(moving, depth, color)
        mean = np.mean(color[1:] if len(color) > 1 else color, axis=0)
        at_center = np.where(np.isfinite(depth[0]), depth[0], 0)
        return np.rint(mean * 255).astype(np.uint8), at_center.astype(np.float32)

    def depth(self, moving: Sequence[Primitive]) -> Float32:
        """The same depth alone, without the work for colours."""
        depth = self._depth[:1].copy()
        self._nearest(moving, depth)
        return np.where(np.isfinite(depth[0]), depth[0], 0).astype(np.float32)

    def _cast(self, primitives: Sequence[Primitive], depth: Float64, color: Float64) -> None:
        """Lower `depth` (5, H, W) and set `color` (5, H, W, 3) wherever a primitive is the nearest."""
        origin = self.camera.T_world_camera[:3, 3]
        owner = self._nearest(primitives, depth)
        for index, primitive in enumerate(primitives):
            mine = owner == index
            if mine.any():
                points_world = origin + depth[mine][:, None] * self._directions[mine]
                color[mine] = shaded(primitive, points_world)

    def _nearest(self, primitives: Sequence[Primitive], depth: Float64) -> NDArray[np.int64]:
        """Lower `depth` (K, H, W) of the first K rays of each pixel; which primitive did so last, -1 for none."""
        origin = self.camera.T_world_camera[:3, 3]
        owner = np.full(depth.shape, -1)
        for index, primitive in enumerate(primitives):
            window = self._window(primitive)
            directions = self._directions[: len(depth)][window]
            t = hit(primitive, origin, directions.reshape(-1, 3)).reshape(directions.shape[:3])
            is_nearer = t < depth[window]
            depth[window][is_nearer] = t[is_nearer]
            owner[window][is_nearer] = index
        return owner

    def _window(self, primitive: Primitive) -> tuple[slice, slice, slice]:
        """The rays that could meet the primitive's bounding ball: a conservative rectangle of pixels."""
        k = self.camera.intrinsics
        middle = (invert_transform(self.camera.T_world_camera) @ primitive.T_world_shape[:, 3])[:3]
        radius = primitive.bounding_radius
        everything = slice(None)
        if middle[2] - radius < 0.05:
            return everything, everything, everything
        slices = []
        for axis, focal, center, size in ((1, k.fy, k.cy, k.height), (0, k.fx, k.cx, k.width)):
            ends = [
                (middle[axis] + side * radius) / (middle[2] + end * radius) for side in (-1, 1) for end in (-1, 1)
            ]
            low, high = focal * min(ends) + center - 1, focal * max(ends) + center + 2
            slices.append(slice(int(np.clip(low, 0, size)), int(np.clip(high + 1, 0, size))))
        return everything, slices[0], slices[1]


def shaded(primitive: Primitive, points_world: Float64) -> Float64:
    """RGB (R, 3) in [0, 1] of surface points (R, 3): texture under one distant light, the same from every side."""
    T_shape_world = invert_transform(primitive.T_world_shape)
    points_shape = points_world @ T_shape_world[:3, :3].T + T_shape_world[:3, 3]
    facing = normals(primitive, points_shape) @ (T_shape_world[:3, :3] @ LIGHT)
    light = AMBIENT + (1 - AMBIENT) * np.maximum(facing, 0)
    return np.asarray(primitive.texture.color(points_shape) * light[:, None])

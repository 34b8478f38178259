"""Frames with a known answer: cameras that look straight down at a textured floor, with an optional block on it."""

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.records import Box, Float32, Float64, Intrinsics, RgbdFrame
from splatctrl_cli.scene.buffer import Seeds
from tests.plain import plain_frame

INTRINSICS = Intrinsics(fx=80.0, fy=80.0, cx=39.0, cy=29.5, width=80, height=60)
HEIGHT = 1.0  # [m] of the camera above the floor z = 0
WORKSPACE = Box(lower=np.array([-0.45, -0.35, -0.05]), upper=np.array([0.45, 0.35, 0.6]))


def looking_down(x: float = 0.0, y: float = 0.0) -> Float64:
    """T_world_camera at (x, y, HEIGHT), optical axis down, image right = world x."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = [x, y, HEIGHT]
    return T


def frame(
    stamp_ns: int = 0,
    *,
    block: float = 0.0,
    block_x: float = 0.0,
    x: float = 0.0,
    y: float = 0.0,
    camera: str = "cam0",
) -> RgbdFrame:
    """A smooth texture on the floor; with block > 0 a red block of that height over |x - block_x|, |y| < 0.1 m."""
    v, u = np.mgrid[: INTRINSICS.height, : INTRINSICS.width]

    def ground(depth: float) -> tuple[Float64, Float64]:
        return x + (u - INTRINSICS.cx) / INTRINSICS.fx * depth, y - (v - INTRINSICS.cy) / INTRINSICS.fy * depth

    depth: Float32 = np.full(u.shape, HEIGHT, np.float32)
    X, Y = ground(HEIGHT)
    color = np.stack([0.5 + 0.4 * np.sin(20 * X), 0.5 + 0.4 * np.cos(17 * Y), 0.5 + 0.3 * np.sin(9 * (X + Y))], 2)
    if block > 0:
        top_x, top_y = ground(HEIGHT - block)
        is_block = (np.abs(top_x - block_x) < 0.1) & (np.abs(top_y) < 0.1)
        depth[is_block] = HEIGHT - block
        color[is_block] = [0.9, 0.1, 0.1]
    T_world_camera, pixels = looking_down(x, y), (255 * color).round()
    return plain_frame(depth, INTRINSICS, T_world_camera, stamp_ns=stamp_ns, camera=camera, color=pixels)


def plain_seeds(centers: ArrayLike, radius: float) -> Seeds:
    """Black seeds of one radius."""
    points = np.asarray(centers, np.float32).reshape(-1, 3)
    return Seeds(centers=points, radii=np.full(len(points), radius, np.float32), colors=np.zeros_like(points))

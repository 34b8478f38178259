"""Mean depth of a surface over time, and its depth steps at the robot's outline."""

from dataclasses import replace

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.kernels import native
from splatctrl_cli.records import Bool, Float32, RgbdFrame

Before = tuple[RgbdFrame, Bool] | None
"""A camera's last averaged frame and its object pixels (H, W)."""


def steady_depth(
    frame: RgbdFrame, before: Before, is_object: Bool, config: OccupancyConfig
) -> tuple[RgbdFrame, Bool]:
    """Frame with a running mean of its depth, and its steady pixels (H, W).

    An object pixel is steady if its depth z [m] changed by at most `STEADY_SIGMAS` `depth_error` z^2. Also, depth
    around it changed by at most `STEADY_MOVED` `depth_error` z^2 on average. Only objects are averaged. Without
    `before`, no pixel is steady. If the camera moved, all pixels are steady and none is averaged.
    """
    if before is None or before[1].shape != frame.depth.shape:
        return frame, np.zeros(frame.depth.shape, bool)
    earlier, was_object = before
    if not np.array_equal(earlier.T_world_camera, frame.T_world_camera):
        return frame, np.ones(frame.depth.shape, bool)
    offset = frame.depth - earlier.depth
    error = config.depth_error * frame.depth**2
    is_same = is_object & (earlier.depth > 0) & (np.abs(offset) <= fixed.STEADY_SIGMAS * error)
    side = 2 * round(frame.intrinsics.width / fixed.MASK_EDGE) + 1
    weight = is_same.astype(np.float32)
    total, num = (cv2.boxFilter(image, -1, (side, side), normalize=False) for image in (weight * offset, weight))
    is_same &= np.abs(total) <= fixed.STEADY_MOVED * error * num
    depth = np.where(is_same & was_object, earlier.depth + np.float32(fixed.STEADY_GAIN) * offset, frame.depth)
    return replace(frame, depth=depth), np.asarray(is_same)


def object_twice(frame: RgbdFrame, before: Before, is_steady: Bool) -> Bool:
    """Steady pixels (H, W) that showed an object twice; all steady pixels if the camera moved."""
    if before is None or not np.array_equal(before[0].T_world_camera, frame.T_world_camera):
        return is_steady
    return is_steady & before[1] if before[1].shape == is_steady.shape else is_steady


def surface_steps(
    is_object: Bool, depth: Float32, is_edge: Bool, edge: int, tolerance: Float32, depth_error: float
) -> Float32:
    """Largest depth step (H, W) [m] from each pixel to a neighbour on its surface.

    It is at most `MASK_STEP`. In the robot's outline (is_edge), `edge` pixels wide, object pixels off their plane by
    more than `tolerance` (H, W) [m] get half that distance.

    The plane fits 1 / depth of object pixels beyond the outline, within `MASK_PLANES` widths. It counts if its
    residuals match the sensor (`depth_error` [m] at 1 m) and its variance is at most `MASK_UNSURE` of a pixel's.
    """
    steps = np.full(depth.shape, fixed.MASK_STEP, np.float32)
    beyond, at_edge = is_object & ~is_edge, is_object & is_edge
    residual = (fixed.MASK_SIGMAS * depth_error) ** 2
    for times in fixed.MASK_PLANES:
        native.surface_steps(
            np.ascontiguousarray(depth), tolerance, beyond.view(np.uint8), at_edge.view(np.uint8), times * edge,
            fixed.MASK_UNSURE, residual, steps,
        )  # fmt: skip
    return steps

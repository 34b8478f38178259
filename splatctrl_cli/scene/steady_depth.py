"""Depth averaged over time, for still cameras and surfaces."""

from dataclasses import replace

import cv2
import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import MASK_EDGE, STEADY_GAIN, STEADY_MOVED, STEADY_SIGMAS
from splatctrl_cli.records import Bool, RgbdFrame

Before = tuple[RgbdFrame, Bool] | None
"""A camera's last averaged frame and its object pixels (H, W)."""


def steadied(frame: RgbdFrame, before: Before, is_object: Bool, config: OccupancyConfig) -> tuple[RgbdFrame, Bool]:
    """Frame with a running mean of its depth, and its steady pixels (H, W).

    An object pixel is steady if its depth z [m] changed by at most `STEADY_SIGMAS` `depth_error` z^2. Depths around
    it may change by at most `STEADY_MOVED` `depth_error` z^2 on average. Only what was an object before is averaged.

    Without `before`, no pixel is steady. If the camera moved, depth stays, and all pixels are steady.
    """
    if before is None or before[1].shape != frame.depth.shape:
        return frame, np.zeros(frame.depth.shape, bool)
    earlier, was_object = before
    if not np.array_equal(earlier.T_world_camera, frame.T_world_camera):
        return frame, np.ones(frame.depth.shape, bool)
    offset = frame.depth - earlier.depth
    error = config.depth_error * frame.depth**2
    is_same = is_object & (earlier.depth > 0) & (np.abs(offset) <= STEADY_SIGMAS * error)
    side = 2 * round(frame.intrinsics.width / MASK_EDGE) + 1
    weight = is_same.astype(np.float32)
    total, num = (cv2.boxFilter(image, -1, (side, side), normalize=False) for image in (weight * offset, weight))
    is_same &= np.abs(total) <= STEADY_MOVED * error * num
    depth = np.where(is_same & was_object, earlier.depth + np.float32(STEADY_GAIN) * offset, frame.depth)
    return replace(frame, depth=depth), np.asarray(is_same)


def object_twice(frame: RgbdFrame, before: Before, is_steady: Bool) -> Bool:
    """Steady pixels (H, W) that were object in the last image, too; all of them if the camera moved."""
    if before is None or not np.array_equal(before[0].T_world_camera, frame.T_world_camera):
        return is_steady
    return is_steady & before[1] if before[1].shape == is_steady.shape else is_steady

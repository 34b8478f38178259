"""Depth steps within one surface, at the outline of a robot."""

import numpy as np

from splatctrl_cli.config.fixed import MASK_PLANES, MASK_SIGMAS, MASK_STEP, MASK_UNSURE
from splatctrl_cli.kernels import native
from splatctrl_cli.records import Bool, Float32


def surface_steps(
    is_object: Bool, depth: Float32, is_edge: Bool, edge: int, tolerance: Float32, depth_error: float
) -> Float32:
    """Largest depth step (H, W) [m] from each pixel to a neighbour on its surface.

    It is `MASK_STEP`, except in the robot's outline (is_edge), `edge` pixels wide. An object pixel there, off its
    plane by more than `tolerance` (H, W) [m], gets half that distance, if less.

    The plane fits 1 / depth of object pixels beyond the outline, within `MASK_PLANES` widths. It counts if
    its residuals match the sensor (`depth_error` [m] at 1 m) and its variance is at most `MASK_UNSURE` of a pixel's.
    """
    steps = np.full(depth.shape, MASK_STEP, np.float32)
    beyond, asked = is_object & ~is_edge, is_object & is_edge
    residual = (MASK_SIGMAS * depth_error) ** 2
    for times in MASK_PLANES:
        native.surface_steps(
            np.ascontiguousarray(depth), tolerance, beyond.view(np.uint8), asked.view(np.uint8), times * edge,
            MASK_UNSURE, residual, steps,
        )  # fmt: skip
    return steps

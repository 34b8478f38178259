"""Which neighbouring pixels show one surface, at the outline of a robot."""

import numpy as np

from splatctrl_cli.config.fixed import MASK_PLANES, MASK_SIGMAS, MASK_STEP, MASK_UNSURE
from splatctrl_cli.kernels import native
from splatctrl_cli.records import Bool, Float32


def surface_steps(
    is_object: Bool, depth: Float32, is_edge: Bool, edge: int, tolerance: Float32, depth_error: float
) -> Float32:
    """The largest depth step (H, W) [m] from each pixel to a neighbour on the same surface.

    It is `MASK_STEP`, except at the robot's outline (is_edge), which is `edge` pixels wide. A sensor may measure a
    pixel there anywhere between the robot and the surface behind it. Several such pixels would lead from one to the
    other in small steps. So an object pixel that lies off the plane beside it, by more than its `tolerance` (H, W)
    [m], gets half of that distance where it is less.

    The plane is a least-squares fit of 1 / depth to the object pixels beyond the outline, within each of
    `MASK_PLANES` times its width. It counts where its residuals are those of the sensor (`depth_error` [m] at 1 m)
    and the pixels fix it well enough (`MASK_UNSURE`).
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

"""What a scene puts into space that was seen free: splats in the air, and surfaces before the measured one."""

import math

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.records import Bool, Label, OccupancyGrid, SplatSet

IN_FRONT = 0.03  # [m] by which a rendered depth stands before the measured one: more than sensor noise and radius


def free_mass(splats: SplatSet, grid: OccupancyGrid, free_below: float) -> float:
    """Share of the mass of the splats in voxels that were observed free; nan where there is no mass.

    A splat's mass is its opacity times its radius squared: what it can cover. It is where its centre is. The robot's
    splats are left out: they move through free space. free_below: occupancy under which a seen voxel is free.
    """
    mass = np.where(splats.labels == Label.ROBOT, 0.0, splats.opacities * splats.radii.astype(np.float64) ** 2)
    is_free = (grid.num_updates > 0) & (grid.log_odds < math.log(free_below / (1.0 - free_below)))
    cell = np.floor((splats.centers - grid.origin) / grid.voxel + 0.5)
    is_inside = np.all((cell >= 0) & (cell < is_free.shape), axis=1)
    i, j, k = np.where(is_inside[:, None], cell, 0).astype(np.int64).T
    return float(mass[is_inside & is_free[i, j, k]].sum() / mass.sum()) if mass.sum() > 0 else math.nan


def in_front(depth: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool) -> float:
    """Share of the masked pixels with both depths (H, W) [m] whose `depth` is nearer by more than IN_FRONT.

    nan where no pixel has both.
    """
    both = mask & (depth > 0) & (reference > 0)
    return float(np.mean(depth[both] < reference[both] - IN_FRONT)) if both.any() else math.nan

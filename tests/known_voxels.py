"""What is known of space, for tests that write scenes: a grid with evidence of one time step."""

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.voxels import Balls, KnownVoxels, OccupancyGrid


def known(grid: OccupancyGrid, stamp_ns: int = 0, unrepresented: ArrayLike = (), label: int = 0) -> KnownVoxels:
    """`grid`, what of it was seen at `stamp_ns`, with balls of one label around voxel centres (K, 3) [m]."""
    centers = np.asarray(unrepresented, np.float32).reshape(-1, 3)
    return KnownVoxels(
        grid=grid,
        last_seen=(grid.num_updates > 0).astype(np.uint16),
        step_stamps_ns=np.array([stamp_ns], np.int64),
        unrepresented=Balls.of_voxels(centers, grid.voxel, np.full(len(centers), label, np.uint8)),
    )

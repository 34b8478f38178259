"""How much of a workspace is known: shares of voxels, in words and numbers for people."""

import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.records import Label, OccupancyGrid, VoxelState


def known_space(grid: OccupancyGrid, thresholds: OccupancyConfig) -> dict[str, object]:
    """The size of a grid [m], the share of its voxels in each `VoxelState`, and how many the robot and people are in.

    Names are those of the states, in lower case, as the other commands and files have them.
    """
    states = grid.states(thresholds.free_below, thresholds.occupied_above)
    counts = np.bincount(states.ravel(), minlength=len(VoxelState))
    shares = {state.name.lower(): round(float(counts[state] / states.size), 6) for state in VoxelState}
    return {
        "extent_m": [round(grid.voxel * count, 6) for count in states.shape],
        "free_below": thresholds.free_below,
        "occupied_above": thresholds.occupied_above,
        "share": shares,
        "robot_voxels": int(np.count_nonzero(grid.entity & Label.ROBOT)),
        "human_voxels": int(np.count_nonzero(grid.entity & Label.HUMAN)),
    }

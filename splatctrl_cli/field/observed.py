"""What cameras saw at the cells of a distance grid."""

import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.field.layout import GridLayout
from splatctrl_cli.records import OccupancyGrid, UInt8, VoxelState


def observed_planes(
    occupancy: OccupancyGrid | None, layout: GridLayout, thresholds: OccupancyConfig, first: int, last: int
) -> UInt8:
    """What the occupancy voxel that holds each cell centre says (last - first, Y, Z), a `VoxelState`; x in
    [first, last). Never seen outside the occupancy grid, or without one.
    """
    observed = np.full((last - first, *layout.shape[1:]), VoxelState.NEVER_SEEN, dtype=np.uint8)
    if occupancy is None:
        return observed
    states = occupancy.states(thresholds.free_below, thresholds.occupied_above)
    nodes, inside = [], []
    for axis, cells in enumerate((np.arange(first, last), np.arange(layout.shape[1]), np.arange(layout.shape[2]))):
        centers = layout.origin[axis] + layout.voxel * cells
        node = np.floor((centers - occupancy.origin[axis]) / occupancy.voxel + 0.5).astype(np.int64)
        is_inside = (node >= 0) & (node < states.shape[axis])
        nodes.append(node[is_inside])
        inside.append(np.flatnonzero(is_inside))
    observed[np.ix_(*inside)] = states[np.ix_(*nodes)]
    return observed

"""Never-seen space of a whole grid at once; the package treats slabs."""

from dataclasses import replace

import numpy as np

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.config.ranges import check
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.field.grid_cells import BOUND, Cubes, blank
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.voxels import VoxelState


def apply_unknown(grid: DistanceGrid, policy: str) -> DistanceGrid:
    """Grid with never-seen cells treated by `policy`, and its header updated.

    ``free``: distances from splats alone. ``nan``: no sdf, gradient or probability there. ``obstacle``: solid cubes
    of probability 1; sdf, gradient and bound are of the nearer of splats and cubes. Cells that only the robot swept
    are known (`VoxelState.SWEPT_BY_ROBOT`); space outside is ignored.

    Raises UsageError for another policy, InputError without `observed`, NotEvaluableError if nothing was seen.
    """
    declared = FieldConfig.declared["unknown"]
    check(declared.holds(policy), "field.unknown", declared.expected, policy)
    header = {**grid.header, "unknown": policy}
    if policy == "free":
        return replace(grid, header=header)
    if "observed" not in grid.channels:
        raise InputError(
            "distance grid: no channel 'observed', which field.unknown needs", remedy="bake it with that channel"
        )
    is_unknown = np.asarray(grid.channels["observed"] == VoxelState.NEVER_SEEN)
    if is_unknown.all():
        raise NotEvaluableError(
            f"field.unknown = {policy}: expected a cell that some camera saw, got none of {is_unknown.size}",
            remedy="bake a scene with an occupancy grid, check --box, or set field.unknown = free",
        )
    num_unknown = int(np.count_nonzero(is_unknown))
    if policy == "nan":
        channels, num_changed = blank(grid.channels, is_unknown), num_unknown
    else:
        margin = grid.header.get("bound_margin")
        if not isinstance(margin, float):
            raise InputError("distance grid: header: expected a bound_margin, got none", remedy="bake it again")
        header["bound"] = BOUND
        channels, num_changed = dict(grid.channels), 0
        if num_unknown:
            channels, num_changed = Cubes.of(is_unknown, grid.voxel).join(grid.channels, margin)
    header["unknown_cells"] = {"never_seen": num_unknown, "changed": num_changed}
    return replace(grid, channels=channels, header=header)

"""Whether splats and an occupancy grid are of the same scene."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.config.fixed import OCCUPIED_WITH_SPLATS, SPLATS_ON_SURFACE
from splatctrl_cli.kernels.points import SplatTree
from splatctrl_cli.records import Label, SplatSet
from splatctrl_cli.scene.unrepresented import representing_reach
from splatctrl_cli.voxels import SWEPT, KnownVoxels, VoxelState


@dataclass(frozen=True, kw_only=True)
class GridAgreement:
    """on_surface: share of the num_splats splats of objects and people in or next to a voxel that was seen and is not
    free; represented: share of the num_voxels occupied voxels that a splat or a ball stands for. NaN of none.
    """

    on_surface: float
    represented: float
    num_splats: int
    num_voxels: int

    @property
    def holds(self) -> bool:
        """Whether both shares are what a reconstruction leaves; False where there is nothing to compare."""
        return self.on_surface >= SPLATS_ON_SURFACE and self.represented >= OCCUPIED_WITH_SPLATS


def agreement_with_grid(
    splats: SplatSet, known: KnownVoxels, scene: SceneConfig, occupancy: OccupancyConfig
) -> GridAgreement:
    """How far splats and what is known of voxels agree: for the final map, or a snapshot and its splats.

    Voxels that the robot was in are left out. Either share finds splats in other units or moved; `represented` finds
    splats that were taken away, as balls are only where there were none when the map was written.
    """
    grid = known.grid
    states = grid.states(occupancy.free_below, occupancy.occupied_above)
    others = splats.select(splats.labels != Label.ROBOT)
    cell = np.floor((others.centers.astype(np.float64) - grid.origin) / grid.voxel + 0.5)
    is_inside = np.all((cell >= 0) & (cell < states.shape), axis=1)
    may_hold = maximum_filter(np.isin(states, (VoxelState.OCCUPIED, VoxelState.UNCERTAIN)), size=3)
    on_surface = may_hold[tuple(cell[is_inside].astype(np.int64).T)].sum()
    least = max(
        float(np.log(occupancy.occupied_above / (1 - occupancy.occupied_above))), 1.5 * occupancy.log_odds_hit
    )
    cells = np.argwhere((grid.log_odds > least) & (grid.entity & SWEPT == 0))
    centers = (grid.origin + grid.voxel * cells).astype(np.float32)
    is_missing = SplatTree(splats.centers, splats.radii, 1).are_further(
        centers, representing_reach(scene, grid.voxel)
    )
    if len(known.unrepresented) and is_missing.any():
        distance, _ = cKDTree(known.unrepresented.centers).query(centers[is_missing])
        is_missing[is_missing] = distance > 0.5 * grid.voxel
    return GridAgreement(
        on_surface=float(on_surface / len(others)) if len(others) else np.nan,
        represented=1.0 - float(is_missing.mean()) if len(centers) else np.nan,
        num_splats=len(others),
        num_voxels=len(centers),
    )

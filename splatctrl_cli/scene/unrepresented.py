"""Occupied voxels without a splat, and agreement of splats with a grid."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from splatctrl_cli.config import OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.kernels.points import SplatTree
from splatctrl_cli.records import Bool, Box, Float32, Label, SplatSet
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.voxels import SWEPT, Balls, KnownVoxels, VoxelState, voxels_at


def unrepresented_voxels(occupancy: OccupancyMap, splats: SplatSet, config: SceneConfig, error: float = 0.0) -> Balls:
    """Occupied voxels that no splat represents, as balls labelled human or object.

    A splat represents voxels with centres within `representing_reach` of its sphere, if among their eight nearest
    splats. error [m]: of the sensor. Robot splats do not count: fields leave them out.
    """
    others = splats.select(splats.labels != Label.ROBOT)
    reach = representing_reach(config, occupancy.config.voxel, error)
    voxels = occupancy.occupied_voxels()
    voxels = voxels[~_surely_near(occupancy, others, reach).reshape(-1)[voxels]]
    centers = occupancy.centers_of(voxels)
    is_missing = SplatTree(others.centers, others.radii, occupancy.num_threads).are_further(centers, reach)
    is_human = occupancy.entity.reshape(-1)[voxels[is_missing]] & Label.HUMAN > 0
    return Balls.from_voxels(
        centers[is_missing], occupancy.config.voxel, np.where(is_human, np.uint8(Label.HUMAN), np.uint8(Label.OBJECT))
    )


def confirm_bare(balls: Balls, before: Balls | None) -> Balls:
    """Balls that touch in groups of `BARE_GROUP` or more, or that were found before.

    before: balls of the last time step; None in the first, where all count.
    """
    voxel = 2.0 * balls.radius / 3**0.5
    if before is None or not len(balls):
        return balls
    pairs = cKDTree(balls.centers).query_pairs(1.01 * 3**0.5 * voxel, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(balls), len(balls)))
    group = connected_components(graph, directed=False)[1]
    is_kept = np.bincount(group)[group] >= fixed.BARE_GROUP
    if len(before):
        is_kept |= cKDTree(before.centers).query(balls.centers)[0] < 0.5 * voxel
    return balls.select(is_kept)


def representing_reach(config: SceneConfig, voxel: float, error: float = 0.0) -> float:
    """Largest distance [m] of a voxel's centre from a sphere that represents it.

    It is `max_gap` plus half a voxel plus the sensor's error [m], at most a voxel's diagonal.
    """
    return min(config.max_gap + 0.5 * voxel + error, 3**0.5 * voxel)


def bare_voxels(
    occupancy: OccupancyMap, splats: SplatSet, workspace: Box, config: SceneConfig, half: int | None = None
) -> Float32:
    """Centres (K, 3) [m] of occupied voxels that may be far from all splats, for gap filling.

    `half` 0 or 1 takes every second voxel.
    """
    voxels = occupancy.occupied_voxels()
    voxels = voxels[workspace.contains(occupancy.centers_of(voxels))]
    voxels = voxels if half is None else voxels[half::2]
    is_near = _surely_near(occupancy, splats, config.max_gap + 0.5 * occupancy.config.voxel)
    return occupancy.centers_of(voxels[~is_near.reshape(-1)[voxels]])


def _surely_near(occupancy: OccupancyMap, splats: SplatSet, reach: float) -> Bool:
    """Voxels (X, Y, Z) surely within `reach` [m] of a sphere."""
    voxel, shape = occupancy.config.voxel, occupancy.log_odds.shape
    cells = np.floor((splats.centers - occupancy.origin) / voxel + 0.5).astype(np.int64)
    is_inner = np.all((cells > 0) & (cells < np.array(shape) - 1), axis=1)  # with all neighbours inside
    home, radii = np.ravel_multi_index(tuple(cells[is_inner].T), shape), splats.radii[is_inner]
    is_near = np.zeros(shape, bool)
    for step in itertools.product((-1, 0, 1), repeat=3):
        farthest = voxel * math.dist(step, [0.5 if s < 0 else -0.5 for s in step])
        offset = (step[0] * shape[1] + step[1]) * shape[2] + step[2]
        is_near.reshape(-1)[home[radii >= farthest + 1e-6 - reach] + offset] = True
    return is_near


@dataclass(frozen=True, kw_only=True)
class GridAgreement:
    """Agreement of splats with a grid; NaN without splats or voxels.

    on_surface: share of object and human splats in seen space that are in or next to an occupied or uncertain voxel.
    represented: share of num_voxels occupied voxels with a splat or ball.
    """

    on_surface: float
    represented: float
    num_splats: int
    num_voxels: int

    @property
    def holds(self) -> bool:
        """True if both shares reach their limits; False if one is NaN."""
        return self.on_surface >= fixed.SPLATS_ON_SURFACE and self.represented >= fixed.OCCUPIED_WITH_SPLATS


def agreement_with_grid(
    splats: SplatSet, known: KnownVoxels, scene: SceneConfig, occupancy: OccupancyConfig
) -> GridAgreement:
    """Agreement of splats with the voxels of their map or snapshot.

    Swept voxels are left out.
    """
    grid = known.grid
    states = grid.states(occupancy.free_below, occupancy.occupied_above)
    others = splats.select(splats.labels != Label.ROBOT)
    places, is_inside = voxels_at(others.centers.astype(np.float64), grid.origin, grid.voxel, states.shape)
    cells = tuple(places[is_inside].T)
    may_hold = maximum_filter(np.isin(states, (VoxelState.OCCUPIED, VoxelState.UNCERTAIN)), size=3)
    was_seen = maximum_filter(states != VoxelState.NEVER_SEEN, size=3)  # not so beyond the depth range
    num_told = was_seen[cells].sum() + np.count_nonzero(~is_inside)
    least = max(
        float(np.log(occupancy.occupied_above / (1 - occupancy.occupied_above))), 1.5 * occupancy.log_odds_hit
    )
    occupied = np.argwhere((grid.log_odds > least) & (grid.entity & SWEPT == 0))
    centers = (grid.origin + grid.voxel * occupied).astype(np.float32)
    is_missing = SplatTree(splats.centers, splats.radii, 1).are_further(
        centers, representing_reach(scene, grid.voxel)
    )
    if len(known.unrepresented) and is_missing.any():
        distance, _ = cKDTree(known.unrepresented.centers).query(centers[is_missing])
        is_missing[is_missing] = distance > 0.5 * grid.voxel
    return GridAgreement(
        on_surface=float(may_hold[cells].sum() / num_told) if num_told else np.nan,
        represented=1.0 - float(is_missing.mean()) if len(centers) else np.nan,
        num_splats=len(others),
        num_voxels=len(centers),
    )

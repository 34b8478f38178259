from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.field.grid_cells import Cubes, GridField
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Bool, Box, DistanceGrid, Float64
from splatctrl_cli.voxels import OccupancyGrid, VoxelState
from tests.field.scenes import cloud, queries, splat_set
from tests.reference.unknown import apply_unknown
from tests.refused import expect_refusal

BOX = Box(lower=np.full(3, -0.4), upper=np.full(3, 0.4))
CHANNELS = ("sdf", "gradient", "bound", "observed", "probability", "label")


def cube_distance(points: Float64, centers: Float64, voxel: float) -> Float64:
    """Distance (Q,) to the nearest of cubes (M, 3) of side `voxel`, of every pair."""
    gap = np.maximum(np.abs(points[:, None] - centers[None]) - voxel / 2, 0.0)
    return np.asarray(np.sqrt(np.einsum("qmi,qmi->qm", gap, gap)).min(axis=1))


def cell_centers(grid: DistanceGrid, chosen: Bool) -> Float64:
    return np.asarray(grid.origin + grid.voxel * np.argwhere(chosen))


@pytest.fixture(scope="module")
def grid() -> DistanceGrid:
    """Never seen below z = -0.2 and in a corner; a cell that only the robot was in stands in the corner."""
    states = np.full((21, 21, 21), VoxelState.FREE, np.uint8)
    states[:, :, :5] = VoxelState.NEVER_SEEN
    states[15:, 15:, 12:] = VoxelState.NEVER_SEEN
    states[18, 18, 16] = VoxelState.SWEPT_BY_ROBOT
    return bake(
        splat_set(*cloud()),
        BOX,
        FieldConfig(voxel=0.04),
        channels=CHANNELS,
        occupancy=OccupancyGrid.from_states(BOX.lower, 0.04, states),
    )


@pytest.fixture(scope="module")
def is_unknown(grid: DistanceGrid) -> Bool:
    return np.asarray(grid.channels["observed"] == VoxelState.NEVER_SEEN)


@pytest.fixture(scope="module")
def solid(grid: DistanceGrid) -> DistanceGrid:
    return apply_unknown(grid, "obstacle")


@pytest.mark.parametrize("policy", ["free", "obstacle", "nan"])
def test_nothing_changes_where_the_unknown_is_free_or_all_was_seen(grid: DistanceGrid, policy: str) -> None:
    seen = {**grid.channels, "observed": np.ones_like(grid.channels["observed"])}
    before = grid if policy == "free" else replace(grid, channels=seen)
    after = apply_unknown(before, policy)
    assert after.header["unknown"] == policy
    assert policy == "free" or after.header["unknown_cells"] == {"never_seen": 0, "changed": 0}
    for name, values in before.channels.items():
        np.testing.assert_array_equal(after.channels[name], values)


def test_nan_blanks_never_seen_cells_and_no_other(grid: DistanceGrid, is_unknown: Bool) -> None:
    blanked = apply_unknown(grid, "nan")
    assert 0 < is_unknown.sum() < is_unknown.size
    for name in ("sdf", "probability"):
        np.testing.assert_array_equal(np.isnan(blanked.channels[name]), is_unknown)
        np.testing.assert_array_equal(blanked.channels[name][~is_unknown], grid.channels[name][~is_unknown])
    np.testing.assert_array_equal(np.isnan(blanked.channels["gradient"]).all(axis=-1), is_unknown)
    np.testing.assert_array_equal(blanked.channels["bound"], grid.channels["bound"])
    assert not is_unknown[18, 18, 16]
    assert blanked.header["unknown_cells"] == {"never_seen": int(is_unknown.sum()), "changed": int(is_unknown.sum())}


def test_an_obstacle_distance_is_never_beyond_the_nearest_never_seen_cube(
    grid: DistanceGrid, is_unknown: Bool, solid: DistanceGrid
) -> None:
    exact = cube_distance(cell_centers(grid, ~is_unknown)[::7], cell_centers(grid, is_unknown), grid.voxel)
    sdf = solid.channels["sdf"][~is_unknown][::7]
    before = grid.channels["sdf"][~is_unknown][::7]
    assert (sdf <= np.minimum(before, exact)).all()
    assert (sdf >= np.minimum(before, exact - 0.5 * np.sqrt(3) * grid.voxel)).all()
    touching = exact < 0.51 * grid.voxel
    np.testing.assert_allclose(sdf[touching], np.minimum(before, exact)[touching], atol=2e-6)
    assert (solid.channels["sdf"][is_unknown] < 0).all()
    assert (solid.channels["probability"][is_unknown] == 1).all()
    changed = int((solid.channels["sdf"] != grid.channels["sdf"]).sum())
    assert solid.header["unknown_cells"] == {"never_seen": int(is_unknown.sum()), "changed": changed}


def test_inside_the_unknown_the_distance_is_at_least_as_deep_as_the_way_out(
    grid: DistanceGrid, is_unknown: Bool
) -> None:
    found = Cubes.of(is_unknown, grid.voxel)
    depth = cube_distance(cell_centers(grid, is_unknown)[::3], cell_centers(grid, ~is_unknown), grid.voxel)
    assert (found.distance[is_unknown][::3] <= -depth).all()
    np.testing.assert_allclose(np.linalg.norm(found.away, axis=-1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(found.away[10, 10, 4], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(found.away[10, 10, 5], [0, 0, 1], atol=1e-6)


def test_the_bound_certifies_splats_and_never_seen_cells(
    grid: DistanceGrid, is_unknown: Bool, solid: DistanceGrid
) -> None:
    points = queries(1500, extent=0.4)
    hard, _ = SphereField(Spheres.of(*cloud())).query(points)
    certified = GridField(solid).certified(points)
    assert (certified <= np.minimum(hard, cube_distance(points, cell_centers(grid, is_unknown), grid.voxel))).all()
    assert (certified < GridField(grid).certified(points) - 1e-3).any()
    for name in CHANNELS:
        assert solid.channels[name].dtype == grid.channels[name].dtype and np.isfinite(solid.channels[name]).all()


def test_a_grid_with_blank_cells_says_so_at_every_point_beside_one(grid: DistanceGrid, is_unknown: Bool) -> None:
    field, before = GridField(apply_unknown(grid, "nan")), GridField(grid)
    points = queries(2000, extent=0.4)
    corner = np.floor((points - grid.origin) / grid.voxel).astype(int)
    steps = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(8, 3)
    beside = np.any([is_unknown[tuple((corner + step).T)] for step in steps], axis=0)
    assert 0 < beside.sum() < len(points)
    for got, free in (
        (field.query(points)[0], before.query(points)[0]),
        (field.certified(points), before.certified(points)),
    ):
        np.testing.assert_array_equal(np.isnan(got), beside)
        np.testing.assert_array_equal(got[~beside], free[~beside])


def test_what_cannot_be_applied_is_refused_in_words(grid: DistanceGrid) -> None:
    expect_refusal(
        r"field.unknown: expected free, obstacle or nan, got 'air'", apply_unknown, grid, "air", error=UsageError
    )
    expect_refusal(
        "no channel 'observed'", apply_unknown, replace(grid, channels={"sdf": grid.channels["sdf"]}), "nan"
    )
    never = {**grid.channels, "observed": np.zeros_like(grid.channels["observed"])}
    expect_refusal(
        "expected a cell that some camera saw, got none of 9261",
        apply_unknown,
        replace(grid, channels=never),
        "obstacle",
        error=NotEvaluableError,
    )

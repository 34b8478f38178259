import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.field.grid_cells import GridField
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Box, DistanceGrid
from tests.field.scenes import cloud, queries, splat_set
from tests.refused import expect_refusal

BOX = Box(lower=np.full(3, -0.4), upper=np.full(3, 0.4))


@pytest.fixture(scope="module")
def grid() -> DistanceGrid:
    return bake(splat_set(*cloud()), BOX, FieldConfig(voxel=0.04), channels=("sdf", "hard", "bound"))


def test_at_a_cell_centre_the_field_is_the_cell(grid: DistanceGrid) -> None:
    cells = np.array([[0, 0, 0], [3, 7, 11], [20, 20, 20]])
    for channel in ("sdf", "hard"):
        distance, _ = GridField(grid, channel).query(grid.origin + grid.voxel * cells)
        np.testing.assert_allclose(distance, grid.channels[channel][tuple(cells.T)], atol=1e-7)


def test_gradient_is_that_of_the_interpolant(grid: DistanceGrid) -> None:
    field, step = GridField(grid), 1e-6
    points = queries(200, extent=0.6)  # some outside the grid
    node = (points - grid.origin) / grid.voxel
    points = points[np.abs(node - np.round(node)).min(axis=1) > 1e-3]  # the interpolant has kinks between cells
    assert 20 < np.count_nonzero(field.box.contains(points)) < len(points)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (field.query(points + shift)[0] - field.query(points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(field.query(points)[1][:, axis], slope, atol=1e-5)


def test_outside_the_grid_the_distance_is_a_lower_bound(grid: DistanceGrid) -> None:
    outside = queries(500, extent=1.0)
    outside = outside[~GridField(grid).box.contains(outside)]
    hard, _ = SphereField(Spheres.of(*cloud())).query(outside)
    np.testing.assert_array_less(GridField(grid, "sdf").query(outside)[0], hard)


def test_certified_distance_never_exceeds_the_exact_one(grid: DistanceGrid) -> None:
    points = queries(3000, extent=0.6)
    hard, _ = SphereField(Spheres.of(*cloud())).query(points)
    certified = GridField(grid).certified(points)
    assert (certified <= hard).all()
    inside = GridField(grid).box.contains(points)
    assert (certified[inside] > hard[inside] - np.sqrt(3) * grid.voxel).all()
    interpolated, _ = GridField(grid, "hard").query(points)
    assert (interpolated > hard).any()  # which is why it is needed


def test_bad_grids_and_channels_are_named(grid: DistanceGrid) -> None:
    expect_refusal("no channel 'se'; it has: sdf, bound, hard", GridField, grid, "se")
    flat = {name: values[:1] for name, values in grid.channels.items()}
    expect_refusal(
        "at least 2 cells", GridField, DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=flat, header={})
    )

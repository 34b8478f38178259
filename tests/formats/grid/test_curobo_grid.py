"""The index arithmetic here is cuRobo's, as its source has it (NVlabs/curobo); cuRobo itself was not run.

0.7.5 to 0.7.7: src/curobo/geom/types.py, VoxelGrid.get_grid_shape, and src/curobo/curobolib/cpp/sphere_obb_kernel.cu,
compute_voxel_index.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.grid.planner_grids import write_curobo
from splatctrl_cli.records import DistanceGrid
from tests.formats.grid.make_grid import HEADER, centers, random_grid, with_unknown

f32 = np.float32


def loaded(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as content:
        return dict(content)


def host_shape_07(dims: list[float], voxel: float) -> list[int]:
    def robust_floor(x: float) -> int:
        return round(x) if abs(x - round(x)) < 1e-4 else math.floor(x)

    return [1 + robust_floor(x * (1.0 / voxel)) for x in dims]


def kernel_07(file: dict[str, Any], points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(Q, 3) cells and (Q,) what a sphere's centre reads there, in float32 throughout."""
    dims, inverse = file["dims"].astype(f32), f32(1.0) / f32(file["voxel_size"])
    local = points.astype(f32) - file["pose"][:3].astype(f32)
    exact = dims * inverse
    nearest = np.round(exact)
    shape = (np.where(exact - nearest >= f32(1e-4), np.floor(exact), nearest) + 1).astype(int)
    cells = ((local + f32(0.5) * dims) * inverse).astype(int)  # truncates, as make_int3 does
    flat = cells[:, 0] * shape[1] * shape[2] + cells[:, 1] * shape[2] + cells[:, 2]
    is_inside = ((cells > 2) & (cells < shape - 2)).all(axis=1)
    return cells, np.where(is_inside, file["features"][np.where(is_inside, flat, 0)], f32(-1000.0))


def hostile_grids() -> list[DistanceGrid]:
    """Voxels and sizes at which a product of floats falls short of a whole number; odd and even sides."""
    grids = []
    for voxel, shape in (
        (0.02, (9, 10, 11)),
        (0.1, (8, 29, 7)),
        (0.015, (13, 7, 58)),
        (1 / 3, (10, 11, 6)),
        (0.7, (7, 8, 9)),
    ):
        grid = random_grid("sdf", shape=shape)
        origin = np.array([1.7, -2.3, 0.01])
        grids.append(DistanceGrid(origin=origin, voxel=voxel, channels=grid.channels, header=dict(HEADER)))
    return grids


@pytest.mark.parametrize("grid", hostile_grids(), ids=lambda grid: f"{grid.voxel:.3g}")
def test_0_7_reads_the_value_of_the_cell_that_a_centre_lies_in(tmp_path: Path, grid: DistanceGrid) -> None:
    write_curobo(tmp_path / "field.curobo.npz", grid)
    file = loaded(tmp_path / "field.curobo.npz")
    shape = grid.channels["sdf"].shape
    assert host_shape_07(file["dims"].tolist(), float(file["voxel_size"])) == list(shape) == file["shape"].tolist()
    assert (json.loads(str(file["header"])), file["pose"][3:].tolist()) == (HEADER, [1.0, 0.0, 0.0, 0.0])
    assert (file["features"].dtype, file["features"].shape) == (np.float32, (math.prod(shape),))
    points = centers(grid).reshape(-1, 3)
    expected = np.array(list(np.ndindex(shape)))
    for offset in (0.0, 0.45, -0.45):
        cells, values = kernel_07(file, points + offset * grid.voxel)
        np.testing.assert_array_equal(cells, expected)
        is_read = ((expected > 2) & (expected < np.array(shape) - 2)).all(axis=1)
        np.testing.assert_array_equal(values[is_read], -grid.channels["sdf"].ravel()[is_read])
        assert is_read.any()
        assert (values[~is_read] == -1000.0).all(), "as the docs say: free"


def test_what_curobo_cannot_take_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "field.curobo.npz"
    with pytest.raises(InputError, match=r"got NaN; bake with field.unknown=obstacle or free"):
        write_curobo(path, with_unknown(random_grid()))
    assert not path.exists()

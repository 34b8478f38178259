"""The index arithmetic here is cuRobo's, as its source has it (NVlabs/curobo); cuRobo itself was not run.

0.7.5 to 0.7.7: src/curobo/geom/types.py, VoxelGrid.get_grid_shape, and src/curobo/curobolib/cpp/sphere_obb_kernel.cu,
compute_voxel_index. 0.8: curobo/_src/geom/types.py, and sample_voxel_sdf_with_grad of
curobo/_src/geom/data/data_voxel.py.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.grid_files.planner_grids import round_down, write_curobo
from splatctrl_cli.records import DistanceGrid
from tests.grid_files.make_grid import HEADER, centers, random_grid, with_unknown

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


def kernel_08(file: dict[str, Any], points: NDArray[np.float64]) -> NDArray[np.float32]:
    """(Q,) trilinear in float32, of the corners that are inside; 100 where none is."""
    shape = (file["dims"].astype(f32) / f32(file["voxel_size"])).astype(int)  # truncates, as wp.int32 does
    assert file["features"].dtype == np.float16
    features = file["features"].reshape(shape).astype(f32)
    local = points.astype(f32) - file["pose"][:3].astype(f32)
    v = local * (f32(1.0) / f32(file["voxel_size"])) + shape.astype(f32) * f32(0.5) - f32(0.5)
    low = np.floor(v).astype(int)
    total, weights = np.zeros(len(v), f32), np.zeros(len(v), f32)
    for corner in np.ndindex(2, 2, 2):
        cell = low + corner
        weight = np.where(corner, v - low, 1 - (v - low)).prod(axis=1).astype(f32)
        weight *= ((cell >= 0) & (cell < shape)).all(axis=1)
        total += weight * features[tuple(np.clip(cell, 0, shape - 1).T)]
        weights += weight
    return np.where(weights > 0, total / np.where(weights > 0, weights, 1), f32(100.0))


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
        grid = random_grid("sdf", "bound", shape=shape)
        origin = np.array([1.7, -2.3, 0.01])
        grids.append(DistanceGrid(origin=origin, voxel=voxel, channels=grid.channels, header=dict(HEADER)))
    return grids


@pytest.mark.parametrize("grid", hostile_grids(), ids=lambda grid: f"{grid.voxel:.3g}")
def test_0_7_reads_the_value_of_the_cell_that_a_centre_lies_in(tmp_path: Path, grid: DistanceGrid) -> None:
    write_curobo(tmp_path / "field.curobo.npz", grid, version="0.7")
    file = loaded(tmp_path / "field.curobo.npz")
    shape = grid.channels["sdf"].shape
    assert host_shape_07(file["dims"].tolist(), float(file["voxel_size"])) == list(shape) == file["shape"].tolist()
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


@pytest.mark.parametrize("grid", hostile_grids(), ids=lambda grid: f"{grid.voxel:.3g}")
def test_0_8_reads_the_value_at_a_centre_and_never_more(tmp_path: Path, grid: DistanceGrid) -> None:
    write_curobo(tmp_path / "field.curobo.npz", grid, version="0.8", channel="bound")
    file = loaded(tmp_path / "field.curobo.npz")
    shape = grid.channels["sdf"].shape
    assert [round(x / float(file["voxel_size"])) for x in file["dims"].tolist()] == list(shape)
    values = kernel_08(file, centers(grid).reshape(-1, 3))
    expected = grid.channels["bound"].ravel()
    np.testing.assert_allclose(values, expected, atol=2e-3)  # float16 of numbers up to 4
    assert (file["features"].astype(f32) <= expected).all()
    middle = 0.5 * (centers(grid)[2, 3, 4] + centers(grid)[3, 3, 4])
    between = 0.5 * (grid.channels["bound"][2, 3, 4] + grid.channels["bound"][3, 3, 4])
    np.testing.assert_allclose(kernel_08(file, middle[None]), between, atol=2e-3)
    assert kernel_08(file, centers(grid)[:1, 0, 0] - 2 * grid.voxel) == 100.0


def test_float16_is_rounded_towards_less_distance() -> None:
    values = np.concatenate([np.linspace(-3, 3, 1001), [1e9, -65504.0, 0.0, 1e-9]]).astype(np.float32)
    rounded = round_down(values)
    assert (rounded.astype(np.float32) <= values).all()
    assert (np.nextafter(rounded[:-4], np.float16(np.inf)).astype(np.float32) > values[:-4]).all()


def test_the_file_says_what_it_is_for(tmp_path: Path) -> None:
    write_curobo(tmp_path / "a", random_grid())
    file = loaded(tmp_path / "a")
    assert (str(file["curobo"]), str(file["channel"])) == ("0.7", "sdf")
    assert json.loads(str(file["header"])) == HEADER
    assert file["pose"][3:].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_what_curobo_cannot_take_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "field.curobo.npz"
    with pytest.raises(InputError, match=r"got NaN; bake with field.unknown=obstacle or free"):
        write_curobo(path, with_unknown(random_grid()))
    with pytest.raises(UsageError, match=r"cuRobo version 0.6: expected one of 0.7, 0.8"):
        write_curobo(path, random_grid(), version="0.6")
    with pytest.raises(UsageError, match="cuRobo channel observed: expected a distance of the grid: sdf, bound"):
        write_curobo(path, random_grid(), channel="observed")
    assert not path.exists()

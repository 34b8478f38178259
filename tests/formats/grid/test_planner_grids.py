"""Grids for planners: the index arithmetic here is cuRobo's, as its source has it (NVlabs/curobo 0.7.5 to 0.7.7:
src/curobo/geom/types.py, VoxelGrid.get_grid_shape, and src/curobo/curobolib/cpp/sphere_obb_kernel.cu,
compute_voxel_index). `read_from_stream` follows MoveIt's PropagationDistanceField::readFromStream and
VoxelGrid::resize line by line (moveit_core, distance_field; the same in MoveIt 1 and 2). Neither program was run.
"""

import io
import json
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.grid import planner_grids
from splatctrl_cli.formats.grid.planner_grids import read_moveit_head, write_curobo, write_moveit
from splatctrl_cli.records import Bool, DistanceGrid, Float64
from tests.formats.grid.make_grid import HEADER, ball_grid, centers, random_grid, with_unknown

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


def read_from_stream(path: Path) -> tuple[Float64, float, Bool]:
    """Origin, resolution, and (X, Y, Z) which cells are obstacles."""
    stream = io.BytesIO(path.read_bytes())
    words: list[bytes] = []

    def word() -> bytes:  # operator>>: skips white space, stops before the next
        while (byte := stream.read(1)).isspace():
            pass
        found = b""
        while byte and not byte.isspace():
            found, byte = found + byte, stream.read(1)
        stream.seek(-1, io.SEEK_CUR)
        return found

    for name in ("resolution", "size_x", "size_y", "size_z", "origin_x", "origin_y", "origin_z"):
        assert word() == name.encode() + b":"
        words.append(word())
    resolution, *rest = map(float, words)
    per_metre = 1.0 / resolution
    x_cells, y_cells, z_cells = (int(size * per_metre) for size in rest[:3])
    assert stream.read(1) == b"\n"
    content = io.BytesIO(zlib.decompress(stream.read()))
    cells = np.zeros((x_cells, y_cells, z_cells), bool)
    for x in range(x_cells):
        for y in range(y_cells):
            for z in range(0, z_cells, 8):
                byte = content.read(1)[0]
                for zi in range(min(8, z_cells - z)):
                    cells[x, y, z + zi] = byte >> zi & 1
    assert content.read() == b""
    return np.array(rest[3:]), resolution, cells


def touched(grid: DistanceGrid, radius: float) -> Bool:
    """Cells whose cube, seen as the ball around it, a ball around (0.1, 0, 0) reaches."""
    distance = np.linalg.norm(centers(grid) - (0.1, 0.0, 0.0), axis=-1) - radius
    return distance <= np.sqrt(0.75) * grid.voxel + 1e-6


@pytest.mark.parametrize("channels", [("sdf", "bound"), ("sdf", "hard"), ("sdf", "hard", "bound")])
def test_the_cells_that_a_splat_may_reach_into_are_occupied(
    tmp_path: Path, channels: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planner_grids, "CHUNK", 4 * 22 * 23 * 2)
    grid = ball_grid()
    kept = {name: grid.channels[name] for name in channels}
    write_moveit(
        tmp_path / "field.moveit",
        DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=kept, header=grid.header),
    )
    origin, resolution, cells = read_from_stream(tmp_path / "field.moveit")
    assert (origin.tolist(), resolution) == (grid.origin.tolist(), grid.voxel)
    np.testing.assert_array_equal(cells, touched(grid, 0.3))
    assert 0.05 < cells.mean() < 0.5


@pytest.mark.parametrize(
    ("voxel", "shape"), [(0.02, (9, 10, 11)), (0.1, (3, 29, 57)), (0.7, (7, 8, 9)), (1 / 3, (3, 1, 2))]
)
def test_no_rounding_loses_a_cell(tmp_path: Path, voxel: float, shape: tuple[int, int, int]) -> None:
    grid = random_grid(shape=shape)
    grid = DistanceGrid(origin=np.array([1e-5, -2.3, 0.0]), voxel=voxel, channels=grid.channels, header=dict(HEADER))
    write_moveit(tmp_path / "field.moveit", grid)
    origin, _, cells = read_from_stream(tmp_path / "field.moveit")
    assert origin.tolist() == grid.origin.tolist()
    np.testing.assert_array_equal(cells, (grid.channels["bound"] <= 0) | (grid.channels["sdf"] <= 0))


def test_cells_without_a_distance_are_occupied(tmp_path: Path) -> None:
    grid = with_unknown(random_grid())
    grid.channels["bound"] = np.ones_like(grid.channels["bound"])
    write_moveit(tmp_path / "field.moveit", grid)
    cells = read_from_stream(tmp_path / "field.moveit")[2]
    assert cells[np.isnan(grid.channels["sdf"])].all()
    assert not cells[grid.channels["sdf"] > 0].any()


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected the channel bound or hard, got sdf; bake it with one of them"):
        write_moveit(tmp_path / "field.moveit", random_grid("sdf"))
    (tmp_path / "x").write_bytes(b"resolution: 0.1\nsize_x: inf\n")
    with pytest.raises(InputError, match=r"expected 'size_x: NUMBER', got b'size_x: inf"):
        read_moveit_head(tmp_path / "x")

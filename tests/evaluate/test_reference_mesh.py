from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.reference_mesh import compare_with_mesh
from splatctrl_cli.records import DistanceGrid, Float64
from tests.test_mesh_distance import box_distance

SIZE = (0.21, 0.21, 0.21)
HEADER: dict[str, object] = {"bound_margin": 0.017, "health": {"radius": 0.004}}


def box_grid(error: float = 0.0, *, hard_error: float = 0.0, voxel: float = 0.02) -> DistanceGrid:
    """The distance to a box about the origin, off by `error` in sdf and by `hard_error` in bound."""
    axis = -0.4 + voxel * np.arange(round(0.8 / voxel) + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    truth = box_distance(points.reshape(-1, 3), SIZE).reshape(points.shape[:3])
    channels = {
        "sdf": (truth + error).astype(np.float32),
        "bound": (truth + hard_error - 0.017).astype(np.float32),
    }
    return DistanceGrid(origin=np.full(3, -0.4), voxel=voxel, channels=channels, header=dict(HEADER))


def write_box(path: Path, size: tuple[float, float, float] = SIZE, at: Float64 | None = None) -> Path:
    box = trimesh.creation.box(extents=size)
    box.apply_translation(np.zeros(3) if at is None else at)
    box.export(path)
    return path


def test_errors_are_those_of_the_grid_and_hard_comes_back_from_the_bound(tmp_path: Path) -> None:
    compared = compare_with_mesh(box_grid(0.003, hard_error=0.005), write_box(tmp_path / "box.stl"), seed=0)
    assert compared.is_closed
    assert compared.num_faces == 12
    assert compared.num_inside == 11**3
    for name, error in (("sdf", 0.003), ("hard", 0.005)):
        for band in compared.accuracy.everywhere[name]:
            assert band.count > 100
            assert band.mean == pytest.approx(error, abs=1e-6)
            assert band.rmse == pytest.approx(error, abs=1e-6)
    assert compared.accuracy.seen == {}
    assert compared.accuracy.over_estimate.count == compared.num_near
    assert compared.accuracy.over_estimate.allowance == pytest.approx(0.014)
    assert compared.as_dict()["holds"]
    beyond = compare_with_mesh(box_grid(hard_error=0.015), tmp_path / "box.stl", seed=0)
    assert beyond.accuracy.over_estimate.count_beyond == beyond.num_near


def test_points_are_drawn_with_the_seed(tmp_path: Path) -> None:
    path = write_box(tmp_path / "box.stl")
    grid = box_grid()
    grid.channels["sdf"] += np.random.default_rng(0).normal(0, 0.001, grid.channels["sdf"].shape).astype(np.float32)
    one, same, other = (compare_with_mesh(grid, path, seed=seed, max_points=3000) for seed in (5, 5, 6))
    assert one.num_drawn == 3000
    assert one.num_in_reach == 31**3  # 0.305 m on either side
    assert one == same
    assert one.accuracy != other.accuracy


def test_cells_without_a_distance_are_counted_and_left_out(tmp_path: Path) -> None:
    grid = box_grid(0.001)
    grid.channels["sdf"][:20] = np.nan
    compared = compare_with_mesh(grid, write_box(tmp_path / "box.stl"), seed=0)
    assert 0.4 < compared.num_unknown / compared.num_drawn < 0.55
    assert compared.accuracy.everywhere["sdf"][1].rmse == pytest.approx(0.001, abs=1e-6)


def test_an_open_mesh_is_compared_on_both_sides(tmp_path: Path) -> None:
    sheet = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    sheet.export(tmp_path / "sheet.stl")
    grid = box_grid()
    heights = np.abs(-0.4 + 0.02 * np.arange(41))
    grid.channels["sdf"][:] = heights
    grid.channels["bound"][:] = heights - 0.017
    compared = compare_with_mesh(grid, tmp_path / "sheet.stl", seed=0)
    assert not compared.is_closed
    assert compared.num_inside == 0
    assert compared.num_near >= 19 * 41 * 41
    for band in compared.accuracy.everywhere["hard"]:
        assert band.rmse == pytest.approx(0.0, abs=1e-6)


def test_a_mesh_elsewhere_or_a_grid_without_a_bound_is_refused(tmp_path: Path) -> None:
    far = write_box(tmp_path / "far.stl", at=np.array([200.0, 0, 0]))
    with pytest.raises(NotEvaluableError, match=r"far.stl: no cell of the grid lies within 0.2 m.*in metres"):
        compare_with_mesh(box_grid(), far, seed=0)
    bare = box_grid()
    del bare.channels["bound"]
    with pytest.raises(InputError, match="expected a channel hard or bound, got sdf"):
        compare_with_mesh(bare, far, seed=0)
    nameless = box_grid()
    del nameless.header["health"]
    with pytest.raises(InputError, match=r"expected health.radius"):
        compare_with_mesh(nameless, write_box(tmp_path / "box.stl"), seed=0)

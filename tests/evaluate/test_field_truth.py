"""A baked field beside the truth of a simulated log, and beside a mesh."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.field_truth import TrueCells, TruthComparison, compare_with_mesh, compare_with_truth
from splatctrl_cli.records import Box, DistanceGrid, Float64
from tests.evaluate.test_views import wall_frame
from tests.test_mesh_distance import box_distance

HIDDEN, SEEN = -0.3, 0.3  # x of cells: a plate at 1 m hides the wall's left half


def cells(error: float = 0.004) -> TrueCells:
    """At each x, cells at 1, 3, 7 and 15 cm before the wall, behind it, and far away; sdf reads `error` too much."""
    distance = np.tile([0.01, 0.03, 0.07, 0.15, -0.01, 0.5], 2)
    x = np.repeat([HIDDEN, SEEN], 6)
    points = np.stack([x, np.zeros(12), 2.0 - distance], axis=1)
    return TrueCells(
        points=points,
        fields={"sdf": distance + error, "hard": distance.copy()},
        distance=distance,
        surface=np.stack([x, np.zeros(12), np.full(12, 2.0)], axis=1),
    )


def compared(given: TrueCells, workspace: Box | None = None) -> TruthComparison:
    def by_sign(points: Float64, sdf: Float64) -> Float64:
        return (sdf < 0).astype(np.float64)

    return compare_with_truth(
        given,
        [wall_frame()],
        name="truth.json",
        workspace=workspace,
        median_radius=0.01,
        probabilities={"by sign": by_sign},
    )


def test_cells_count_where_a_camera_saw_their_surface() -> None:
    found = compared(cells())
    assert (found.num_drawn, found.num_blank, found.num_near, found.num_seen) == (12, 0, 8, 4)
    assert [band.count for band in found.accuracy.seen["sdf"]] == [1, 1, 1, 1]
    assert [band.count for band in found.accuracy.everywhere["sdf"]] == [2, 2, 2, 2]
    assert all(band.mean == pytest.approx(0.004) for band in found.accuracy.seen["sdf"])
    assert found.error_mean == pytest.approx(0.004) and found.error_sigma == pytest.approx(0.0, abs=1e-12)
    curve = found.reliability["by sign"]
    assert (curve.count.sum(), curve.calibration_error) == (5, 0.0), "a cell behind the surface counts here"


def test_surfaces_outside_the_workspace_do_not_count() -> None:
    found = compared(cells(), Box(lower=np.array([-1.0, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.9])))
    assert (found.num_seen, found.num_outside_workspace, found.reliability) == (0, 4, {})
    assert found.error_mean is None and found.error_sigma is None


def test_cells_without_a_distance_are_blank_and_a_field_of_them_cannot_be_compared() -> None:
    given = cells()
    sdf = given.fields["sdf"].copy()
    sdf[6] = np.nan
    blank = compared(replace(given, fields={**given.fields, "sdf": sdf}))
    assert (blank.num_blank, blank.num_near, blank.num_seen) == (1, 7, 3)
    with pytest.raises(NotEvaluableError, match=r"truth\.json: no cell of the grid lies within 0\.2 m"):
        compared(replace(given, fields={**given.fields, "sdf": np.full(12, np.nan)}))


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

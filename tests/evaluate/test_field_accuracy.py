"""A baked field beside the truth of a simulated log, and beside a mesh; and beside the depth of cameras that did not
train.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config.fixed import ROBOT_MARGIN
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import (
    compare_with_mesh,
    compare_with_truth,
    distance_at,
    field_accuracy,
    grid_distances,
    median_radius,
)
from splatctrl_cli.evaluate.held_out_depth import compare_with_held_out_depth, counted_pixels
from splatctrl_cli.evaluate.views import surface_points
from splatctrl_cli.geometry import back_project, look_at
from splatctrl_cli.records import Bool, Box, DistanceGrid, Float64, Intrinsics, RgbdFrame
from tests.evaluate.test_views import wall_frame
from tests.plain import plain_frame
from tests.refused import expect_refusal
from tests.robot.test_link_meshes import box_distance

TRUTH = np.array([0.01, 0.015, 0.03, 0.07, 0.15, 0.3, -0.01])
SOME = np.array([True, False, True, True, True, True, True])


def test_errors_are_counted_in_the_band_of_the_true_distance() -> None:
    report = field_accuracy(
        {"hard": TRUTH + np.array([0.001, 0.003, -0.002, 0.0, 0.02, 1.0, 1.0]), "gpdf": TRUTH},
        TRUTH,
        SOME,
        median_radius=0.005,
    )
    near, middle, far, farther = report["everywhere"]["hard"]
    assert [band["count"] for band in (near, middle, far, farther)] == [2, 1, 1, 1]
    figures = near["mean"], near["rmse"], near["median"], near["over_max"], middle["over_max"]
    assert figures == pytest.approx((0.002, np.sqrt((1 + 9) / 2) * 1e-3, 0.002, 0.003, -0.002))
    assert (report["seen"]["hard"][0]["count"], report["seen"]["hard"][0]["over_95"]) == (1, pytest.approx(0.001))
    assert report["everywhere"]["gpdf"][3]["rmse"] == 0.0


def test_over_estimate_counts_seen_cells_beyond_a_centimetre_and_the_median_radius() -> None:
    """Without a word on what was seen every point counts."""
    hard = {"hard": TRUTH + np.array([0.0149, 0.5, 0.0, 0.016, 0.019, 9.0, 9.0])}
    report = field_accuracy(hard, TRUTH, SOME, median_radius=0.005)
    *counted, median_beyond, max_error = report["over_estimate"].values()
    assert counted == [0.015, 4, 2, 0.5], "allowance, count, count_beyond, share_beyond"
    assert (median_beyond, max_error) == pytest.approx((0.0025, 0.019)) and not report["holds"]
    every = field_accuracy(hard, TRUTH, None, median_radius=0.005)
    assert (every["seen"], every["over_estimate"]["count"], every["over_estimate"]["count_beyond"]) == ({}, 5, 3)


def test_bands_without_cells_have_no_figures_and_nothing_holds() -> None:
    report = field_accuracy({"hard": np.ones(1)}, np.ones(1), np.array([True]), median_radius=0.0)
    assert report["everywhere"]["hard"][0]["rmse"] is None and report["holds"] is False


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"hard": TRUTH, "gpdf": TRUTH[:3]}, r"gpdf: expected \(7,\) values"),
        ({"gpdf": TRUTH}, "expected one named hard, got gpdf"),
    ],
)
def test_arrays_that_do_not_fit_are_named(fields: dict[str, Float64], words: str) -> None:
    expect_refusal(words, field_accuracy, fields, TRUTH, TRUTH > 0, median_radius=0.0)


def small_grid(header: dict[str, object], **channels: float) -> DistanceGrid:
    arrays = {name: np.full((2, 2, 2), value, np.float32) for name, value in channels.items()}
    return DistanceGrid(origin=np.zeros(3), voxel=0.02, channels=arrays, header=header)


def test_hard_comes_back_from_the_bound_of_a_grid() -> None:
    grid = small_grid({"bound_margin": 0.0175, "health": {"radius": 0.01}}, sdf=0.0, bound=0.083)
    np.testing.assert_allclose(
        distance_at(grid_distances(grid)["hard"], np.array([0, 5])), [0.1005, 0.1005], atol=1e-7
    )
    assert median_radius(grid) == 0.01
    distances = grid_distances(small_grid({}, sdf=0.0, hard=0.083, se=0.0))
    assert list(distances) == ["sdf", "hard", "se"]
    np.testing.assert_array_equal(distance_at(distances["hard"], np.arange(8)), np.float32(0.083))


@pytest.mark.parametrize("header", [{}, {"bound_margin": "wide"}])
def test_a_grid_without_its_bounds_margin_is_refused(header: dict[str, object]) -> None:
    expect_refusal(
        "expected a channel hard or bound, got sdf, bound", grid_distances, small_grid(header, sdf=0.0, bound=0.083)
    )


HIDDEN, SEEN = -0.3, 0.3  # x of cells: a plate at 1 m hides the wall's left half


def cells(error: float = 0.004) -> dict[str, Any]:
    """At each x, cells at 1, 3, 7 and 15 cm before the wall, behind it, and far away; sdf reads `error` too much."""
    distance = np.tile([0.01, 0.03, 0.07, 0.15, -0.01, 0.5], 2)
    x, nothing = np.repeat([HIDDEN, SEEN], 6), np.zeros(12)
    return {
        "points": np.stack([x, nothing, 2.0 - distance], axis=1),
        "fields": {"sdf": distance + error, "hard": distance.copy()},
        "distance": distance,
        "surface": np.stack([x, nothing, nothing + 2.0], axis=1),
    }


def compared(given: dict[str, Any], workspace: Box | None = None) -> dict[str, Any]:
    document, _ = compare_with_truth(
        **given,
        frames=[wall_frame()],
        name="truth.json",
        workspace=workspace,
        median_radius=0.01,
        probabilities={"by sign": lambda points, sdf: (sdf < 0).astype(np.float64)},
    )
    return document


def test_cells_count_where_a_camera_saw_their_surface() -> None:
    """And inside the workspace alone."""
    found = compared(cells())
    assert [found[f"num_{name}"] for name in ("drawn", "blank", "near", "seen")] == [12, 0, 8, 4]
    assert [band["count"] for band in found["seen"]["sdf"]] == [1, 1, 1, 1]
    assert [band["count"] for band in found["everywhere"]["sdf"]] == [2, 2, 2, 2]
    assert [band["mean"] for band in found["seen"]["sdf"]] == pytest.approx([0.004] * 4)
    assert (found["error_mean"], found["error_sigma"]) == (pytest.approx(0.004), pytest.approx(0.0, abs=1e-12))
    curve = found["reliability"]["by sign"]
    assert (curve["count"].sum(), curve["calibration_error"]) == (5, 0.0), "a cell behind the surface counts here"
    none = compared(cells(), Box(lower=np.array([-1.0, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.9])))
    assert (none["num_seen"], none["num_outside_workspace"], none["reliability"]) == (0, 4, {})
    assert (none["error_mean"], none["error_sigma"]) == (None, None)


def test_cells_without_a_distance_are_blank_and_a_field_of_them_cannot_be_compared() -> None:
    given = cells()
    given["fields"]["sdf"][6] = np.nan
    blank = compared(given)
    assert (blank["num_blank"], blank["num_near"], blank["num_seen"]) == (1, 7, 3)
    given["fields"]["sdf"][:] = np.nan
    expect_refusal(r"truth\.json: no cell of the grid lies within 0\.2 m", compared, given, error=NotEvaluableError)


SIZE = (0.21, 0.21, 0.21)
HEADER: dict[str, object] = {"bound_margin": 0.017, "health": {"radius": 0.004}}


def box_grid(error: float = 0.0, *, hard_error: float = 0.0, voxel: float = 0.02) -> DistanceGrid:
    """The distance to a box about the origin, off by `error` in sdf and by `hard_error` in bound."""
    axis = -0.4 + voxel * np.arange(round(0.8 / voxel) + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    truth = box_distance(points.reshape(-1, 3), SIZE).reshape(points.shape[:3])
    channels = {"sdf": (truth + error).astype(np.float32), "bound": (truth + hard_error - 0.017).astype(np.float32)}
    return DistanceGrid(origin=np.full(3, -0.4), voxel=voxel, channels=channels, header=dict(HEADER))


def write_box(path: Path, size: tuple[float, float, float] = SIZE, at: Float64 | None = None) -> Path:
    box = trimesh.creation.box(extents=size)
    box.apply_translation(np.zeros(3) if at is None else at)
    box.export(path)
    return path


def test_errors_are_those_of_the_grid_and_hard_comes_back_from_the_bound(tmp_path: Path) -> None:
    found = compare_with_mesh(box_grid(0.003, hard_error=0.005), write_box(tmp_path / "box.stl"), seed=0)
    assert (found["is_closed"], found["num_faces"], found["num_inside"]) == (True, 12, 11**3)
    for name, error in (("sdf", 0.003), ("hard", 0.005)):
        for band in found["everywhere"][name]:
            assert band["count"] > 100 and (band["mean"], band["rmse"]) == pytest.approx((error, error), abs=1e-6)
    over = found["over_estimate"]
    assert (over["count"], over["allowance"]) == (found["num_near"], pytest.approx(0.014))
    assert found["seen"] == {} and found["holds"]
    beyond = compare_with_mesh(box_grid(hard_error=0.015), tmp_path / "box.stl", seed=0)
    assert beyond["over_estimate"]["count_beyond"] == beyond["num_near"]


def test_points_are_drawn_with_the_seed_and_cells_without_a_distance_are_left_out(tmp_path: Path) -> None:
    path, grid = write_box(tmp_path / "box.stl"), box_grid()
    grid.channels["sdf"] += np.random.default_rng(0).normal(0, 0.001, grid.channels["sdf"].shape).astype(np.float32)
    one, same, other = (compare_with_mesh(grid, path, seed=seed, max_points=3000) for seed in (5, 5, 6))
    assert (one["num_drawn"], one["num_in_reach"]) == (3000, 31**3)  # 0.305 m on either side
    assert one == same and one["everywhere"] != other["everywhere"]
    grid = box_grid(0.001)
    grid.channels["sdf"][:20] = np.nan
    found = compare_with_mesh(grid, path, seed=0)
    assert 0.4 < found["num_unknown"] / found["num_drawn"] < 0.55
    assert found["everywhere"]["sdf"][1]["rmse"] == pytest.approx(0.001, abs=1e-6)


def test_an_open_mesh_is_compared_on_both_sides(tmp_path: Path) -> None:
    trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]).export(
        tmp_path / "sheet.stl"
    )
    grid, heights = box_grid(), np.abs(-0.4 + 0.02 * np.arange(41))
    grid.channels["sdf"][:], grid.channels["bound"][:] = heights, heights - 0.017
    found = compare_with_mesh(grid, tmp_path / "sheet.stl", seed=0)
    assert (found["is_closed"], found["num_inside"]) == (False, 0) and found["num_near"] >= 19 * 41 * 41
    assert [band["rmse"] for band in found["everywhere"]["hard"]] == pytest.approx([0.0] * 4, abs=1e-6)


@pytest.mark.parametrize(
    ("at", "without", "error", "words"),
    [
        (200.0, "", NotEvaluableError, r"box.stl: no cell of the grid lies within 0.2 m.*in metres"),
        (0.0, "bound", InputError, "expected a channel hard or bound, got sdf"),
        (0.0, "health", InputError, "expected health.radius"),
    ],
)
def test_a_mesh_elsewhere_or_a_grid_without_a_bound_is_refused(
    tmp_path: Path, at: float, without: str, error: type[Exception], words: str
) -> None:
    grid = box_grid()
    for part in (grid.channels, grid.header):
        part.pop(without, None)  # type: ignore[attr-defined]
    expect_refusal(
        words, compare_with_mesh, grid, write_box(tmp_path / "box.stl", at=np.array([at, 0, 0])), error=error, seed=0
    )


CAMERA = Intrinsics(fx=200.0, fy=200.0, cx=99.5, cy=79.5, width=200, height=160)
RAYS = back_project(CAMERA, np.ones((160, 200)))


def floor_frame(eye: tuple[float, float, float], target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> RgbdFrame:
    """The floor z = 0, exactly measured from `eye`."""
    T = look_at(np.array(eye), np.array(target), up=(0.0, 1.0, 0.0))
    falls = (RAYS @ T[:3, :3].T)[..., 2]
    return plain_frame(np.where(falls < 0, -T[2, 3] / np.minimum(falls, -1e-9), 0.0), CAMERA, T, camera="held-out")


def height_grid(error: float = 0.0) -> DistanceGrid:
    axis = -0.3 + 0.02 * np.arange(31)
    heights = np.broadcast_to(axis + 0.1, (31, 31, 31))  # z from -0.2 to 0.4
    channels = {"sdf": (heights + error).astype(np.float32), "hard": heights.astype(np.float32)}
    return DistanceGrid(
        origin=np.array([-0.3, -0.3, -0.2]), voxel=0.02, channels=channels, header={"health": {"radius": 0.004}}
    )


def frames() -> list[RgbdFrame]:
    return [floor_frame((0.0, 0.1, 1.2)), floor_frame((0.6, 0.0, 1.0)), floor_frame((-0.4, -0.5, 1.1))]


def held_out(
    grid: DistanceGrid, views: Sequence[RgbdFrame] = (), max_points: int = 4000, **how: Any
) -> dict[str, Any]:
    return compare_with_held_out_depth(grid, [*views] or frames(), max_points=max_points, **{"seed": 0} | how)


def test_a_floor_reads_zero_on_it_and_its_height_before_it() -> None:
    found = held_out(height_grid(0.003))
    assert found["reference"] == "nearest measured depth point"
    assert (found["num_frames"], found["num_unknown"], found["num_edges"]) == (3, 0, 0)
    for name, error in (("sdf", 0.003), ("hard", 0.0)):
        on = found["on_surface"][name]
        assert on["count"] > 1000 and on["mean"] == pytest.approx(error, abs=1e-6)
        for band in found["before"]["seen"][name]:  # pixels on the floor are up to 6 mm apart
            assert band["count"] > 50 and band["mean"] == pytest.approx(error, abs=6e-4)
    assert found["before"]["over_estimate"]["count_beyond"] == 0


def test_a_hidden_surface_is_an_under_estimate_only_where_the_ball_was_seen() -> None:
    """A post that no pixel shows; a ball may meet its rim between two probes."""
    grid, x = height_grid(), -0.3 + 0.02 * np.arange(31)
    post = np.hypot(x[:, None, None] - 0.05, x[None, :, None]) - 0.02
    grid.channels["sdf"] = np.minimum(grid.channels["sdf"], post).astype(np.float32)
    shown = held_out(grid)["before"]
    everywhere, seen = shown["everywhere"]["sdf"][3], shown["seen"]["sdf"][3]
    assert seen["count"] > 0.8 * everywhere["count"] and seen["mean"] < -0.01
    unsure = held_out(grid, [replace(view, depth=np.where(hides_post(view), 0, view.depth)) for view in frames()])[
        "before"
    ]
    everywhere, seen = unsure["everywhere"]["sdf"][3], unsure["seen"]["sdf"][3]
    assert 100 < seen["count"] < everywhere["count"] and seen["rmse"] < 0.005 and everywhere["rmse"] > 0.02


def hides_post(frame: RgbdFrame) -> Bool:
    """Pixels whose ray passes the post of 30 cm."""
    directions, eye = RAYS @ frame.T_world_camera[:3, :3].T, frame.T_world_camera[:3, 3]
    share = (np.arange(0.0, 0.31, 0.01)[:, None, None] - eye[2]) / directions[..., 2]
    at = eye + directions * share[..., None]
    return np.asarray((np.hypot(at[..., 0] - 0.05, at[..., 1]) < 0.02).any(axis=0))


def test_masked_pixels_and_edges_measure_nothing() -> None:
    """An arm half way to the camera, that the field leaves out."""
    view, robot = frames()[0], np.broadcast_to(np.arange(200) < 100, (160, 200))
    view.depth[robot] *= 0.5
    without, with_arm = (held_out(height_grid(), [view], 1000, counted=counted) for counted in ([~robot], None))
    assert (without["num_edges"], with_arm["num_edges"]) == (160, 320)  # the column beside the mask
    assert without["on_surface"]["sdf"]["over_max"] == pytest.approx(0.0, abs=1e-6)
    assert with_arm["num_measured"] > without["num_measured"] or with_arm["num_outside"] > 0


def test_points_without_a_distance_and_over_estimates_count_wherever_they_are() -> None:
    grid, over = height_grid(), height_grid()
    grid.channels["sdf"][:15] = np.nan
    found = held_out(grid, max_points=2000)
    assert 0 < found["num_unknown"] < 2000 - found["num_outside"]
    assert sum(band["count"] for band in found["before"]["everywhere"]["sdf"]) <= 2000 - found["num_unknown"]
    over.channels["hard"] += np.float32(0.03)
    beyond = held_out(over, frames()[:1], 2000)["before"]["over_estimate"]
    assert beyond["count_beyond"] == beyond["count"] > 500
    one, same, other = (held_out(height_grid(), max_points=500, seed=seed) for seed in (1, 1, 2))
    assert one == same and one != other


def test_frames_that_see_nothing_or_masks_that_do_not_fit_are_refused() -> None:
    expect_refusal(
        "no pixel of 1 frames shows a point in the grid",
        held_out,
        height_grid(),
        [floor_frame((9.0, 0.0, 1.0), (9.0, 0.1, 0.0))],
        error=NotEvaluableError,
    )
    expect_refusal(
        "expected a mask of the size of each of 3 frames, got 1 masks",
        held_out,
        height_grid(),
        counted=[np.ones((160, 200), dtype=bool)],
    )


def test_pixels_of_the_robot_and_outside_the_workspace_do_not_count() -> None:
    frame = frames()[0]
    points, is_deep = surface_points(frame)
    assert counted_pixels(frame, None, None).all(), "a pixel without depth measures nothing, and need not be left out"
    middle = points[len(points) // 2]
    is_away = np.linalg.norm(points - middle, axis=1) > 0.1 + ROBOT_MARGIN
    spheres, box = (middle[None], np.array([0.1])), Box(lower=middle - 0.2, upper=middle + 0.2)
    np.testing.assert_array_equal(counted_pixels(frame, None, spheres)[is_deep], is_away)
    np.testing.assert_array_equal(counted_pixels(frame, box, None)[is_deep], box.contains(points))

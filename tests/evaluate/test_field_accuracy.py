"""A baked field beside the truth of a simulated log, and beside a mesh; and beside the depth of cameras that did not
train.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config.fixed import ROBOT_MARGIN
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.field_accuracy import (
    TrueCells,
    TruthComparison,
    compare_with_mesh,
    compare_with_truth,
    field_accuracy,
    grid_distances,
    median_radius,
)
from splatctrl_cli.evaluate.held_out_depth import compare_with_held_out_depth, counted_pixels
from splatctrl_cli.evaluate.views import surface_points
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Box, DistanceGrid, Float64, Intrinsics, RgbdFrame
from tests.evaluate.test_views import wall_frame
from tests.plain import plain_frame
from tests.robot.test_mesh_distance import box_distance

TRUTH = np.array([0.01, 0.015, 0.03, 0.07, 0.15, 0.3, -0.01])


def test_errors_are_counted_in_the_band_of_the_true_distance() -> None:
    error = np.array([0.001, 0.003, -0.002, 0.0, 0.02, 1.0, 1.0])
    seen = np.array([True, False, True, True, True, True, True])
    report = field_accuracy({"hard": TRUTH + error, "gpdf": TRUTH}, TRUTH, seen, median_radius=0.005)
    near, middle, far, farther = report.everywhere["hard"]
    assert (near.count, middle.count, far.count, farther.count) == (2, 1, 1, 1)
    assert near.mean == pytest.approx(0.002)
    assert near.rmse == pytest.approx(np.sqrt((1 + 9) / 2) * 1e-3)
    assert near.median == pytest.approx(0.002)
    assert near.over_max == pytest.approx(0.003)
    assert middle.over_max == pytest.approx(-0.002)
    assert report.seen["hard"][0].count == 1
    assert report.seen["hard"][0].over_95 == pytest.approx(0.001)
    assert report.everywhere["gpdf"][3].rmse == 0.0


def test_over_estimate_counts_seen_cells_beyond_a_centimetre_and_the_median_radius() -> None:
    error = np.array([0.0149, 0.5, 0.0, 0.016, 0.019, 9.0, 9.0])
    seen = np.array([True, False, True, True, True, True, True])
    over = field_accuracy({"hard": TRUTH + error}, TRUTH, seen, median_radius=0.005).over_estimate
    assert (over.allowance, over.count, over.count_beyond) == (0.015, 4, 2)
    assert over.share_beyond == 0.5
    assert over.median_beyond == pytest.approx(0.0025)
    assert over.max_error == pytest.approx(0.019)
    assert not over.holds


def test_bands_without_cells_have_no_figures_and_nothing_holds() -> None:
    report = field_accuracy({"hard": np.ones(1)}, np.ones(1), np.array([True]), median_radius=0.0)
    assert report.everywhere["hard"][0].rmse is None
    assert report.as_dict()["holds"] is False


def test_arrays_that_do_not_fit_are_named() -> None:
    with pytest.raises(InputError, match=r"gpdf: expected \(7,\) values"):
        field_accuracy({"hard": TRUTH, "gpdf": TRUTH[:3]}, TRUTH, TRUTH > 0, median_radius=0.0)
    with pytest.raises(InputError, match="expected one named hard, got gpdf"):
        field_accuracy({"gpdf": TRUTH}, TRUTH, TRUTH > 0, median_radius=0.0)


def test_without_a_word_on_what_was_seen_every_point_counts() -> None:
    error = np.array([0.0149, 0.5, 0.0, 0.0, 0.0, 9.0, 9.0])
    report = field_accuracy({"hard": TRUTH + error}, TRUTH, None, median_radius=0.005)
    assert report.seen == {}
    assert (report.over_estimate.count, report.over_estimate.count_beyond) == (5, 1)


def test_hard_comes_back_from_the_bound_of_a_grid() -> None:
    sdf = np.zeros((2, 2, 2), np.float32)
    bound = np.full((2, 2, 2), 0.083, np.float32)
    header: dict[str, object] = {"bound_margin": 0.0175, "health": {"radius": 0.01}}
    grid = DistanceGrid(origin=np.zeros(3), voxel=0.02, channels={"sdf": sdf, "bound": bound}, header=header)
    np.testing.assert_allclose(grid_distances(grid)["hard"].at(np.array([0, 5])), [0.1005, 0.1005], atol=1e-7)
    assert median_radius(grid) == 0.01
    with_hard = DistanceGrid(
        origin=np.zeros(3), voxel=0.02, channels={"sdf": sdf, "hard": bound, "se": sdf}, header={}
    )
    np.testing.assert_array_equal(grid_distances(with_hard)["hard"].at(np.arange(8)), bound.ravel())
    assert list(grid_distances(with_hard)) == ["sdf", "hard", "se"]
    for header in ({}, {"bound_margin": "wide"}):
        bare = DistanceGrid(origin=np.zeros(3), voxel=0.02, channels={"sdf": sdf, "bound": bound}, header=header)
        with pytest.raises(InputError, match="expected a channel hard or bound, got sdf, bound"):
            grid_distances(bare)


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
    channels = {"sdf": (truth + error).astype(np.float32), "bound": (truth + hard_error - 0.017).astype(np.float32)}
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


CAMERA = Intrinsics(fx=200.0, fy=200.0, cx=99.5, cy=79.5, width=200, height=160)


def floor_frame(eye: tuple[float, float, float], target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> RgbdFrame:
    """The floor z = 0, exactly measured from `eye`."""
    T = look_at(np.array(eye), np.array(target), up=(0.0, 1.0, 0.0))
    v, u = np.mgrid[:160, :200]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    falls = (rays @ T[:3, :3].T)[..., 2]
    depth = np.where(falls < 0, -T[2, 3] / np.where(falls < 0, falls, -1.0), 0.0)
    return plain_frame(depth, CAMERA, T, camera="held-out")


def height_grid(error: float = 0.0) -> DistanceGrid:
    axis = -0.3 + 0.02 * np.arange(31)
    heights = np.broadcast_to(axis + 0.1, (31, 31, 31))  # z from -0.2 to 0.4
    channels = {"sdf": (heights + error).astype(np.float32), "hard": heights.astype(np.float32)}
    return DistanceGrid(
        origin=np.array([-0.3, -0.3, -0.2]), voxel=0.02, channels=channels, header={"health": {"radius": 0.004}}
    )


def frames() -> list[RgbdFrame]:
    return [floor_frame((0.0, 0.1, 1.2)), floor_frame((0.6, 0.0, 1.0)), floor_frame((-0.4, -0.5, 1.1))]


def test_a_floor_reads_zero_on_it_and_its_height_before_it() -> None:
    compared = compare_with_held_out_depth(height_grid(0.003), frames(), seed=0, max_points=4000)
    assert compared.reference == "nearest measured depth point"
    assert (compared.num_frames, compared.num_unknown, compared.num_edges) == (3, 0, 0)
    for name, error in (("sdf", 0.003), ("hard", 0.0)):
        assert compared.on_surface[name].count > 1000
        assert compared.on_surface[name].mean == pytest.approx(error, abs=1e-6)
        for band in compared.before.seen[name]:
            assert band.count > 50
            assert band.mean == pytest.approx(error, abs=6e-4)  # pixels on the floor are up to 6 mm apart
    assert compared.before.over_estimate.count_beyond == 0


def test_a_hidden_surface_is_an_under_estimate_only_where_the_ball_was_seen() -> None:
    grid = height_grid()
    x = -0.3 + 0.02 * np.arange(31)
    post = np.hypot(np.hypot(x[:, None, None] - 0.05, x[None, :, None]), 0.0 * x[None, None, :]) - 0.02
    grid.channels["sdf"] = np.minimum(grid.channels["sdf"], post).astype(np.float32)  # no pixel shows the post
    compared = compare_with_held_out_depth(grid, frames(), seed=0, max_points=4000)
    seen = compared.before.seen["sdf"][3]
    assert seen.count > 0.8 * compared.before.everywhere["sdf"][3].count
    assert seen.mean is not None
    assert seen.mean < -0.01
    blind = [replace(frame, depth=np.where(hides_post(frame), 0, frame.depth)) for frame in frames()]
    unsure = compare_with_held_out_depth(grid, blind, seed=0, max_points=4000).before
    everywhere, seen = unsure.everywhere["sdf"][3], unsure.seen["sdf"][3]
    assert 100 < seen.count < everywhere.count
    assert seen.rmse is not None
    assert everywhere.rmse is not None
    assert everywhere.rmse > 0.02
    assert seen.rmse < 0.005  # a ball may meet the rim of the post between two probes


def hides_post(frame: RgbdFrame) -> np.ndarray:
    """Pixels whose ray passes the post of 30 cm."""
    v, u = np.mgrid[:160, :200]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    directions, eye = rays @ frame.T_world_camera[:3, :3].T, frame.T_world_camera[:3, 3]
    is_hit = np.zeros(u.shape, dtype=bool)
    for height in np.arange(0.0, 0.31, 0.01):
        at = eye + directions * ((height - eye[2]) / directions[..., 2])[..., None]
        is_hit |= np.hypot(at[..., 0] - 0.05, at[..., 1]) < 0.02
    return is_hit


def test_over_estimates_count_wherever_they_are() -> None:
    grid = height_grid()
    grid.channels["hard"] = grid.channels["hard"] + np.float32(0.03)
    over = compare_with_held_out_depth(grid, frames()[:1], seed=0, max_points=2000).before.over_estimate
    assert over.count_beyond == over.count > 500


def test_masked_pixels_and_edges_measure_nothing() -> None:
    views = frames()[:1]
    robot = np.zeros((160, 200), dtype=bool)
    robot[:, :100] = True
    depth = views[0].depth.copy()
    depth[robot] = 0.5 * depth[robot]  # an arm half way to the camera, that the field leaves out
    views = [replace(views[0], depth=depth)]
    without = compare_with_held_out_depth(height_grid(), views, seed=0, counted=[~robot], max_points=1000)
    assert without.num_edges == 160  # the column beside the mask
    assert without.on_surface["sdf"].over_max == pytest.approx(0.0, abs=1e-6)
    with_arm = compare_with_held_out_depth(height_grid(), views, seed=0, max_points=1000)
    assert with_arm.num_edges == 320
    assert with_arm.num_measured > without.num_measured or with_arm.num_outside > 0


def test_points_without_a_distance_are_counted() -> None:
    grid = height_grid()
    grid.channels["sdf"][:15] = np.nan
    compared = compare_with_held_out_depth(grid, frames(), seed=0, max_points=2000)
    assert 0 < compared.num_unknown < 2000 - compared.num_outside
    assert sum(band.count for band in compared.before.everywhere["sdf"]) <= 2000 - compared.num_unknown


def test_the_seed_decides_the_points() -> None:
    one, same, other = (
        compare_with_held_out_depth(height_grid(), frames(), seed=seed, max_points=500) for seed in (1, 1, 2)
    )
    assert one == same
    assert one != other


def test_frames_that_see_nothing_or_masks_that_do_not_fit_are_refused() -> None:
    away = floor_frame((9.0, 0.0, 1.0), (9.0, 0.1, 0.0))
    with pytest.raises(NotEvaluableError, match="no pixel of 1 frames shows a point in the grid"):
        compare_with_held_out_depth(height_grid(), [away], seed=0)
    with pytest.raises(InputError, match="expected a mask of the size of each of 3 frames, got 1 masks"):
        compare_with_held_out_depth(height_grid(), frames(), seed=0, counted=[np.ones((160, 200), dtype=bool)])


def test_pixels_of_the_robot_and_outside_the_workspace_do_not_count() -> None:
    frame = frames()[0]
    points, is_deep = surface_points(frame)
    counted = counted_pixels(frame, None, None)
    assert counted.all(), "a pixel without depth measures nothing, and need not be left out"
    middle = points[len(points) // 2]
    away = np.linalg.norm(points - middle, axis=1)
    spheres = (middle[None], np.array([0.1]))
    np.testing.assert_array_equal(counted_pixels(frame, None, spheres)[is_deep], away > 0.1 + ROBOT_MARGIN)
    box = Box(lower=middle - 0.2, upper=middle + 0.2)
    np.testing.assert_array_equal(counted_pixels(frame, box, None)[is_deep], box.contains(points))

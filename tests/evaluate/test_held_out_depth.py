from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config.fixed import ROBOT_MARGIN
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.held_out_depth import compare_with_held_out_depth, counted_pixels
from splatctrl_cli.evaluate.views import surface_points
from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Box, DistanceGrid, Intrinsics, RgbdFrame
from tests.plain import plain_frame

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

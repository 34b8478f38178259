"""A running mean of depth: noise of what stands still goes, what moves is not behind."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.records import Float32, Intrinsics, RgbdFrame
from splatctrl_cli.scene.steady_depth import steadied

LENS = Intrinsics(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
SENSOR = OccupancyConfig(depth_error=0.003)
EVERYWHERE = np.ones((120, 160), bool)


def frame_of(depth: Float32, x: float = 0.0) -> RgbdFrame:
    T = np.eye(4)
    T[0, 3] = x
    return RgbdFrame(
        stamp_ns=1,
        camera="cam",
        color=np.zeros((120, 160, 3), np.uint8),
        depth=depth,
        intrinsics=LENS,
        T_world_camera=T,
    )


def noisy(z: float, rng: np.random.Generator) -> Float32:
    return np.asarray(z + 0.003 * z * z * rng.standard_normal((120, 160)), np.float32)


def after(depths: list[Float32]) -> Float32:
    shown = None
    for depth in depths:
        before = None if shown is None else (shown, EVERYWHERE)
        shown, _ = steadied(frame_of(depth), before, EVERYWHERE, SENSOR)
    assert shown is not None
    return shown.depth


def test_noise_of_what_stands_still_falls_to_the_gains_share() -> None:
    rng = np.random.default_rng(0)
    error = after([noisy(1.0, rng) for _ in range(20)]) - 1.0
    assert error.std() < 0.5 * 0.003  # sqrt(0.25 / 1.75) = 0.38
    assert abs(error.mean()) < 1e-4


@pytest.mark.parametrize("per_frame", [0.05, 0.005, -0.005, 0.002])
def test_what_moves_along_the_ray_is_behind_by_less_than_a_few_sigma(per_frame: float) -> None:
    rng = np.random.default_rng(1)
    places = [1.0 + per_frame * k for k in range(15)]
    shown = after([noisy(z, rng) for z in places])
    assert abs(np.median(shown) - places[-1]) < 1.5 * 0.003 * places[-1] ** 2 + 0.001


def test_a_thing_that_comes_is_there_in_its_first_frame() -> None:
    still = np.full((120, 160), 1.0, np.float32)
    thing = still.copy()
    thing[40:60, 60:70] = 0.95
    shown = after([still, still, thing])
    np.testing.assert_array_equal(shown, thing)


def test_a_camera_that_moved_and_a_robots_pixels_keep_what_they_measured() -> None:
    still, now = np.full((120, 160), 1.0, np.float32), np.full((120, 160), 1.002, np.float32)
    moved, steady = steadied(frame_of(now, x=0.001), (frame_of(still), EVERYWHERE), EVERYWHERE, SENSOR)
    np.testing.assert_array_equal(moved.depth, now)
    assert steady.all()  # nobody can say, and its measurements count
    of_robot, steady = steadied(frame_of(now), (frame_of(still), EVERYWHERE), ~EVERYWHERE, SENSOR)
    np.testing.assert_array_equal(of_robot.depth, now)
    assert not steady.any()
    small = replace(frame_of(still), depth=np.zeros((60, 80), np.float32))
    np.testing.assert_array_equal(
        steadied(frame_of(now), (small, EVERYWHERE[::2, ::2]), EVERYWHERE, SENSOR)[0].depth, now
    )


def test_a_surface_that_the_robot_bares_is_where_it_is_measured_not_halfway_to_the_robot() -> None:
    robot, table = np.full((120, 160), 1.0, np.float32), np.full((120, 160), 1.004, np.float32)
    was_object = EVERYWHERE.copy()
    was_object[:, 80:] = False
    shown, steady = steadied(frame_of(table), (frame_of(robot), was_object), EVERYWHERE, SENSOR)
    np.testing.assert_array_equal(shown.depth[:, 80:], table[:, 80:])
    assert (shown.depth[:, :80] < 1.002).all()
    assert steady.all()  # it may be what touches the robot


def test_what_had_no_depth_before_keeps_what_is_measured_now() -> None:
    before, now = np.zeros((120, 160), np.float32), np.full((120, 160), 0.002, np.float32)
    shown, steady = steadied(frame_of(now), (frame_of(before), EVERYWHERE), EVERYWHERE, SENSOR)
    np.testing.assert_array_equal(shown.depth, now)
    assert not steady.any()


def test_what_a_camera_measures_first_is_not_steady_and_what_stays_is() -> None:
    still, now = np.full((120, 160), 1.0, np.float32), np.full((120, 160), 1.0, np.float32)
    now[40:60, 60:90] = 0.95
    first, steady = steadied(frame_of(still), None, EVERYWHERE, SENSOR)
    assert not steady.any()
    second, steady = steadied(frame_of(now), (first, EVERYWHERE), EVERYWHERE, SENSOR)
    np.testing.assert_array_equal(steady, now == 1.0)
    assert steadied(frame_of(now), (second, EVERYWHERE), EVERYWHERE, SENSOR)[1].all()

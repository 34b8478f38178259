"""A running mean of depth: noise of what stands still goes, what moves is not behind."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Bool, Float32, Intrinsics, RgbdFrame
from splatctrl_cli.scene.surface_depth import object_twice, steady_depth
from tests.plain import plain_frame

LENS = Intrinsics(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
SENSOR = OccupancyConfig(depth_error=0.003)
EVERYWHERE = np.ones((120, 160), bool)


def frame_of(depth: float | Float32, x: float = 0.0) -> RgbdFrame:
    return plain_frame(depth, LENS, pose_at([x, 0.0, 0.0]), stamp_ns=1, camera="cam")


def steady(
    now: RgbdFrame, before: RgbdFrame | None = None, was: Bool = EVERYWHERE, is_object: Bool = EVERYWHERE
) -> tuple[RgbdFrame, Bool]:
    return steady_depth(now, None if before is None else (before, was), is_object, SENSOR)


def noisy(z: float, rng: np.random.Generator) -> Float32:
    return np.asarray(z + 0.003 * z * z * rng.standard_normal((120, 160)), np.float32)


def after(depths: list[Float32]) -> Float32:
    shown = None
    for depth in depths:
        shown, _ = steady(frame_of(depth), shown)
    return shown.depth


def test_noise_of_what_stands_still_falls_to_the_gains_share() -> None:
    rng = np.random.default_rng(0)
    error = after([noisy(1.0, rng) for _ in range(20)]) - 1.0
    assert error.std() < 0.5 * 0.003 and abs(error.mean()) < 1e-4  # sqrt(0.25 / 1.75) = 0.38


@pytest.mark.parametrize("per_frame", [0.05, 0.005, -0.005, 0.002])
def test_what_moves_along_the_ray_is_behind_by_less_than_a_few_sigma(per_frame: float) -> None:
    rng, last = np.random.default_rng(1), 1.0 + per_frame * 14
    shown = after([noisy(1.0 + per_frame * k, rng) for k in range(15)])
    assert abs(np.median(shown) - last) < 1.5 * 0.003 * last**2 + 0.001


def test_a_thing_that_comes_is_there_in_its_first_frame() -> None:
    """Depth is steady from the second image on."""
    still, thing = frame_of(1.0), frame_of(1.0)
    thing.depth[40:60, 60:90] = 0.95
    first, is_steady = steady(still)
    assert not is_steady.any()
    second, is_steady = steady(thing, first)
    np.testing.assert_array_equal(second.depth, thing.depth)
    np.testing.assert_array_equal(is_steady, thing.depth == 1.0)
    assert steady(thing, second)[1].all()


@pytest.mark.parametrize(
    ("now", "before", "is_object", "is_steady"),
    [
        pytest.param(frame_of(1.002, x=0.001), frame_of(1.0), EVERYWHERE, True, id="moved: nobody can say"),
        pytest.param(frame_of(1.002), frame_of(1.0), ~EVERYWHERE, False, id="of the robot"),
        pytest.param(frame_of(0.002), frame_of(0.0), EVERYWHERE, False, id="no depth before"),
    ],
)
def test_a_camera_that_moved_and_a_robots_pixels_keep_what_they_measured(
    now: RgbdFrame, before: RgbdFrame, is_object: Bool, is_steady: bool
) -> None:
    shown, steadily = steady(now, before, is_object=is_object)
    np.testing.assert_array_equal(shown.depth, now.depth)
    assert (steadily == is_steady).all()
    small = replace(before, depth=np.zeros((60, 80), np.float32))  # an image of another size
    np.testing.assert_array_equal(steady(now, small, EVERYWHERE[::2, ::2])[0].depth, now.depth)


def test_a_surface_that_the_robot_bares_is_where_it_is_measured_not_halfway_to_the_robot() -> None:
    """It may be what touches the robot."""
    table, was_object = frame_of(1.004), np.broadcast_to(np.arange(160) < 80, (120, 160))
    shown, is_steady = steady(table, frame_of(1.0), was_object)
    np.testing.assert_array_equal(shown.depth[:, 80:], table.depth[:, 80:])
    assert (shown.depth[:, :80] < 1.002).all() and is_steady.all()


def test_a_pixel_lasts_that_is_a_steady_object_in_two_images() -> None:
    """All pixels do if the camera moved."""
    was_object = EVERYWHERE.copy()
    was_object[:, :80] = False
    first = frame_of(1.0)
    _, is_steady = steady(frame_of(1.0), first, was_object)
    assert is_steady.all()
    np.testing.assert_array_equal(object_twice(frame_of(1.0), (first, was_object), is_steady), was_object)
    assert object_twice(frame_of(1.0, x=0.1), (first, was_object), is_steady).all()
    assert object_twice(frame_of(1.0), None, is_steady).all()

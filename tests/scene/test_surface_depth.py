"""Depth beside the robot's outline, and its running mean: what is between two surfaces, moves or stands still."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.config.fixed import MASK_STEP
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Bool, Float32, Intrinsics, RgbdFrame
from splatctrl_cli.scene.surface_depth import object_twice, steady_depth, surface_steps
from tests.plain import plain_frame

SHAPE, EDGE = (200, 300), 5
ERROR = 0.002  # [m] at 1 m
V, U = np.indices(SHAPE)
ROBOT = (V < 100) & (U >= 100) & (U < 200)
IS_EDGE = (V < 100 + EDGE) & (U >= 100 - EDGE) & (U < 200 + EDGE) & ~ROBOT


def table(rng: np.random.Generator) -> Float32:
    """A slanted plane 1.3 to 1.5 m away, with noise of 2 mm at 1 m."""
    z = 1.0 / (1.0 / 1.5 + 6e-4 * V - 1e-4 * U)
    return np.asarray(z + ERROR * z**2 * rng.standard_normal(SHAPE), np.float32)


def tolerance(z: Float32) -> Float32:
    return np.asarray(0.004 + 2.0 * ERROR * z**2, np.float32)


def steps(depth: Float32, is_object: Bool = ~ROBOT) -> Float32:
    return surface_steps(is_object, depth, IS_EDGE, EDGE, tolerance(depth), ERROR)


def test_pixels_off_the_plane_beside_the_outline_have_half_of_their_distance() -> None:
    rng = np.random.default_rng(0)
    depth = table(rng)
    off = IS_EDGE & (rng.random(SHAPE) < 0.1)
    depth[off] -= 0.030
    found = steps(depth)
    assert np.count_nonzero(found[off] < MASK_STEP) >= 0.99 * np.count_nonzero(off) and found[off].min() > 0.008
    assert np.median(found[off]) == pytest.approx(0.015, abs=0.001)
    others = found[IS_EDGE & ~off]
    assert np.count_nonzero(others < MASK_STEP) <= 0.02 * len(others)  # beyond 4 mm + 2 sigma
    assert np.all(found[~IS_EDGE] == np.float32(MASK_STEP))


def test_what_stands_before_the_plane_and_goes_on_leaves_no_plane_to_be_off() -> None:
    depth = table(np.random.default_rng(1))
    box = (U >= 140) & (U < 160) & (V >= 100) & (V < 120)
    depth[box] -= 0.1
    assert np.all(steps(depth)[box & IS_EDGE] == np.float32(MASK_STEP))


def test_too_little_of_a_plane_says_nothing() -> None:
    depth = table(np.random.default_rng(2))
    depth[100, 120:180] -= np.float32(0.03)
    assert np.all(steps(depth)[100, 120:180] < MASK_STEP)
    two_rows = ~ROBOT & (V >= 100) & ((V < 100 + EDGE) | (abs(V - 113.5) < 1))  # noise decides on their slope
    assert np.all(steps(table(np.random.default_rng(2)), two_rows)[100, 120:180] == np.float32(MASK_STEP))
    assert np.all(steps(depth, np.zeros(SHAPE, bool)) == np.float32(MASK_STEP))


@pytest.mark.parametrize("sigmas", [1.0, 4.0])
def test_the_plane_is_the_least_squares_plane_of_the_pixels_beyond(sigmas: float) -> None:
    depth = table(np.random.default_rng(3))
    depth[102, 150] -= np.float32(0.004 + sigmas * 2.0 * ERROR * 1.4**2)
    v, u = 102, 150
    z = float(depth[v, u])
    expected = MASK_STEP
    for reach in (2 * EDGE, 3 * EDGE):
        beyond = ~ROBOT & ~IS_EDGE & (abs(V - v) <= reach) & (abs(U - u) <= reach)
        design = np.column_stack([np.ones(np.count_nonzero(beyond)), U[beyond], V[beyond]])
        plane = np.linalg.lstsq(design, 1.0 / depth[beyond].astype(np.float64), rcond=None)[0]
        off = float(abs(1.0 / z - plane @ [1.0, u, v])) * z**2
        if off > tolerance(depth)[v, u]:
            expected = min(expected, 0.5 * off)
    assert steps(depth)[v, u] == pytest.approx(expected, abs=1e-6)


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

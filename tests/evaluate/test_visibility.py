"""Which points cameras saw: a wall at 2 m with a plate at 1 m before its left half."""

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.evaluate.visibility import seen_by, seen_pixels, surface_points
from splatctrl_cli.geometry import look_at, transform_points
from splatctrl_cli.records import Float64, Intrinsics, RgbdFrame

INTRINSICS = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


def wall_frame(T_world_camera: Float64 | None = None) -> RgbdFrame:
    depth = np.full((48, 64), 2.0, dtype=np.float32)
    depth[:, :32] = 1.0
    depth[0] = 0.0
    return RgbdFrame(
        stamp_ns=0,
        camera="cam0",
        color=np.zeros((48, 64, 3), dtype=np.uint8),
        depth=depth,
        intrinsics=INTRINSICS,
        T_world_camera=np.eye(4) if T_world_camera is None else T_world_camera,
    )


def points(values: ArrayLike) -> Float64:
    return np.asarray(values, dtype=np.float64).reshape(-1, 3)


def test_a_point_on_a_measured_surface_is_seen_within_the_tolerance() -> None:
    frame = wall_frame()
    on_wall = points([[0.5, 0.0, 2.0], [0.5, 0.0, 2.019], [0.5, 0.0, 2.021], [0.5, 0.0, 1.979]])
    assert seen_by(on_wall, [frame]).tolist() == [True, True, False, False]
    assert seen_by(on_wall, [frame], tolerance=0.03).all()


def test_a_point_behind_a_surface_or_in_front_of_it_or_behind_the_camera_is_not_seen() -> None:
    assert not seen_by(
        points([[-0.5, 0.0, 2.0], [0.5, 0.0, 1.0], [0.5, 0.0, -2.0], [0.0, 0.0, 0.0]]), [wall_frame()]
    ).any()


def test_a_point_outside_the_image_or_at_a_pixel_without_depth_is_not_seen() -> None:
    top_row = [0.5, (0 - 23.5) / 50 * 2.0, 2.0]
    assert not seen_by(points([[5.0, 0.0, 2.0], [0.5, -3.0, 2.0], top_row]), [wall_frame()]).any()


def test_a_pixel_reaches_half_a_pixel_around_its_centre() -> None:
    last = (63 + 0.49 - 31.5) / 50 * 2.0
    beyond = (63 + 0.51 - 31.5) / 50 * 2.0
    assert seen_by(points([[last, 0.0, 2.0], [beyond, 0.0, 2.0]]), [wall_frame()]).tolist() == [True, False]


def test_a_frame_sees_all_its_own_surface_from_any_pose() -> None:
    frame = wall_frame(look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.5]))
    own, valid = surface_points(frame)
    assert len(own) == 47 * 64 == valid.sum()
    assert seen_by(own, [frame]).all()
    assert np.array_equal(seen_pixels(frame, [frame]), valid)


def test_what_is_seen_does_not_hang_on_the_order_of_the_cameras() -> None:
    frame = wall_frame(look_at([0.5, -2.0, 0.4], [0.0, 0.0, 0.5]))
    others = [wall_frame(look_at([0.1 * n, -2.0, 0.4], [0.2, 0.0, 0.5])) for n in (4, 0, 6)]
    seen = seen_pixels(frame, others)
    assert 0 < seen.sum() < seen.size
    assert np.array_equal(seen, seen_pixels(frame, others[::-1]))


def test_any_frame_suffices_and_no_frame_sees_nothing() -> None:
    away = wall_frame(look_at([0.0, 0.0, 0.0], [0.0, 0.0, -1.0], up=(0.0, 1.0, 0.0)))
    target = points([[0.5, 0.0, 2.0]])
    assert not seen_by(target, [away]).any()
    assert seen_by(target, [away, wall_frame()]).all()
    assert not seen_by(target, []).any()
    assert seen_by(points([]), [wall_frame()]).shape == (0,)


def test_seen_moves_with_the_world() -> None:
    T = look_at([0.3, -0.2, 0.4], [1.0, 1.0, 0.0])
    target = np.random.default_rng(0).uniform([-1, -1, 0.5], [1, 1, 2.5], size=(500, 3))
    here = seen_by(target, [wall_frame()], tolerance=0.5)
    there = seen_by(transform_points(T, target), [wall_frame(T)], tolerance=0.5)
    assert np.array_equal(here, there)
    assert 0 < here.sum() < 500

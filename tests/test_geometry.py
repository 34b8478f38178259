"""Rigid transforms and the pinhole camera; the box that a person types, and the order of records."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import (
    back_project,
    interpolate_transform,
    invert_transform,
    look_at,
    project,
    quat_from_rotation,
    rotation_from_quat,
    transform_from,
    transform_points,
)
from splatctrl_cli.records import Box, Intrinsics, PointCloud, merge_by_stamp
from tests.refused import expect_refusal

RNG = np.random.default_rng(0)
CAMERA = Intrinsics(fx=50.0, fy=60.0, cx=20.3, cy=14.8, width=40, height=30)


@pytest.mark.parametrize("index", range(6))
def test_rotations_agree_with_scipy_both_ways(index: int) -> None:
    rotation = Rotation.random(rng=index) if index else Rotation.from_rotvec([np.pi, 0, 0])
    R, quat = rotation.as_matrix(), quat_from_rotation(rotation.as_matrix())
    assert np.allclose(rotation_from_quat(rotation.as_quat()), R, atol=1e-12)
    assert quat[3] >= 0 and np.allclose(rotation_from_quat(quat), R, atol=1e-12)


@pytest.mark.parametrize("length", [5e-324, 1e-320, 2e-160, 1e-154, 1e-30, 3.0, 1e160, 1e308])
def test_a_quaternion_of_any_length_is_a_rotation(length: float) -> None:
    whole = rotation_from_quat([length, 0, -length, 0])
    assert np.allclose(whole, rotation_from_quat([1, 0, -1, 0]), atol=1e-15)
    R = rotation_from_quat([0.3 * length, 0.0, 0.4 * length, length])
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-15) and np.linalg.det(R) == pytest.approx(1.0)


def test_inverse_undoes() -> None:
    T = transform_from([0.1, -2.0, 3.0], [0.1, 0.2, -0.3, 0.9])
    points = RNG.normal(size=(7, 3))
    assert np.allclose(transform_points(invert_transform(T), transform_points(T, points)), points)


def test_interpolation_meets_its_ends_and_halves_the_angle() -> None:
    a, b = transform_from([0, 0, 0], [0, 0, 0, 1]), transform_from([1, 2, 3], [0, 0, np.sin(0.6), np.cos(0.6)])
    middle = transform_from([0.5, 1, 1.5], Rotation.from_rotvec([0, 0, 0.6]).as_quat())
    for first, last, share, expected in ((a, b, 0.0, a), (a, b, 1.0, b), (a, b, 0.5, middle), (a, a, 0.3, a)):
        assert np.allclose(interpolate_transform(first, last, share), expected)


def test_pixels_come_back_to_where_they_were_projected_from() -> None:
    depth = RNG.uniform(0.5, 2.0, (30, 40))
    points = back_project(CAMERA, depth)
    assert np.allclose(project(CAMERA, points), np.stack(np.mgrid[:30, :40][::-1], -1))
    assert np.allclose(points[..., 2], depth)


def test_a_camera_looks_at_its_target_with_down_pointing_down() -> None:
    T = look_at([1.0, 2.0, 1.5], [0.2, 0.1, 0.0])
    x, y, z = transform_points(invert_transform(T), np.array([[0.2, 0.1, 0.0]]))[0]
    assert np.allclose([x, y], 0.0) and z > 0
    assert T[2, 1] < 0 and np.isclose(np.linalg.det(T[:3, :3]), 1.0)  # image down is world down


def test_a_box_is_read_lower_corner_first() -> None:
    box = Box.from_text("-1,-2,0,1,2.5,3e-1")
    assert [*box.lower, *box.upper] == [-1, -2, 0, 1, 2.5, 0.3]


@pytest.mark.parametrize(
    "text", ["0,0,0,1,1", "0,0,0,1,1,0", "0,0,0,1,1,a", "-inf,0,0,1,1,1", "0,0,0,1,1,inf", "0,0,0,1,1,nan"]
)
def test_a_box_that_is_not_six_finite_numbers_in_order_is_refused(text: str) -> None:
    expect_refusal(f"--box {text}: expected finite x0,y0,z0", Box.from_text, text, error=UsageError)


def test_of_one_stamp_the_items_of_an_earlier_stream_come_first_each_in_its_own_order() -> None:
    streams = [[(1, "a"), (3, "b"), (3, "c")], [(3, "d"), (4, "e")], [(0, "f"), (3, "g")]]
    merged = merge_by_stamp(
        *([SimpleNamespace(stamp_ns=stamp, name=name) for stamp, name in items] for items in streams)
    )
    assert "".join(item.name for item in merged) == "fabcdge"


def test_columns_that_are_joined_are_those_of_each_in_order() -> None:
    one, two, none = (PointCloud(points=np.ones((n, 3), np.float32) * n, colors=np.eye(3)[:n]) for n in (1, 2, 0))
    both = two.joined(none, one)
    assert (len(both), both.points[:, 0].tolist(), both.points.dtype) == (3, [2, 2, 1], np.float32)
    assert both.colors.tolist() == [*np.eye(3)[:2].tolist(), np.eye(3)[0].tolist()]
    assert one.joined().points.tolist() == one.points.tolist()

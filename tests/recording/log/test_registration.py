"""Depth warped into the colour camera; lens distortion removed."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from pinocchio.rpy import rpyToMatrix

from splatctrl_cli.geometry import pose_at
from splatctrl_cli.recording.log.registration import Lens, undistort_lens, warp_depth
from splatctrl_cli.records import Intrinsics
from tests.refused import expect_refusal

SMALL = Intrinsics(fx=40, fy=40, cx=19.5, cy=14.5, width=40, height=30)

LARGE = Intrinsics(fx=64, fy=64, cx=31.5, cy=23.5, width=64, height=48)


def test_the_same_camera_gives_the_same_depth() -> None:
    depth = np.random.default_rng(0).uniform(0.5, 2.0, (30, 40)).astype(np.float32)
    depth[5, 5] = 0
    assert warped(depth) == pytest.approx(depth, abs=1e-6)


def test_a_wall_fills_a_finer_color_camera_without_holes_and_is_left_out_behind_it() -> None:
    wall = np.full((30, 40), 1.5, dtype=np.float32)
    assert warped(wall, LARGE, z=0.1)[4:-4, 4:-4] == pytest.approx(1.6, abs=1e-6)
    assert not warped(wall, z=-1.7).any()


def test_a_baseline_moves_a_column_by_its_disparity() -> None:
    depth = np.zeros((30, 40), dtype=np.float32)
    depth[:, 10] = 0.8
    assert np.flatnonzero(warped(depth, x=0.1)[15]).tolist() == [10 + round(40 * 0.1 / 0.8)]


def test_the_nearest_of_two_surfaces_on_a_pixel_counts() -> None:
    depth = np.zeros((30, 40), dtype=np.float32)
    depth[15, 20], depth[15, 24] = 0.5, 2.0  # with x = 0.1: disparities 8 and 2 px
    depth[15, 26] = 2.0
    assert warped(depth, x=0.1)[15, [28, 26]] == pytest.approx([0.5, 2.0])


@pytest.mark.parametrize(
    ("model", "coefficients", "said"),
    [
        ("plumb_bob", [-500.0, 0, 0, 0, 0], "the camera saw 0% of the pinhole's image, expected at least 25%"),
        ("plumb_bob", [0.01, 0, 0], "plumb_bob: expected 4, 5, 8, 12, 14 coefficients, got 3; calibrate again"),
        ("equidistant", [0.01, 0, 0], "equidistant: expected 4 coefficients, got 3; calibrate again"),
    ],
)
def test_coefficients_that_no_model_has_or_that_show_hardly_anything_are_refused(
    model: str, coefficients: list[float], said: str
) -> None:
    expect_refusal(said, undistort_lens, SMALL, model, np.array(coefficients))
    image = np.random.default_rng(1).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    assert np.array_equal(undistort_lens(SMALL, "plumb_bob", np.zeros(5)).remap(image, cv2.INTER_LINEAR), image), (
        "none changes nothing"
    )
    barrel = undistort_lens(SMALL, "plumb_bob", np.array([-0.3, 0.1, 0, 0, 0]))
    assert barrel.valid is None, "shows every pixel of its own pinhole"


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_distorted_point_lands_where_the_pinhole_puts_it(model: str) -> None:
    k1 = -0.3
    x, y = 0.35, 0.2  # normalised pinhole coordinates
    r = np.hypot(x, y)
    theta = np.arctan(r)
    factor = 1 + k1 * r * r if model == "plumb_bob" else theta * (1 + k1 * theta**2) / r
    big = Intrinsics(fx=400, fy=400, cx=199.5, cy=149.5, width=400, height=300)
    u, v = 400 * x * factor + 199.5, 400 * y * factor + 149.5
    columns, rows = np.meshgrid(np.arange(400), np.arange(300))
    spot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18.0)
    image = np.repeat((255 * spot).astype(np.uint8)[..., None], 3, axis=2)
    flat = undistort_lens(big, model, np.array([k1, 0, 0, 0])).remap(image, cv2.INTER_LINEAR)[..., 0].astype(float)
    found = np.array([(flat * columns).sum(), (flat * rows).sum()]) / flat.sum()
    assert found == pytest.approx([400 * x + 199.5, 400 * y + 149.5], abs=0.5)


def test_a_turned_and_zoomed_result_shows_what_the_lens_saw_there() -> None:
    """As a stereo pair is rectified: the result's axes are turned from the lens's, its focal length is shorter."""
    R = rpyToMatrix(0.02, -0.1, 0.05)
    result = replace(LARGE, fx=0.8 * LARGE.fx, fy=0.8 * LARGE.fy)
    seen = undistort_lens(result, "plumb_bob", np.array([0.1, 0, 0, 0, 0]), recorded=LARGE, R=R).valid
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    rays = np.stack([(u - result.cx) / result.fx, (v - result.cy) / result.fy, np.ones(u.shape)], axis=2)
    x, y, z = np.moveaxis(rays @ R, 2, 0)  # R leads from the lens's axes to the result's
    x, y = x / z, y / z
    bent = 1 + 0.1 * (x * x + y * y)
    column, row = LARGE.fx * x * bent + LARGE.cx, LARGE.fy * y * bent + LARGE.cy
    assert np.array_equal(seen, (column >= 0) & (column <= 63) & (row >= 0) & (row <= 47))


@pytest.mark.parametrize(
    ("model", "coefficients", "turns_at"),
    [
        ("plumb_bob", [-0.3, 0, 0, 0, 0], np.sqrt(1 / 0.9)),  # d(r - 0.3 r^3)/dr = 0
        ("equidistant", [-0.3, 0, 0, 0], np.tan(np.sqrt(1 / 0.9))),
        ("rational_polynomial", [0, 0, 0, 0, 0, 1.0, 0, 0], 1.0),  # r / (1 + r^2)
    ],
)
def test_where_a_polynomial_turns_back_nothing_is_shown_twice(
    model: str, coefficients: list[float], turns_at: float
) -> None:
    wide = Intrinsics(fx=16, fy=16, cx=31.5, cy=23.5, width=64, height=48)
    valid = undistort_lens(wide, model, np.array(coefficients, dtype=float)).valid
    assert valid is not None
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    radius = np.hypot((u - wide.cx) / wide.fx, (v - wide.cy) / wide.fy)
    assert radius[valid].max() == pytest.approx(turns_at, abs=0.1)
    assert np.array_equal(valid, radius < turns_at)


def test_the_depth_cameras_own_lens_is_undone_before_its_depth_is_registered() -> None:
    """A distorted column of depth becomes straight."""
    k1 = 0.3
    own = undistort_lens(LARGE, "plumb_bob", np.array([k1, 0, 0, 0, 0]))
    x = 0.25
    y = np.linspace(-0.3, 0.3, 400)
    factor = 1 + k1 * (x * x + y * y)
    bent = np.zeros((48, 64), np.float32)
    row, column = np.rint(LARGE.fy * y * factor + LARGE.cy), np.rint(LARGE.fx * x * factor + LARGE.cx)
    bent[row.astype(int), column.astype(int)] = 1.0
    warp = Lens(intrinsics=LARGE, depth_lens=own, T_color_depth=np.eye(4))
    assert np.abs(np.nonzero(warp.depth(bent))[1] - (LARGE.fx * x + LARGE.cx)).max() <= 1.0


def warped(depth: np.ndarray[Any, Any], color: Intrinsics = SMALL, **shift: float) -> np.ndarray[Any, Any]:
    """Depth of the small camera in a colour camera that is moved along x and z [m]."""
    return warp_depth(depth, SMALL, color, pose_at([shift.get("x", 0.0), 0, shift.get("z", 0.0)]))

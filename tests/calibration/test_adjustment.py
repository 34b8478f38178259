"""The least squares of a calibration, against finite differences and plain NumPy."""

from collections.abc import Iterator

import numpy as np
import pytest

from splatctrl_cli.calibration.adjustment import Adjustment, Rows
from splatctrl_cli.calibration.evidence import FIXED, Estimate, Unknowns, transform_of, twist_between, twist_of
from splatctrl_cli.calibration.views import DepthView, landed, overlap_rows, still_frame, strided, surface_normals
from splatctrl_cli.geometry import back_project, look_at
from splatctrl_cli.records import Intrinsics, RgbdFrame
from tests.plain import plain_frame

LENS = Intrinsics(fx=100.0, fy=105.0, cx=31.5, cy=23.5, width=64, height=48)


def frame_of(depth: np.ndarray, camera: str = "cam", stamp_ns: int = 0) -> RgbdFrame:
    return plain_frame(depth, LENS, stamp_ns=stamp_ns, camera=camera)


def plane(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depths (48, 64) of the plane ``normal . p = distance``."""
    rays = back_project(LENS, np.ones((48, 64), np.float32))
    return np.asarray(distance / (rays @ normal))


def test_derivatives_of_the_distances_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    points, surface, normals = rng.normal(size=(3, 20, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    T = transform_of(rng.normal(size=6))
    all_of_them = np.ones(20, bool)
    by_points, by_view = np.hsplit(overlap_rows(points, T, all_of_them, surface, normals)[1], 2)
    for axis, step in enumerate(1e-6 * np.eye(6)):
        for derivative, ahead, behind in (
            (by_points, T @ transform_of(step), T @ transform_of(-step)),
            (by_view, np.linalg.inv(transform_of(step)) @ T, np.linalg.inv(transform_of(-step)) @ T),
        ):
            high, low = (overlap_rows(points, at, all_of_them, surface, normals)[0] for at in (ahead, behind))
            np.testing.assert_allclose(derivative[:, axis], (high - low) / 2e-6, atol=1e-8)


def test_normals_of_a_plane_are_its_own_and_point_to_the_camera_and_an_edge_has_none() -> None:
    normal = np.array([0.2, -0.3, 1.0]) / np.linalg.norm([0.2, -0.3, 1.0])
    for step in (1, 3):
        found = surface_normals(back_project(LENS, plane(normal, 0.8).astype(np.float32)), step)
        inside = found[step:-step, step:-step].reshape(-1, 3)
        np.testing.assert_allclose(inside, np.broadcast_to(-normal, inside.shape), atol=1e-4)
        assert not found[:step].any()
    edge = np.full((48, 64), 0.5, np.float32)
    edge[:, 32:] = 0.9
    found = surface_normals(back_project(LENS, edge))
    assert not found[:, 31:33].any() and found[5, 20].any()


def test_points_land_where_the_other_view_has_depth() -> None:
    depth = np.full((48, 64), 0.5)
    depth[:, :10] = 0.0
    view = DepthView.of(frame_of(depth), 100)
    points = np.array([[0.0, 0.0, 0.7], [-0.2, 0.0, 0.7], [0.0, 0.0, -0.7], [3.0, 0.0, 0.7]])  # a hole, behind, aside
    lands, surface, _ = landed(points, view)
    assert lands.tolist() == [True, False, False, False]
    np.testing.assert_allclose(surface[0, 2], 0.5)


def test_what_passes_a_still_camera_is_left_out_of_what_it_sees() -> None:
    frames = [frame_of(np.full((48, 64), 1.0), stamp_ns=i) for i in range(9)]
    for i in range(3):
        frames[i].depth[10:20, 10:20] = 0.4
    np.testing.assert_allclose(still_frame(frames).depth, 1.0, rtol=1e-6)


def test_a_strided_frame_shows_the_same_points() -> None:
    depth = plane(np.array([0.1, 0.2, 0.97]), 1.0).astype(np.float32)
    small = strided(frame_of(depth), 24)
    whole = back_project(LENS, depth)[::2, ::2]
    np.testing.assert_allclose(back_project(small.intrinsics, small.depth), whole, atol=1e-6)


def test_a_step_moves_what_is_free_and_holds_the_rest() -> None:
    unknowns = Unknowns(cameras=("a", "b"), poses=("b",), scales=("b",), has_clock=True)
    assert unknowns.size == 8
    assert (unknowns.columns("a") == FIXED).all()
    step = np.array([0.01, -0.02, 0.03, 0.1, 0.2, 0.3, 0.05, 0.004])
    start = Estimate(corrections={"a": np.eye(4), "b": transform_of(np.array([0.5, 0, 0, 0, 0, 0.2]))})
    moved = unknowns.moved(start, step)
    np.testing.assert_allclose(twist_between(start.corrections["b"], moved.corrections["b"]), step[:6], atol=1e-12)
    np.testing.assert_array_equal(moved.corrections["a"], np.eye(4))
    assert (moved.depth_of("b"), moved.clock) == (pytest.approx((1.05, 0.0)), pytest.approx(0.004))


def test_a_twist_gives_back_its_transform() -> None:
    T = look_at([1.0, 0.3, 0.8], [0.2, 0.0, 0.0])
    np.testing.assert_allclose(transform_of(twist_of(T)), T, atol=1e-12)


class Given(Adjustment):
    """Residuals at random, of two views of a camera and of two cameras; the first camera is fixed."""

    def __init__(self) -> None:
        self.unknowns = Unknowns(cameras=("a", "b"), poses=("b",), scales=("b",), has_clock=True)

    def rows(self, estimate: Estimate, reach: float, *, with_robot: bool = True) -> Iterator[Rows]:
        rng = np.random.default_rng(3)
        for between in (("b", "b"), ("a", "b")):
            yield Rows(
                between=between,
                alike="",
                num_laid=60,
                residual=rng.normal(size=60) * 0.01,
                sigma=rng.uniform(0.002, 0.02, 60),
                jacobian=rng.normal(size=(60, 17)),
                columns=np.concatenate([*map(self.unknowns.columns, between), [7]]),
                clusters=rng.integers(0, 5, 60),
            )


def test_normal_equations_are_those_of_the_weighted_residuals() -> None:
    """Tukey's weights; columns of one unknown add up, and gradients of the clusters to the whole one."""
    given, reach, cut = Given(), 0.02, 2.0
    whole = given.normal(Estimate(corrections={}), (reach, cut))
    H, g = np.zeros((8, 8)), np.zeros(8)
    for rows in given.rows(Estimate(corrections={}), reach):
        for r, sigma, by in zip(rows.residual, rows.sigma, rows.jacobian, strict=True):
            J = np.zeros(8)
            for column, value in zip(rows.columns, by, strict=True):
                J[column] += value / sigma if column >= 0 else 0.0
            share = abs(r) / sigma / min(reach / sigma, cut)
            weight = (1 - share**2) ** 2 if share < 1 else 0.0
            H += weight * np.outer(J, J)
            g += weight * r / sigma * J
    scores = given.scores(Estimate(corrections={}), (reach, cut))
    assert scores.shape == (5, 8)
    for found, expected in ((whole.H, H), (whole.g, g), (scores.sum(axis=0), g)):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)

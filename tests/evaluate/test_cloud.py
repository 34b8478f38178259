"""Accuracy, completeness and Chamfer of point sets whose distances are known."""

import math

import numpy as np
import pytest

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.evaluate.held_out_depth import cloud_score, points_on, space_out, thin
from splatctrl_cli.formats.mesh import TriangleMesh
from splatctrl_cli.records import Float64
from tests.refused import expect_refusal


def plane(z: float, size: float = 0.1, step: float = 0.005) -> Float64:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, size, step), np.arange(0, size, step)))
    return np.column_stack([x, y, np.full(len(x), z)])


SEEN = np.ones(400, np.bool_)


def test_two_planes_are_as_far_apart_both_ways() -> None:
    """The completeness of seen surface is NaN if nothing was seen."""
    score = cloud_score(plane(0.003), plane(0.0), SEEN)
    assert [score[name] for name in ("accuracy", "completeness", "completeness_seen", "chamfer")] == pytest.approx(
        [0.003] * 4
    )
    assert score["accuracy_beyond"] == score["completeness_beyond"] == 0.0
    assert math.isnan(cloud_score(plane(0.0), plane(0.0), ~SEEN)["completeness_seen"])


def test_half_a_surface_is_accurate_and_incomplete() -> None:
    """Columns 2 cm and farther away are beyond; of the other 11 one is 1 cm off."""
    reference = plane(0.0, size=0.2, step=0.01)
    is_half = reference[:, 0] < 0.095
    score = cloud_score(reference[is_half], reference, is_half)
    assert score["accuracy"] == score["completeness_seen"] == 0.0
    assert (score["completeness_beyond"], score["completeness"]) == pytest.approx((9 / 20, 0.01 * 1 / 11))


def test_what_is_farther_than_the_maximum_counts_in_a_share_only() -> None:
    score = cloud_score(np.vstack([plane(0.001), plane(0.05)]), plane(0.0), SEEN, max_distance=0.02)
    assert (score["accuracy"], score["accuracy_beyond"]) == (pytest.approx(0.001), 0.5)


def test_another_unit_or_frame_is_told_from_a_bad_surface() -> None:
    expect_refusal(
        r"points within 20 mm of the scene's surface, got none; it spans",
        cloud_score,
        plane(0.0),
        1000 * plane(1.0),
        SEEN,
        error=NotEvaluableError,
    )
    expect_refusal(
        "--cloud-max: expected a distance above 0 m, got 0",
        cloud_score,
        plane(0.0),
        plane(0.0),
        SEEN,
        error=UsageError,
        max_distance=0.0,
    )


@pytest.mark.parametrize("factor", [1000.0, 0.001, 100.0])
def test_a_cloud_that_would_fit_in_another_unit_is_refused_with_that_unit(factor: float) -> None:
    surface = np.vstack([plane(0.0, 0.8, 0.05), plane(0.4, 0.8, 0.05)])
    expect_refusal(
        f"times as large it overlaps by 100%; .* --cloud-unit {0.02 * factor:g}$",
        cloud_score,
        surface,
        surface / factor,
        np.ones(len(surface), np.bool_),
        error=NotEvaluableError,
        unit=0.02,
    )


def test_points_that_do_not_count_enter_no_accuracy_but_complete_the_surface() -> None:
    points, counts = np.vstack([plane(0.003), plane(0.0)]), np.repeat([True, False], 400)
    score = cloud_score(points, plane(0.0), SEEN, counts=counts)
    assert (score["accuracy"], score["completeness"], score["num_points"]) == (pytest.approx(0.003), 0.0, 400)
    expect_refusal(
        "the scene's surface: expected points to compare, got none",
        cloud_score,
        points,
        plane(0.0),
        SEEN,
        error=NotEvaluableError,
        counts=counts & False,
    )


def test_spaced_points_are_what_taking_them_in_turn_leaves() -> None:
    points, spacing, kept = np.random.default_rng(3).uniform(0, 0.01, (800, 3)), 0.002, np.empty((0, 3))
    some = thin(points, spacing / 2)
    for point in some[np.random.default_rng(0).permutation(len(some))]:
        if np.all(np.linalg.norm(kept - point, axis=1) > spacing):
            kept = np.vstack([kept, point])
    assert 50 < len(kept) < 0.6 * len(some) and np.array_equal(space_out(points, spacing), kept)
    assert sorted(space_out(kept, spacing).tolist()) == sorted(kept.tolist()), "what is spaced stays as it is"
    assert len(space_out(np.empty((0, 3)), spacing)) == 0


def test_rigid_motion_changes_no_figure() -> None:
    rng = np.random.default_rng(1)
    points, reference = rng.uniform(0, 0.03, (200, 3)), rng.uniform(0, 0.03, (300, 3))
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    seen = rng.random(300) < 0.5
    assert cloud_score(points, reference, seen) == pytest.approx(
        cloud_score(points @ Q.T + 0.4, reference @ Q.T + 0.4, seen), abs=1e-12
    )


def test_thinning_leaves_one_point_to_a_cube() -> None:
    """Thinning in two parts gives the same points as thinning at once."""
    points = np.array([[0.0, 0.0, 0.0], [0.0004, 0.0, 0.0], [0.0011, 0.0, 0.0], [0.0, 0.0, 0.0012]])
    np.testing.assert_array_equal(thin(points, 0.001), points[[0, 2, 3]])
    assert len(thin(np.empty((0, 3)), 0.001)) == 0
    many = np.random.default_rng(2).uniform(-0.01, 0.01, (2000, 3))
    parts = np.vstack([thin(many[:900], 0.003), thin(many[900:], 0.003)])
    assert np.array_equal(thin(parts, 0.003), thin(many, 0.003))


def test_points_on_a_mesh_lie_on_it_evenly() -> None:
    vertices = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5], [0.1, 0.1, 0.5], [0.0, 0.1, 0.5]])
    points = points_on(
        TriangleMesh(vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]]), is_closed=False), 0.002
    )
    assert len(points) == pytest.approx(4 * 0.01 / 0.002**2, abs=1)
    np.testing.assert_allclose(points[:, 2], 0.5)
    assert points[:, :2].min() >= 0 and points[:, :2].max() <= 0.1 and abs(points[:, 0].mean() - 0.05) < 0.002

"""Trees of triangles against every triangle tried, in float64."""

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from splatctrl_cli.geometry import invert_transform, pose_at, transform_points
from splatctrl_cli.kernels.surface_image import TriangleTree, better
from splatctrl_cli.records import Bool, Float64
from tests.reference.triangles import distance_to_triangles, winding_number


def shell(holes: int = 0) -> Float64:
    """(F, 3, 3): two balls that overlap, in one soup, without its first faces."""
    one, other = (trimesh.creation.icosphere(subdivisions=3, radius=r) for r in (0.1, 0.07))
    other.apply_translation([0.12, 0.0, 0.0])
    return np.concatenate([one.triangles[holes:], other.triangles])


@pytest.mark.parametrize("holes", [0, 40])
def test_a_point_is_inside_what_surrounds_it_more_than_half(holes: int) -> None:
    corners = shell(holes)
    points = np.random.default_rng(1).uniform(-0.2, 0.25, (800, 3))
    number = winding_number(points, corners)
    is_told = np.abs(number - 0.5) > 0.02  # dipoles are not exact
    found = np.empty(len(points))
    TriangleTree(corners)._native.winding(points, found, 1)
    np.testing.assert_array_equal(found[is_told] > 0.5, number[is_told] > 0.5)
    assert np.count_nonzero(number > 0.5) > 10 and is_told.mean() > 0.95


def test_beyond_the_bound_there_is_no_triangle() -> None:
    corners = shell()
    points = np.random.default_rng(2).uniform(-0.3, 0.3, (300, 3))
    expected = distance_to_triangles(points, corners)
    distance, face, shares = TriangleTree(corners).closest(points, 0.05)
    is_near = expected <= 0.05
    np.testing.assert_allclose(distance, np.where(is_near, expected, np.inf), atol=1e-12)
    np.testing.assert_array_equal(face >= 0, is_near)
    at = np.einsum("qk,qka->qa", shares[is_near], corners[face[is_near]])
    np.testing.assert_allclose(np.linalg.norm(at - points[is_near], axis=1), expected[is_near], atol=1e-12)


def test_the_gap_is_that_of_the_nearest_ball_and_negative_inside() -> None:
    rng, corners = np.random.default_rng(3), shell()
    balls, radii = rng.uniform(-0.3, 0.3, (60, 3)), rng.uniform(0.0, 0.02, 60)
    turns = Rotation.random(15, random_state=rng).as_matrix()
    poses = np.array([pose_at(rng.uniform(-0.25, 0.25, 3), turn) for turn in turns])
    (gap, ball), again = (TriangleTree(corners, threads).gaps(poses, balls, radii) for threads in (1, 2))
    np.testing.assert_array_equal(again, (gap, ball))
    for k, T in enumerate(poses):
        there = transform_points(T, balls)
        away = distance_to_triangles(there, corners)
        signed = np.where(winding_number(there, corners) > 0.5, -away, away) - radii
        assert (gap[k], ball[k]) == (pytest.approx(signed.min(), abs=1e-12), signed.argmin())
    assert (gap < 0).any() and (gap > 0).any()


def test_nothing_has_no_gap() -> None:
    pose = invert_transform(pose_at(np.zeros(3)))[None]
    for corners, balls in ((shell(), np.zeros((0, 3))), (np.zeros((0, 3, 3)), np.zeros((1, 3)))):
        gap, ball = TriangleTree(corners).gaps(pose, balls, np.zeros(len(balls)))
        assert gap[0] == np.inf and ball[0] == -1


@cache
def placed_shells() -> tuple[list[TriangleTree], list[Float64], Float64, Float64, Float64]:
    """Two trees, their poses, points (N, 3) about them, and the distance and signed distance (N,) to the nearer."""
    rng, corners = np.random.default_rng(4), [shell(), 2.0 * shell(40)[::-1]]
    poses = [pose_at(rng.uniform(-0.2, 0.2, 3), Rotation.random(random_state=rng).as_matrix()) for _ in corners]
    points = rng.uniform(-0.5, 0.5, (600, 3))
    away, signed = [], []
    for T, triangles in zip(poses, corners, strict=True):
        there = transform_points(T, points)
        away.append(distance_to_triangles(there, triangles))
        signed.append(np.where(winding_number(there, triangles) > 0.5, -away[-1], away[-1]))
    return list(map(TriangleTree, corners)), poses, points, np.min(away, axis=0), np.min(signed, axis=0)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("is_outside", [False, True])
def test_the_signed_distance_is_that_to_the_nearest_tree_within_reach(threads: int, is_outside: bool) -> None:
    trees, poses, points, away, signed = placed_shells()
    expected = away if is_outside else signed
    outside = np.ones(len(points), bool) if is_outside else None
    other = np.random.default_rng(5).uniform(-0.1, 0.5, len(points))
    found = other.copy()
    better(found, points, trees, poses, within=0.1, enough=-np.inf, outside=outside, num_threads=threads)
    np.testing.assert_allclose(found, np.where(expected <= 0.1, np.minimum(expected, other), other), atol=1e-12)


def test_where_a_distance_is_enough_only_its_class_is_told() -> None:
    trees, poses, points, _, signed = placed_shells()
    found = np.full(len(points), np.inf)
    better(found, points, trees, poses, within=0.1, enough=0.04, outside=None, num_threads=1)

    def classes(distance: Float64) -> tuple[Bool, Bool]:
        return distance <= 0.04, distance <= 0.1

    np.testing.assert_array_equal(classes(found), classes(signed))
    assert all(20 < np.count_nonzero(chosen) < len(points) for chosen in (*classes(signed), signed < 0))

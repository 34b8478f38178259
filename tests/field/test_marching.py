import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.distance import GpdfField, SphereField, march
from splatctrl_cli.field.health import planar_zero_level
from tests.field.scenes import cloud, queries
from tests.reference import field as reference

LENGTH = 0.02


def plane(radius: float, spacing: float = 0.005) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(-0.4, 0.4, spacing), np.arange(-0.4, 0.4, spacing))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), np.full(x.size, radius)


def test_marching_converges_to_the_level_set_before_a_plane() -> None:
    centers, radii = plane(0.005)
    field, exact = GpdfField(centers, radii, LENGTH), SphereField(centers, radii)
    points = np.array([[0.0, 0.0, z] for z in (0.04, 0.08, 0.15)])
    plain = points[:, 2] - planar_zero_level(0.005, LENGTH)
    error = [np.abs(field.query(points)[0] - plain).max()]
    for steps in (1, 3, 5, 12):
        error.append(np.abs(march(field, exact, points, steps=steps).distance - plain).max())
    assert np.all(np.diff(error) < 0)
    assert error[0] > 0.02
    assert error[3] < 0.002
    assert error[4] < 3e-4
    hit = march(field, exact, points, steps=12).hit
    np.testing.assert_allclose(hit[:, 2], planar_zero_level(0.005, LENGTH), atol=5e-4)
    np.testing.assert_allclose(hit[:, :2], 0.0, atol=2e-3)


def test_marching_is_the_walk_that_the_reference_takes() -> None:
    centers, radii = cloud(300)
    points = queries(60)
    outside = points[reference.hard(points, centers, radii) > 0.02]
    found = march(GpdfField(centers, radii, LENGTH, truncation=1e-8), SphereField(centers, radii), outside, steps=4)
    walked, hit = reference.march(outside, centers, radii, LENGTH, 1e-6, steps=4)
    np.testing.assert_allclose(found.distance, walked, atol=2e-5)
    np.testing.assert_allclose(found.hit, hit, atol=1e-4)


def test_no_step_goes_through_a_sphere() -> None:
    wall, _ = plane(0.0, 0.004)
    centers = np.concatenate([[[0.0, 0.0, 0.08]], wall])  # one splat before a wall: row sums over-estimate there
    radii = np.full(len(centers), 0.003)
    field, exact = GpdfField(centers, radii, LENGTH), SphereField(centers, radii)
    points = np.array([0.0, 0.0, 0.08]) + 0.05 * np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 0.95], [1.0, 0.0, 0.1]])
    assert (field.query(points)[0] > exact.query(points)[0] + 1e-3).any()
    before = points
    for steps in range(1, 9):
        found = march(field, exact, points, steps=steps)
        assert (exact.query(found.hit)[0] > -1e-6).all()
        assert (np.linalg.norm(found.hit - before, axis=1) <= exact.query(before)[0] + 1e-6).all()
        before = found.hit


def test_points_behind_the_level_set_stay_where_they_are() -> None:
    centers, radii = plane(0.01)
    field, exact = GpdfField(centers, radii, LENGTH), SphereField(centers, radii)
    points = np.array([[0.0, 0.0, 0.002], [0.001, 0.0, -0.015]])
    found = march(field, exact, points)
    np.testing.assert_array_equal(found.hit, points)
    np.testing.assert_array_equal(found.distance, field.query(points)[0])
    assert (found.distance < 0).all()


def test_a_point_without_a_slope_has_walked_nowhere() -> None:
    centers, radii = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), np.zeros(2)
    found = march(GpdfField(centers, radii, LENGTH), SphereField(centers, radii), np.zeros((1, 3)))
    np.testing.assert_allclose(found.hit, 0.0, atol=1e-9)
    assert found.distance[0] == pytest.approx(found.rest[0])


def test_marching_needs_a_step() -> None:
    field = SphereField(*cloud(10))
    with pytest.raises(UsageError, match="expected at least 1 step, got 0"):
        march(field, field, queries(1), steps=0)

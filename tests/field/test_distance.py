"""Distance fields against their equations, the slope and stability of the kernels' (Table I), and marching."""

from itertools import product

import numpy as np
import pytest

from benchmarks.stability import PRINTED, table_rows
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import (
    KERNEL_OF,
    GpdfField,
    SafeField,
    SeField,
    SphereField,
    field_over,
    march,
    normalise,
)
from splatctrl_cli.field.slabs import planar_zero_level
from splatctrl_cli.records import DistanceField
from tests.field.scenes import cloud, plane, queries
from tests.reference import field as reference
from tests.refused import expect_refusal

LENGTH, NOISE = 0.02, 1e-6


def fields(centers: np.ndarray, radii: np.ndarray) -> list[DistanceField]:
    """Every field of the configuration."""
    spheres = Spheres.of(centers, radii)
    return [field_over(spheres, FieldConfig(distance=name, length_scale=LENGTH)) for name in KERNEL_OF]


def test_an_isolated_sphere_is_as_far_as_it_is_and_the_gradient_points_away() -> None:
    center, directions = np.array([1.0, 2.0, 3.0]), normalise(queries(50))
    for field in fields(center[None], np.array([0.1])):
        for away in (0.1, 0.15, 0.6):
            distance, gradient = field.query(center + away * directions)
            np.testing.assert_allclose(distance, away - 0.1, atol=2e-7)
            np.testing.assert_allclose(gradient, directions, atol=5e-6)


def test_hard_is_the_least_distance_to_a_sphere() -> None:
    centers, radii = cloud()
    distance, _ = SphereField(Spheres.of(centers, radii)).query(queries())
    np.testing.assert_allclose(distance, reference.hard(queries(), centers, radii), atol=2e-7)


def test_gpdf_is_the_log_sum_exp_of_the_paper_and_errs_upwards_by_no_more_than_its_truncation() -> None:
    centers, radii = cloud()
    expected = reference.gpdf(queries(), centers, radii, LENGTH, NOISE)
    slope = reference.gpdf_gradient(queries(), centers, radii, LENGTH, NOISE)
    for truncation in (2e-4, 2e-5, 2e-6):
        distance, gradient = GpdfField(
            Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, truncation=truncation)
        ).query(queries())
        assert (distance - expected).min() > -3e-7 and (distance - expected).max() < truncation + 3e-7
        if truncation <= FieldConfig.truncation:
            np.testing.assert_allclose(gradient, slope, atol=2e-3)


@pytest.mark.parametrize("length", [0.005, LENGTH, 0.1])
def test_se_is_the_gaussian_log_sum_exp_with_the_mean_radius_and_errs_upwards(length: float) -> None:
    centers, radii = cloud()
    expected, slope = reference.se(queries(), centers, radii, length, NOISE)
    has_value = ~np.isnan(expected)
    far = has_value & (np.nan_to_num(expected) > 0.02)  # nearer, the root's slope grows without limit
    for truncation in (1e-6, 2e-5, 2e-4, 2e-3):
        distance, gradient = SeField(
            Spheres.of(centers, radii), FieldConfig(length_scale=length, truncation=truncation)
        ).query_raw(queries())
        error = (distance - expected)[has_value]
        assert error.min() > -1.5e-6 and error.max() < truncation + 1.5e-6
        if truncation == 1e-6:
            np.testing.assert_array_equal(~np.isnan(distance), has_value)
            np.testing.assert_allclose(gradient[far], slope[far], atol=2e-3)


def test_fields_without_a_value_fall_back_to_the_exact_one() -> None:
    centers, radii = cloud()
    points = centers[:200] + 1e-3
    field = SeField(Spheres.of(centers, radii), FieldConfig(length_scale=0.1))
    has_none = np.isnan(field.query_raw(points)[0])
    assert has_none.any()
    for got, exact in zip(field.query(points), SphereField(Spheres.of(centers, radii)).query(points), strict=True):
        np.testing.assert_array_equal(got[has_none], exact[has_none])


def test_log_domain_agrees_with_the_printed_form_where_that_is_finite() -> None:
    centers, radii = cloud(100)
    literal = reference.gpdf_as_printed(queries(), centers, radii, 0.1, NOISE)
    np.testing.assert_allclose(
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=0.1)).query(queries())[0], literal, atol=1.1e-4
    )


def test_planar_zero_level_is_where_the_planar_field_is_zero() -> None:
    assert planar_zero_level(0.005, 0.02) == pytest.approx(0.0177, abs=1e-4)
    z = planar_zero_level(0.013, 0.007)
    assert z - 0.007 * np.log1p(z / 0.007) == pytest.approx(0.013, abs=1e-12)


def test_safe_field_never_exceeds_the_exact_distance() -> None:
    wall = plane(spacing=0.004, half=0.2)[0] - [0.0, 0.0, 0.02]
    centers = np.concatenate([[[0.0, 0.0, 0.05]], wall])  # one splat before it: row sums over-estimate its clearance
    radii, points = np.full(len(centers), 0.003), queries(400, extent=0.15)
    hard, kernel = (
        SphereField(Spheres.of(centers, radii)).query(points)[0],
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH)).query(points)[0],
    )
    safe, gradient = field_over(Spheres.of(centers, radii), FieldConfig(distance="safe_gpdf")).query(points)
    assert (kernel > hard + 1e-3).any() and (safe <= hard).all()
    np.testing.assert_array_equal(safe, np.minimum(hard, kernel))
    is_exact = hard < kernel
    np.testing.assert_array_equal(
        gradient[is_exact], SphereField(Spheres.of(centers, radii)).query(points)[1][is_exact]
    )
    np.testing.assert_array_equal(
        gradient[~is_exact], GpdfField(Spheres.of(centers, radii)).query(points)[1][~is_exact]
    )


@pytest.mark.parametrize("weights", ["rowsum", "cg"])
@pytest.mark.parametrize("largest", [0.012, 0.3])
def test_safe_in_one_walk_is_the_smaller_of_two_queries(largest: float, weights: str) -> None:
    centers, radii = cloud(700)
    radii[::40] = largest  # where one sphere is far larger, the walk of the kernel does not find the nearest
    config = FieldConfig(weights=weights)
    points = np.concatenate([queries(500), queries(200, extent=3.0)])
    for num in (700, 100):
        exact = SphereField(Spheres.of(centers[:num], radii[:num])).query(points)
        smooth = SeField(Spheres.of(centers[:num], radii[:num]), FieldConfig(weights=weights)).query_raw(points)
        is_smooth = smooth[0] < exact[0]
        assert largest > 0.1 or (is_smooth.any() and not is_smooth.all())
        distance, gradient = field_over(Spheres.of(centers[:num], radii[:num]), config).query(points)
        np.testing.assert_array_equal(distance, np.where(is_smooth, smooth[0], exact[0]))
        np.testing.assert_array_equal(gradient, np.where(is_smooth[:, None], smooth[1], exact[1]))


def test_one_point_or_none_or_many_can_be_asked() -> None:
    centers, radii = cloud()
    for field in fields(centers, radii):
        distance, gradient = field.query(queries(1000))
        assert field.query(np.empty((0, 3)))[0].shape == (0,)
        np.testing.assert_array_equal(field.query(queries(1000)[:1])[0], distance[:1])
        np.testing.assert_array_equal(field.query(queries(1000)[700:])[1], gradient[700:])


def test_threads_do_not_change_a_bit() -> None:
    centers, radii = cloud(3000)
    for kind in (SphereField, GpdfField):
        one, three = kind(Spheres.of(centers, radii), threads=1), kind(Spheres.of(centers, radii), threads=3)
        for a, b in zip(one.query(queries(1000)), three.query(queries(1000)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_normalised_gradients_have_length_one_or_none() -> None:
    np.testing.assert_allclose(normalise(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])), [[0, 0, 0], [0.6, 0, 0.8]])


def test_of_equal_distances_the_exact_one_wins() -> None:
    place, radius = np.zeros((1, 3)), np.zeros(1)
    safe = SafeField(
        SphereField(Spheres.of(place, radius)), GpdfField(Spheres.of(place, radius), FieldConfig(noise=0.0))
    )
    distance, gradient = safe.query(np.array([[1.0, 0, 0]]))
    assert (distance[0], gradient[0, 0]) == (1.0, 1.0)


def test_the_nearest_sphere_is_the_one_that_gives_the_distance() -> None:
    random = np.random.default_rng(5)
    centers, radii = random.uniform(-1, 1, (300, 3)), random.uniform(0.0, 0.3, 300)
    points = random.uniform(-2, 2, (50, 3))
    nearest = SphereField(Spheres.of(centers, radii)).nearest(points)
    gaps = np.linalg.norm(points[:, None] - centers, axis=2) - radii
    np.testing.assert_allclose(gaps[np.arange(50), nearest], gaps.min(axis=1), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_no_slope_of_the_gaussian_field_exceeds_its_bound_and_some_exceed_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    centers = np.concatenate([random.uniform(-0.1, 0.1, (150, 3)), random.normal(size=(50, 3)) * 0.02])
    radii = random.uniform(0.001, 0.02, 200)
    field = SeField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH))
    points = np.concatenate([random.uniform(-0.25, 0.25, (800, 3)), centers + random.normal(size=(200, 3)) * 0.02])
    distance, gradient = field.query_raw(points)
    there = ~np.isnan(distance)
    points, gradient = points[there], gradient[there]
    exponent = -(np.linalg.norm(points[:, None] - centers, axis=2) ** 2) / (2 * LENGTH**2) + field.weights.log_size
    log_sum = np.logaddexp.reduce(exponent, axis=1)
    share = np.exp(exponent - log_sum[:, None])
    root_squared = -2 * LENGTH**2 * log_sum
    entropy = -np.sum(share * (exponent - log_sum[:, None]), axis=1)
    spread = np.sqrt(np.sum(share * (radii - (share @ radii)[:, None]) ** 2, axis=1))
    place = np.sqrt(np.einsum("qn,qn->q", share, np.sum((centers - (share @ centers)[:, None]) ** 2, axis=2)))
    bound = np.sqrt(1 + 2 * LENGTH**2 * entropy / root_squared) + spread * place / LENGTH**2
    slope = np.linalg.norm(gradient, axis=1)
    assert np.all(field.weights.log_size <= 0)
    assert np.all(slope <= bound * 1.01 + 1e-3)  # float32, and terms that may be left out
    assert slope.max() > 1.1


def test_the_log_domain_is_finite_and_right_where_printed_forms_have_the_papers_ticks() -> None:
    rows = table_rows()
    for form, weights in product(PRINTED, ("lumped", "full process")):
        kind = ("no radii", weights, form, "float64")
        (row,) = [row for row in rows if (row.cloud, row.weights, row.form, row.number) == kind]
        assert tuple(cell.num_bad == 0 for cell in row.cells) == PRINTED[form], kind
    ours = [row for row in rows if row.form in {"log domain", "GpdfField"}]
    assert {row.cloud for row in ours} == {"no radii", "1 mm to 30 cm"}
    for row in ours:
        for cell in row.cells:
            assert cell.num_bad == 0 and cell.error is not None and cell.error < 1e-6, (row, cell)
    shifted = [row for row in rows if row.cloud != "no radii" and row.form == "eq. 12"]  # by the nearest centre
    assert len(shifted) == 2
    for row in shifted:
        assert [cell.num_bad > 0 for cell in row.cells] == [False, False, True, True, True, True]


def test_marching_converges_to_the_level_set_before_a_plane() -> None:
    centers, radii = plane(0.005)
    field, exact = (
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH)),
        SphereField(Spheres.of(centers, radii)),
    )
    points = np.array([[0.0, 0.0, z] for z in (0.04, 0.08, 0.15)])
    plain = points[:, 2] - planar_zero_level(0.005, LENGTH)
    error = [np.abs(field.query(points)[0] - plain).max()]
    for steps in (1, 3, 5, 12):
        error.append(np.abs(march(field, exact, points, steps=steps)[2] - plain).max())
    assert np.all(np.diff(error) < 0) and error[0] > 0.02 and error[3] < 0.002
    assert error[4] < 3e-4
    hit = march(field, exact, points, steps=12)[0]
    np.testing.assert_allclose(hit[:, 2], planar_zero_level(0.005, LENGTH), atol=5e-4)
    np.testing.assert_allclose(hit[:, :2], 0.0, atol=2e-3)


def test_marching_is_the_walk_that_the_reference_takes() -> None:
    centers, radii = cloud(300)
    points = queries(30)
    outside = points[reference.hard(points, centers, radii) > 0.02]
    hit, _, distance = march(
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, truncation=1e-8)),
        SphereField(Spheres.of(centers, radii)),
        outside,
        steps=4,
    )
    walked, expected = reference.march(outside, centers, radii, LENGTH, 1e-6, steps=4)
    np.testing.assert_allclose(distance, walked, atol=2e-5)
    np.testing.assert_allclose(hit, expected, atol=1e-4)


def test_no_step_goes_through_a_sphere() -> None:
    wall, _ = plane(0.0, 0.004)
    centers = np.concatenate([[[0.0, 0.0, 0.08]], wall])  # one splat before a wall: row sums over-estimate there
    radii = np.full(len(centers), 0.003)
    field, exact = (
        GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH)),
        SphereField(Spheres.of(centers, radii)),
    )
    points = np.array([0.0, 0.0, 0.08]) + 0.05 * np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 0.95], [1.0, 0.0, 0.1]])
    assert (field.query(points)[0] > exact.query(points)[0] + 1e-3).any()
    before = points
    for steps in range(1, 9):
        hit = march(field, exact, points, steps=steps)[0]
        assert (exact.query(hit)[0] > -1e-6).all()
        assert (np.linalg.norm(hit - before, axis=1) <= exact.query(before)[0] + 1e-6).all()
        before = hit


def test_points_behind_the_level_set_or_without_a_slope_stay_where_they_are() -> None:
    field, exact = (
        GpdfField(Spheres.of(*plane(0.01)), FieldConfig(length_scale=LENGTH)),
        SphereField(Spheres.of(*plane(0.01))),
    )
    points = np.array([[0.0, 0.0, 0.002], [0.001, 0.0, -0.015]])
    hit, _, distance = march(field, exact, points)
    np.testing.assert_array_equal(hit, points)
    np.testing.assert_array_equal(distance, field.query(points)[0])
    assert (distance < 0).all()
    two = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), np.zeros(2)
    hit, rest, distance = march(
        GpdfField(Spheres.of(*two), FieldConfig(length_scale=LENGTH)), SphereField(Spheres.of(*two)), np.zeros((1, 3))
    )
    np.testing.assert_allclose(hit, 0.0, atol=1e-9)
    assert distance[0] == pytest.approx(rest[0])
    expect_refusal("expected at least 1 step, got 0", march, exact, exact, points, steps=0, error=UsageError)

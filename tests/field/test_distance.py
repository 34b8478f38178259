import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.field.distance import DISTANCES, GpdfField, SafeField, SeField, SphereField, make_field, normalised
from splatctrl_cli.field.health import planar_zero_level
from splatctrl_cli.geometry import rotation_from_quat
from splatctrl_cli.records import DistanceField
from tests.field.scenes import cloud, queries
from tests.reference import field as reference

LENGTH, NOISE = 0.02, 1e-6
TRUNCATION_BOUND = FieldConfig.truncation + 1e-6  # [m], and float32


def fields(centers: np.ndarray, radii: np.ndarray) -> list[DistanceField]:
    """Every field of the configuration."""
    return [make_field(centers, radii, FieldConfig(distance=name, length_scale=LENGTH)) for name in DISTANCES]


def test_sdf_is_zero_on_an_isolated_sphere() -> None:
    directions = normalised(queries(50))
    for field in fields(np.array([[1.0, 2.0, 3.0]]), np.array([0.1])):
        distance, gradient = field.query(np.array([1.0, 2.0, 3.0]) + 0.1 * directions)
        np.testing.assert_allclose(distance, 0.0, atol=2e-7)
        np.testing.assert_allclose(gradient, directions, atol=5e-6)


def test_hard_is_the_least_distance_to_a_sphere() -> None:
    centers, radii = cloud()
    distance, _ = SphereField(centers, radii).query(queries())
    np.testing.assert_allclose(distance, reference.hard(queries(), centers, radii), atol=2e-7)


def test_gpdf_is_the_log_sum_exp_of_the_paper() -> None:
    centers, radii = cloud()
    distance, gradient = GpdfField(centers, radii, LENGTH).query(queries())
    np.testing.assert_allclose(
        distance, reference.gpdf(queries(), centers, radii, LENGTH, NOISE), atol=TRUNCATION_BOUND
    )
    expected = reference.gpdf_gradient(queries(), centers, radii, LENGTH, NOISE)
    np.testing.assert_allclose(gradient, expected, atol=2e-3)


def test_gpdf_errs_upwards_and_by_no_more_than_its_truncation() -> None:
    centers, radii = cloud()
    expected = reference.gpdf(queries(), centers, radii, LENGTH, NOISE)
    for truncation in (2e-4, 2e-5, 2e-6):
        error = GpdfField(centers, radii, LENGTH, truncation=truncation).query(queries())[0] - expected
        assert error.min() > -3e-7
        assert error.max() < truncation + 3e-7


def test_se_is_the_gaussian_log_sum_exp_with_the_mean_radius() -> None:
    centers, radii = cloud()
    for length in (0.005, LENGTH, 0.1):
        expected, slope = reference.se(queries(), centers, radii, length, NOISE)
        distance, gradient = SeField(centers, radii, length, truncation=1e-6).query_raw(queries())
        np.testing.assert_array_equal(np.isnan(distance), np.isnan(expected))
        np.testing.assert_allclose(distance, expected, atol=2.5e-6)
        far = expected > 0.02  # nearer, the root's slope grows without limit
        np.testing.assert_allclose(gradient[far], slope[far], atol=2e-3)


def test_se_errs_upwards_and_by_no_more_than_its_truncation() -> None:
    centers, radii = cloud()
    expected, _ = reference.se(queries(), centers, radii, LENGTH, NOISE)
    has_value = ~np.isnan(expected)
    for truncation in (2e-3, 2e-4, 2e-5):
        distance = SeField(centers, radii, LENGTH, truncation=truncation).query_raw(queries())[0]
        error = (distance - expected)[has_value]
        assert error.min() > -1e-6
        assert error.max() < truncation + 1e-6


def test_fields_without_a_value_fall_back_to_the_exact_one() -> None:
    centers, radii = cloud()
    points = centers[:200] + 1e-3
    field = SeField(centers, radii, 0.1)
    has_none = np.isnan(field.query_raw(points)[0])
    assert has_none.any()
    for got, exact in zip(field.query(points), SphereField(centers, radii).query(points), strict=True):
        np.testing.assert_array_equal(got[has_none], exact[has_none])


def test_log_domain_agrees_with_the_printed_form_where_that_is_finite() -> None:
    centers, radii = cloud(100)
    literal = reference.gpdf_as_printed(queries(), centers, radii, 0.1, NOISE)
    np.testing.assert_allclose(GpdfField(centers, radii, 0.1).query(queries())[0], literal, atol=1.1e-4)


@pytest.mark.parametrize("length", [0.005, 0.02, 0.1])
def test_gradient_is_that_of_the_distance(length: float) -> None:
    centers, radii = cloud(200)
    points = queries(100) + np.array([0.0, 0.0, 0.6])  # away from the kinks of the nearest sphere's surface
    field = GpdfField(centers, radii, length, truncation=1e-8)
    step = 1e-3
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (field.query(points + shift)[0] - field.query(points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(field.query(points)[1][:, axis], slope, atol=4e-4)


def test_hard_gradient_is_that_of_the_distance_away_from_kinks() -> None:
    centers, radii = cloud(200)
    points, step = queries(200), 1e-4
    each = np.sort(reference.distances(points, centers) - radii, axis=1)
    points = points[each[:, 1] - each[:, 0] > 4 * step]  # one sphere is nearest all along the difference
    assert len(points) > 50
    field = SphereField(centers, radii)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (field.query(points + shift)[0] - field.query(points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(field.query(points)[1][:, axis], slope, atol=3e-3)


def test_distance_moves_with_the_splats() -> None:
    centers, radii = cloud()
    rotation, shift = rotation_from_quat([0.1, -0.5, 0.3, 0.8]), np.array([0.7, -1.1, 0.4])
    moved_fields = fields(centers @ rotation.T + shift, radii)
    for field, moved in zip(fields(centers, radii), moved_fields, strict=True):
        distance, gradient = field.query(queries())
        there, gradient_there = moved.query(queries() @ rotation.T + shift)
        np.testing.assert_allclose(there, distance, atol=2 * TRUNCATION_BOUND)
        is_smooth = np.abs(there - distance) < 1e-6
        np.testing.assert_allclose(gradient_there[is_smooth], (gradient @ rotation.T)[is_smooth], atol=4e-3)


def test_order_of_the_splats_does_not_matter() -> None:
    centers, radii = cloud()
    order = np.random.default_rng(3).permutation(len(radii))
    for field, shuffled in zip(fields(centers, radii), fields(centers[order], radii[order]), strict=True):
        np.testing.assert_allclose(shuffled.query(queries())[0], field.query(queries())[0], atol=TRUNCATION_BOUND)


def test_distance_scales_with_the_scene() -> None:
    centers, radii = cloud()
    scale = 8.0  # a power of two: rounding scales too
    small = GpdfField(centers, radii, LENGTH).query(queries())
    large = GpdfField(scale * centers, scale * radii, scale * LENGTH).query(scale * queries())
    np.testing.assert_allclose(large[0], scale * small[0], rtol=1e-5, atol=scale * 1e-6)
    np.testing.assert_allclose(large[1], small[1], atol=1e-4)
    exact = SphereField(centers, radii).query(queries())[0]
    np.testing.assert_allclose(
        SphereField(scale * centers, scale * radii).query(scale * queries())[0], scale * exact, atol=1e-6
    )


@pytest.mark.parametrize("exponent", range(-10, 3))
def test_field_is_finite_for_every_length_scale(exponent: int) -> None:
    centers, radii = cloud(100)
    radii[::7] = 0.2
    points = np.concatenate([queries(100), centers[:20], 40.0 + queries(5)])
    for length in (10.0**exponent, 3.0 * 10.0**exponent):
        distance, gradient = GpdfField(centers, radii, length).query(points)
        assert np.isfinite(distance).all()
        assert np.isfinite(gradient).all()
        if length < 1e-5:
            expected = reference.hard(points, centers, radii)
            np.testing.assert_allclose(distance, expected, atol=10 * length + 1e-5)


def test_planar_bias_is_z_less_l_log_one_plus_z_over_l() -> None:
    spacing, length = 0.005, 0.02
    x, y = np.meshgrid(np.arange(-0.35, 0.35, spacing), np.arange(-0.35, 0.35, spacing))
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    heights = np.array([0.01, 0.02, 0.05, 0.1])
    points = np.stack([np.zeros(4), np.zeros(4), heights], axis=1)
    distance, gradient = GpdfField(centers, np.zeros(x.size), length).query(points)
    np.testing.assert_allclose(distance, heights - length * np.log(1 + heights / length), atol=3e-4)
    np.testing.assert_allclose(gradient[:, 2], heights / (length + heights), atol=2e-2)


def test_planar_zero_level_is_where_the_planar_field_is_zero() -> None:
    assert planar_zero_level(0.005, 0.02) == pytest.approx(0.0177, abs=1e-4)
    z = planar_zero_level(0.013, 0.007)
    assert z - 0.007 * np.log1p(z / 0.007) == pytest.approx(0.013, abs=1e-12)


def test_safe_field_never_exceeds_the_exact_distance() -> None:
    sparse = np.array([[0.0, 0.0, 0.05]])  # one splat before a dense plane: row sums over-estimate its clearance
    x, y = np.meshgrid(np.arange(-0.2, 0.2, 0.004), np.arange(-0.2, 0.2, 0.004))
    centers = np.concatenate([sparse, np.stack([x.ravel(), y.ravel(), np.full(x.size, -0.02)], axis=1)])
    radii, points = np.full(len(centers), 0.003), queries(400, extent=0.15)
    hard, kernel = SphereField(centers, radii).query(points)[0], GpdfField(centers, radii, LENGTH).query(points)[0]
    safe, gradient = make_field(centers, radii, FieldConfig(distance="safe_gpdf")).query(points)
    assert (kernel > hard + 1e-3).any()
    assert (safe <= hard).all()
    np.testing.assert_array_equal(safe, np.minimum(hard, kernel))
    is_exact = hard < kernel
    np.testing.assert_array_equal(gradient[is_exact], SphereField(centers, radii).query(points)[1][is_exact])
    np.testing.assert_array_equal(gradient[~is_exact], GpdfField(centers, radii).query(points)[1][~is_exact])


@pytest.mark.parametrize("weights", ["rowsum", "cg"])
@pytest.mark.parametrize("largest", [0.012, 0.3])
def test_safe_in_one_walk_is_the_smaller_of_two_queries(largest: float, weights: str) -> None:
    centers, radii = cloud(700)
    radii[::40] = largest  # where one sphere is far larger, the walk of the kernel does not find the nearest
    config = FieldConfig(weights=weights)
    points = np.concatenate([queries(500), queries(200, extent=3.0)])
    for num in (700, 100):
        exact = SphereField(centers[:num], radii[:num]).query(points)
        smooth = SeField(centers[:num], radii[:num], weights=weights).query_raw(points)
        is_smooth = smooth[0] < exact[0]
        assert largest > 0.1 or (is_smooth.any() and not is_smooth.all())
        distance, gradient = make_field(centers[:num], radii[:num], config).query(points)
        np.testing.assert_array_equal(distance, np.where(is_smooth, smooth[0], exact[0]))
        np.testing.assert_array_equal(gradient, np.where(is_smooth[:, None], smooth[1], exact[1]))


def test_duplicates_do_not_change_the_kernel_field() -> None:
    centers, radii = cloud(200)
    once = GpdfField(centers, radii, LENGTH, noise=0.0)
    twice = GpdfField(np.concatenate([centers] * 2), np.concatenate([radii] * 2), LENGTH, noise=0.0)
    np.testing.assert_allclose(twice.query(queries())[0], once.query(queries())[0], atol=TRUNCATION_BOUND)


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
        one, three = kind(centers, radii, threads=1), kind(centers, radii, threads=3)
        for a, b in zip(one.query(queries(1000)), three.query(queries(1000)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_bad_splats_are_named() -> None:
    centers, radii = cloud(10)
    centers[7, 1] = np.nan
    with pytest.raises(InputError, match=r"splat 7: expected a finite centre, got \[.*nan.*1 such"):
        SphereField(centers, radii)
    centers, radii = cloud(10)
    radii[3] = -0.001
    with pytest.raises(InputError, match="splat 3: expected a finite radius of 0 m or more"):
        GpdfField(centers, radii)
    with pytest.raises(NotEvaluableError, match="got none"):
        SphereField(np.empty((0, 3)), np.empty(0))
    with pytest.raises(InputError, match=r"expected centres \(N, 3\)"):
        SphereField(np.zeros((4, 2)), np.zeros(4))


def test_bad_queries_and_settings_are_named() -> None:
    centers, radii = cloud(10)
    with pytest.raises(InputError, match="query point 1: expected finite coordinates"):
        SphereField(centers, radii).query(np.array([[0.0, 0, 0], [0, np.inf, 0]]))
    with pytest.raises(InputError, match="query point 1: expected finite coordinates"):
        make_field(centers, radii, FieldConfig()).query(np.array([[0.0, 0, 0], [0, 0, np.nan]]))
    with pytest.raises(InputError, match=r"expected shape \(Q, 3\)"):
        GpdfField(centers, radii).query(np.zeros(3))
    with pytest.raises(UsageError, match="length_scale: expected 1e-10 to 1000 m"):
        GpdfField(centers, radii, 0.0)
    with pytest.raises(UsageError, match="weights: expected rowsum, voxel or cg, got 'mass'"):
        GpdfField(centers, radii, weights="mass")
    with pytest.raises(UsageError, match="distance: expected safe, safe_gpdf, hard, se or gpdf, got 'tsdf'"):
        make_field(centers, radii, FieldConfig(distance="tsdf"))
    with pytest.raises(UsageError, match="truncation"):
        GpdfField(centers, radii, truncation=0.0)


def test_normalised_gradients_have_length_one_or_none() -> None:
    unit = normalised(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]]))
    np.testing.assert_allclose(unit, [[0, 0, 0], [0.6, 0, 0.8]])


def test_of_equal_distances_the_exact_one_wins() -> None:
    place, radius = np.zeros((1, 3)), np.zeros(1)
    safe = SafeField(SphereField(place, radius), GpdfField(place, radius, noise=0.0))
    distance, gradient = safe.query(np.array([[1.0, 0, 0]]))
    assert (distance[0], gradient[0, 0]) == (1.0, 1.0)


def test_the_nearest_sphere_is_the_one_that_gives_the_distance() -> None:
    random = np.random.default_rng(5)
    centers, radii = random.uniform(-1, 1, (300, 3)), random.uniform(0.0, 0.3, 300)
    points = random.uniform(-2, 2, (50, 3))
    nearest = SphereField(centers, radii).nearest(points)
    gaps = np.linalg.norm(points[:, None] - centers, axis=2) - radii
    np.testing.assert_allclose(gaps[np.arange(50), nearest], gaps.min(axis=1), atol=1e-6)

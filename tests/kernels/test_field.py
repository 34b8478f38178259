import numpy as np
import pytest

from splatctrl_cli.field.clusters import cluster_points
from splatctrl_cli.kernels import field as native
from splatctrl_cli.kernels import native as module
from tests.field.scenes import cloud, queries


def test_soft_min_of_one_entry_is_its_score() -> None:
    points = cluster_points(np.array([[1.0, 2.0, 3.0]]))
    score, gradient = native.soft_min(
        points.with_offsets(np.array([0.25])), 0.02, 1e-3, points.relative(np.array([[1.0, 2.0, 5.0]]))
    )
    assert (score[0], gradient[0].tolist()) == (1.75, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("num", [1, 15, 16, 17, 33])
def test_spare_entries_of_the_last_cluster_are_never_taken(num: int) -> None:
    centers, radii = cloud(num)
    points = cluster_points(centers)
    score, _ = native.nearest(points.with_offsets(radii), points.relative(queries()))
    expected = np.min(np.linalg.norm(queries()[:, None] - centers, axis=2) - radii, axis=1)
    np.testing.assert_allclose(score, expected, atol=2e-7)
    assert points.num_points == num


def test_every_point_is_in_the_box_of_its_cluster() -> None:
    points = cluster_points(cloud(500)[0])
    grouped = points.centers.reshape(3, -1, native.LANES)
    np.testing.assert_array_equal(grouped.min(axis=2), points.bounds[:3])
    np.testing.assert_array_equal(grouped.max(axis=2), points.bounds[3:])
    assert sorted(points.source[~points.is_spare]) == list(range(500))


def test_at_a_centre_the_gradient_is_zero() -> None:
    points = cluster_points(cloud(50)[0])
    at = np.ascontiguousarray(points.centers.T[:5])
    assert not native.nearest(points.with_offsets(np.full(50, 0.01)), at)[1].any()
    assert np.isfinite(native.soft_min(points.with_offsets(np.zeros(50)), 1e-10, 1e-3, at)[1]).all()


def test_another_dtype_is_refused_not_converted() -> None:
    points = cluster_points(cloud(50)[0])
    with pytest.raises(TypeError):
        native.nearest(points.with_offsets(np.zeros(50)), queries())  # float64


def test_arrays_that_do_not_fit_are_refused() -> None:
    points = cluster_points(cloud(50)[0])
    whole = points.with_offsets(np.zeros(50))
    at, score, gradient = np.zeros((2, 3), np.float32), np.zeros(2, np.float32), np.zeros((1, 3), np.float32)
    with pytest.raises(ValueError, match="one entry per point"):
        module.field_nearest(whole.centers, whole.offsets, whole.bounds, whole.max_offsets, at, 1, score, gradient)
    with pytest.raises(ValueError, match=r"expected \(16 C\)"):
        module.field_nearest(
            whole.centers, whole.offsets[:16].copy(), whole.bounds, whole.max_offsets, at, 1, score, gradient
        )


def test_interpolation_repeats_a_trilinear_function() -> None:
    nodes = np.stack(np.meshgrid(*[np.arange(n) for n in (4, 5, 6)], indexing="ij"), axis=-1) * 0.5 + [1.0, 2.0, 3.0]

    def trilinear(p: np.ndarray) -> np.ndarray:
        return 1 + 2 * p[..., 0] - p[..., 1] + p[..., 0] * p[..., 1] * p[..., 2]

    points = np.random.default_rng(0).uniform([1, 2, 3], [2.5, 4, 5.5], (50, 3))
    value, gradient = native.interpolate(trilinear(nodes).astype(np.float32), np.array([1.0, 2.0, 3.0]), 0.5, points)
    np.testing.assert_allclose(value, trilinear(points), rtol=1e-6)
    x, y, z = points.T
    np.testing.assert_allclose(gradient, np.stack([2 + y * z, x * z - 1, x * y], axis=1), rtol=2e-5)

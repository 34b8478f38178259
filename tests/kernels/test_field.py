import numpy as np
import pytest

from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.kernels import field as native
from splatctrl_cli.kernels import native as module
from splatctrl_cli.records import Box
from tests.field.scenes import cloud, queries


@pytest.mark.parametrize("num", [1, 15, 16, 17, 33, 257])
def test_spare_entries_are_never_taken(num: int) -> None:
    centers, radii = cloud(num)
    points = Spheres.of(centers, np.zeros(len(centers)))
    score, _, entry = native.nearest(points.clusters, points.offsets(radii), points.relative(queries()))
    each = np.linalg.norm(queries()[:, None] - centers, axis=2) - radii
    np.testing.assert_allclose(score, each.min(axis=1), atol=2e-7)
    assert points.is_point[entry].all()
    np.testing.assert_allclose(each[np.arange(len(each)), points.source[entry]], each.min(axis=1), atol=2e-7)
    assert points.num_points == num


@pytest.mark.parametrize("is_matern", [True, False])
def test_row_sums_are_those_of_the_kernel_matrix_in_any_order(is_matern: bool) -> None:
    centers, _ = cloud(700)
    d = np.linalg.norm(centers[:, None] - centers, axis=2)
    for length in (1e-6, 0.004, 0.05, 3.0):
        kernel = np.exp(-d / length) if is_matern else np.exp(-0.5 * (d / length) ** 2)
        points = Spheres.of(centers, np.zeros(len(centers)))
        sums = points.gather(native.row_sums(points.clusters, points.is_point, length, is_matern=is_matern))
        np.testing.assert_allclose(sums, kernel.sum(axis=1), rtol=1e-6, atol=700 * 2.0**-25)
        order = np.random.default_rng(0).permutation(700)
        frame = Box(lower=centers.min(axis=0), upper=centers.max(axis=0))
        more = np.concatenate([centers[order], [[9.0, 9.0, 9.0]]])
        first, other = (
            Spheres.of(centers, np.zeros(len(centers)), frame),
            Spheres.of(more, np.zeros(len(more)), frame),
        )
        a = first.gather(native.row_sums(first.clusters, first.is_point, 0.05, is_matern=is_matern, threads=1))
        b = other.gather(native.row_sums(other.clusters, other.is_point, 0.05, is_matern=is_matern, threads=3))
        np.testing.assert_array_equal(b[:-1], a[order])


def test_at_a_centre_the_gradient_is_zero_or_finite() -> None:
    points = Spheres.of(*cloud(50))
    at = np.ascontiguousarray(points.clusters.centers.T[:5])
    assert not native.nearest(points.clusters, points.offsets(np.full(50, 0.01)), at)[1].any()
    assert np.isfinite(native.matern(points.clusters, points.offsets(np.zeros(50)), None, 1e-10, 1e-3, at)[1]).all()


def test_arrays_that_do_not_fit_are_refused_and_another_dtype_not_converted() -> None:
    points = Spheres.of(*cloud(50))
    clusters, offsets = points.clusters, points.offsets(np.zeros(50))
    with pytest.raises(TypeError):
        native.nearest(clusters, offsets, queries())  # float64
    given = [clusters.centers, clusters.boxes, offsets.values, offsets.maxima, np.zeros((2, 3), np.float32), 1]
    found = np.zeros(2, np.float32), np.zeros((1, 3), np.float32), np.zeros(2, np.int32)
    with pytest.raises(ValueError, match="one entry per point"):
        module.field_nearest(*given, *found)
    given[2] = offsets.values[:16].copy()
    with pytest.raises(ValueError, match=r"expected \(16 C\)"):
        module.field_nearest(*given, *found)
    span = native.GridSpan(origin=np.zeros(3), voxel=0.1, shape=(20, 4, 4), first=4, last=12)
    with pytest.raises(ValueError, match="whole blocks"):
        native.bake_hard(clusters, offsets, span, np.zeros((8, 4, 4), np.float32))


def test_interpolation_repeats_a_trilinear_function() -> None:
    nodes = np.stack(np.meshgrid(*[np.arange(n) for n in (4, 5, 6)], indexing="ij"), axis=-1) * 0.5 + [1.0, 2.0, 3.0]

    def trilinear(p: np.ndarray) -> np.ndarray:
        return 1 + 2 * p[..., 0] - p[..., 1] + p[..., 0] * p[..., 1] * p[..., 2]

    points = np.random.default_rng(0).uniform([1, 2, 3], [2.5, 4, 5.5], (50, 3))
    value, gradient = native.interpolate(trilinear(nodes).astype(np.float32), np.array([1.0, 2.0, 3.0]), 0.5, points)
    np.testing.assert_allclose(value, trilinear(points), rtol=1e-6)
    x, y, z = points.T
    np.testing.assert_allclose(gradient, np.stack([2 + y * z, x * z - 1, x * y], axis=1), rtol=2e-5)

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.config.fixed import VOXELS_PER_LENGTH
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.field import weights as weights_module
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SeField
from splatctrl_cli.field.weights import (
    METHODS,
    Kernel,
    conjugate_gradients,
    log_row_sums,
    solve_process,
    voxel_row_sums,
)
from splatctrl_cli.geometry import rotation_from_quat
from tests.field.scenes import cloud, queries
from tests.reference import field as reference
from tests.refused import expect_refusal

LENGTH, NOISE = 0.02, 1e-6
MATERN, GAUSSIAN = (Kernel(length=LENGTH, is_matern=is_matern) for is_matern in (True, False))


def test_voxel_density_is_spread_convolved_and_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    centers, _ = cloud(60)
    centers = 0.1 * centers  # all within reach of each other
    expected = reference.voxel_row_sums(centers, LENGTH, LENGTH / VOXELS_PER_LENGTH)
    np.testing.assert_allclose(voxel_row_sums(centers, LENGTH, MATERN.value), expected, rtol=1e-9)
    monkeypatch.setattr(weights_module, "NODES", 48)  # blocks of 15 cells rather than 63
    np.testing.assert_allclose(voxel_row_sums(centers + 7.0, LENGTH, MATERN.value), expected, rtol=1e-9)


@pytest.mark.parametrize("kernel", [MATERN, GAUSSIAN])
def test_voxel_density_is_near_the_exact_one_across_blocks(kernel: Kernel) -> None:
    centers, radii = cloud(3000)
    centers *= 2.0  # 1.2 m: blocks of 0.63 m
    exact = np.exp(log_row_sums(kernel, Spheres.of(centers, radii)))
    sums = voxel_row_sums(centers, LENGTH, kernel.value)
    error = LENGTH * np.log(sums / exact)  # of the distance, were the splat alone in being near [m]
    assert np.sqrt(np.mean(error**2)) < 3e-4 and np.abs(error).max() < 2e-3


def test_a_lone_splat_has_a_density_of_one_and_a_distant_one_does_not_change_it() -> None:
    assert voxel_row_sums(np.array([[0.3, 0.1, 0.2]]), LENGTH, MATERN.value) == pytest.approx(1.0)
    sums = voxel_row_sums(
        np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.5, 0.5, 0.5], [900.0, 0.0, 0.0]]), LENGTH, MATERN.value
    )
    np.testing.assert_allclose(sums[2:], 1.0, atol=1e-12)
    np.testing.assert_allclose(sums[:2], 1 + np.exp(-0.5), rtol=0.1)


@pytest.mark.parametrize("is_matern", [True, False])
def test_process_weights_solve_the_dense_system(is_matern: bool) -> None:
    centers, radii = cloud(400)
    kernel = Kernel(length=LENGTH, is_matern=is_matern)
    log_values = radii / LENGTH if is_matern else np.zeros(400)
    scaled, log_scale, _, residual = solve_process(centers, log_values, LENGTH, kernel.value, NOISE)
    dense = reference.process_weights(kernel.value(reference.distances(centers, centers)), np.exp(log_values), NOISE)
    # The dense kernel is not cut off at 8 l, where a Matern kernel is 3e-4.
    np.testing.assert_allclose(scaled * np.exp(log_scale), dense, atol=3e-3)
    assert (dense < 0).any()
    assert residual < 1e-6
    weights = METHODS["cg"](Spheres.of(centers, radii), kernel, NOISE, 1)
    assert weights.num_iterations
    np.testing.assert_allclose(weights.sign * np.exp(weights.log_size + log_values), dense, atol=3e-3)


def test_field_of_the_full_process_is_that_of_the_dense_one() -> None:
    centers, radii = cloud(500)
    distance = GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, weights="cg")).query_raw(
        queries()
    )[0]
    expected = reference.process_gpdf(queries(), centers, radii, LENGTH, NOISE)
    np.testing.assert_allclose(distance, expected, atol=2e-4)  # of the cut-off at 8 l
    se = SeField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, noise=1e-2, weights="cg")).query_raw(
        queries()
    )[0]
    has_value = ~np.isnan(se)  # where signed terms all but cancel the field may say that it has none
    assert has_value.mean() > 0.98
    expected = reference.process_se(queries(), centers, radii, LENGTH, 1e-2)
    np.testing.assert_allclose(se[has_value], expected[has_value], atol=2e-5)


def test_weights_of_either_sign_are_cut_off_later_than_sums_that_cannot_cancel() -> None:
    centers, radii = cloud(600)
    coarse, fine = (
        GpdfField(
            Spheres.of(centers, radii),
            FieldConfig(length_scale=0.05, weights="cg", noise=1e-2, truncation=truncation),
        ).query_raw(queries(2000))[0]
        for truncation in (1e-2, 1e-6)
    )
    np.testing.assert_allclose(coarse, fine, atol=1e-6)


def test_the_full_process_is_zero_on_each_sphere_where_lumping_is_not() -> None:
    centers, radii = cloud(500)
    occupied = {
        name: GpdfField(
            Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, weights=name, truncation=1e-7)
        ).query(centers)[0]
        + radii
        for name in ("cg", "rowsum")
    }
    assert np.abs(occupied["cg"]).max() < 2e-4  # eq. 8 interpolates; the matrix is cut off at 8 l, the field is not
    assert np.abs(occupied["rowsum"]).max() > 1e-3


def test_groups_of_splats_far_apart_do_not_drown_each_other() -> None:
    centers = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.001, 0.0, 0.0]])
    radii = np.array([0.5, 0.001, 0.002])
    length = 1e-3  # e^(0.5 / l) is beyond float64
    distance = GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=length, weights="cg")).query(
        np.array([[2.2, 0.0, 0.0], [0.0, 0.9, 0.0]])
    )[0]
    np.testing.assert_allclose(distance, [0.197, 0.4], atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "change", "weights", "length", "words"),
    [
        (GpdfField, {}, "cg", 0.005, r"radii that differ by at most 16 length scales .*, got 60\.0; set a larger"),
        (SeField, {"CG_ITERATIONS": 20}, "cg", LENGTH, r"after 20 iterations, got .*; set a larger field.noise"),
        (SeField, {"available_memory": lambda: 1000}, "cg", LENGTH, r"pairs of splats within 8 .* GiB is free"),
        (GpdfField, {"MAX_BLOCKS": 0}, "voxel", LENGTH, r"at most 0 blocks of voxels with splats, got .*; set"),
    ],
)
def test_what_cannot_be_solved_is_refused_in_words(
    kind: type[GpdfField] | type[SeField],
    change: dict[str, object],
    weights: str,
    length: float,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    centers, radii = cloud(300)
    radii[0] = 0.3
    for name, value in change.items():
        monkeypatch.setattr(weights_module, name, value)
    expect_refusal(
        words,
        kind,
        Spheres.of(centers, radii),
        FieldConfig(length_scale=length, weights=weights),
        error=(UsageError, NotEvaluableError),
    )


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    expect_refusal(
        "not positive definite",
        conjugate_gradients,
        csr_array(np.array([[1.0, 3.0], [3.0, 1.0]])),
        np.array([1.0, -0.5]),
        1e-9,
        error=NotEvaluableError,
    )


def test_the_refusal_names_the_residual_that_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    matrix, values, tolerance = csr_array(np.diag([1.0, 1.1, 1.3])), np.array([1.0, -0.5, 2.0]), 1e-9
    assert conjugate_gradients(matrix, values, tolerance)[2] <= 2e-9
    monkeypatch.setattr(weights_module, "CG_ITERATIONS", 1)
    expect_refusal(
        r"expected a residual of at most 2\.0e-09 after 1 iterations",
        conjugate_gradients,
        matrix,
        values,
        tolerance,
        error=NotEvaluableError,
    )


def test_coinciding_splats_share_their_weight() -> None:
    centers, radii = np.zeros((3, 3)), np.full(3, 0.01)
    for weights in ("rowsum", "voxel", "cg"):
        field = GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=LENGTH, weights=weights, noise=1e-3))
        assert field.query(np.array([[0.1, 0.0, 0.0]]))[0][0] == pytest.approx(
            0.09, abs=5e-3 if weights == "voxel" else 1e-4
        ), weights


@pytest.mark.parametrize("kind", [GpdfField, SeField])
def test_voxel_weights_follow_the_splats_and_their_scale_and_not_their_order(
    kind: type[GpdfField] | type[SeField],
) -> None:
    """`test_symmetry` has the same for row sums and for the full process."""
    centers, radii = cloud(400)
    points, config = queries(100), FieldConfig(length_scale=LENGTH, noise=1e-2, weights="voxel")
    distance = kind(Spheres.of(centers, radii), config).query(points)[0]
    order = np.random.default_rng(3).permutation(400)
    np.testing.assert_allclose(
        kind(Spheres.of(centers[order], radii[order]), config).query(points)[0], distance, atol=2e-5
    )
    scaled = kind(Spheres.of(8 * centers, 8 * radii), replace(config, length_scale=8 * LENGTH, truncation=8 * 2e-5))
    np.testing.assert_allclose(scaled.query(8 * points)[0], 8 * distance, atol=4e-5)
    rotation, shift = rotation_from_quat([0.1, -0.5, 0.3, 0.8]), np.array([0.7, -1.1, 0.4])
    turned = kind(Spheres.of(centers @ rotation.T + shift, radii), config).query(points @ rotation.T + shift)[0]
    np.testing.assert_allclose(turned, distance, atol=1e-3)  # a grid has axes

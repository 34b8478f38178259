"""How far the fields are from exact surfaces: the benchmark's own rows, on the solids made in code."""

import numpy as np
import pytest

from benchmarks.field_accuracy import BAND, Row, planar_bias, shape_rows
from benchmarks.surfaces import Shape, points_around, shapes, splats_on
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.distance import SeField, SphereField

NUM = 1500


@pytest.fixture(scope="module", params=shapes(with_meshes=False), ids=lambda shape: shape.name)
def rows(request: pytest.FixtureRequest) -> list[Row]:
    return shape_rows(request.param, NUM, [FieldConfig.weights])


def test_safe_is_within_a_millimetre_and_a_third_of_the_spacing(rows: list[Row]) -> None:
    judged = [row for row in rows if row.field == "safe" and row.weights == FieldConfig.weights]
    assert len(judged) == 4
    for row in judged:
        assert row.whole.count == NUM
        assert row.is_kept, (row.shape, row.spacing, row.is_inset, row.whole.rmse)


def test_no_over_estimate_of_safe_exceeds_the_spacing(rows: list[Row]) -> None:
    for row in rows:
        if row.field == "safe":
            assert row.whole.over_max is not None
            assert row.whole.over_max < row.spacing


def test_the_kernel_of_the_paper_under_estimates_far_away(rows: list[Row]) -> None:
    paper = [row for row in rows if row.field == "gpdf"]
    for row in paper:
        far = row.bands[-1]
        assert far.mean is not None
        assert far.mean < -0.01


@pytest.mark.parametrize("shape", shapes(with_meshes=False), ids=lambda shape: shape.name)
def test_balls_inside_a_solid_read_no_less_than_the_distance_to_it(shape: Shape) -> None:
    points, truth = points_around(shape, NUM, *BAND, seed=3)
    np.testing.assert_allclose(shape.signed(points), truth, atol=0)
    assert truth.min() >= BAND[0]
    assert truth.max() < BAND[1]
    hard = SphereField(*splats_on(shape, 0.02, is_inset=True, seed=0)).query(points)[0]
    assert (hard - truth).min() > -2.1e-4  # the tolerance of inscribed balls
    assert (hard - truth).max() < 0.02


@pytest.mark.parametrize("length", [0.01, 0.02, 0.04])
def test_over_a_plane_the_kernel_of_the_paper_reads_the_closed_form(length: float) -> None:
    bias = planar_bias(length)
    assert bias.largest_difference < 1e-4
    assert bias.at_10_cm == pytest.approx(0.10 - length * np.log1p(0.10 / length), abs=1e-4)


def test_over_a_plane_the_gaussian_kernel_has_no_bias() -> None:
    axis = np.arange(-0.45, 0.45, 0.01)
    x, y = np.meshgrid(axis, axis)
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.01, 0.01, (NUM, 2)), rng.uniform(0.01, 0.2, NUM)])
    for radius in (0.0, 0.005):
        distance = SeField(centers, np.full(len(centers), radius)).query(points)[0]
        np.testing.assert_allclose(distance, points[:, 2] - radius, atol=5e-5 + 1e-6)  # the truncation, and float32

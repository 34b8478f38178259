import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import (
    CalibratedProbability,
    PaperProbability,
    field_over,
    probability_of_occupancy,
)
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import Box
from tests.field.scenes import cloud, plane, queries, splat_set
from tests.reference import field as reference
from tests.refused import expect_refusal

LENGTH, NOISE = FieldConfig.length_scale, FieldConfig.noise
BOX = Box(lower=np.array([-0.41, -0.37, -0.2]), upper=np.array([0.35, 0.4, 0.33]))


def test_the_papers_probability_is_that_of_its_equations() -> None:
    centers, radii = cloud()
    points = np.concatenate([queries(), centers[:50] + 0.004])
    probability = PaperProbability(Spheres.of(centers, radii), FieldConfig(truncation=1e-7)).at(points, np.zeros(0))
    occupancy = np.exp(-reference.gpdf(points, centers, radii, LENGTH, NOISE) / LENGTH)
    variance = 1 - reference.explained(points, centers, LENGTH, NOISE)
    np.testing.assert_allclose(probability, reference.collision_probability(occupancy, variance), atol=2e-4)


def test_variance_falls_to_three_quarters_on_a_dense_plane_and_far_away_a_score_is_left() -> None:
    centers, radii = plane(half=0.12)
    on_plane = np.array([[0.001, 0.002, 0.0]])
    assert 1 - reference.explained(on_plane, centers, LENGTH, NOISE)[0] == pytest.approx(0.75, abs=0.01)
    found = PaperProbability(Spheres.of(centers, radii), FieldConfig()).at(
        np.array([[0.0, 0.0, 5.0], *on_plane]), np.zeros(0)
    )
    assert found[0] == pytest.approx(0.0027, abs=1e-4)  # Phi(-3) / Phi(0): dividing by 9 leaves a floor
    assert found[1] == pytest.approx(0.5, abs=0.06)  # on the surface, where it should say so and the mean is right


def test_probability_grows_towards_the_splats_and_never_leaves_its_range() -> None:
    centers, radii = cloud(200)
    radii[:] = 0.01
    for length in (1e-10, 1e-6, 1e-3, 0.02, 1.0, 100.0):
        config = FieldConfig(length_scale=length)
        found = PaperProbability(Spheres.of(centers, radii), config).at(
            np.concatenate([centers[:20], queries(100), 40.0 + queries(5)]), np.zeros(0)
        )
        assert np.isfinite(found).all() and ((found >= 0) & (found <= 1)).all()
        if length < 0.1:
            assert found[:20].min() > 0.98 * found.max()
            np.testing.assert_allclose(found[-5:], 0.0027, atol=1e-4)


def test_an_occupancy_beyond_float64_is_certain() -> None:
    assert probability_of_occupancy(np.array([1e21]), np.array([0.0]))[0] == 1.0
    assert probability_of_occupancy(np.array([0.0]), np.array([1.0]))[0] == pytest.approx(0.0, abs=1e-12)


def test_calibrated_probability_is_a_half_on_the_surface_and_sixteen_percent_one_sigma_away() -> None:
    found = CalibratedProbability(sigma=0.003).of(np.array([-0.003, 0.0, 0.003, 0.1]))
    np.testing.assert_allclose(found, [0.8413447, 0.5, 0.1586553, 0.0], atol=1e-7)
    shifted = CalibratedProbability(sigma=0.003, mean=0.001).of(np.array([0.001, 0.004]))  # reads 1 mm too much
    np.testing.assert_allclose(shifted, [0.5, 0.1586553], atol=1e-7)


@pytest.mark.parametrize("form", ["calibrated", "paper"])
def test_the_baked_channel_is_the_probability_at_the_cell_centres(form: str) -> None:
    centers, radii = cloud()
    config = FieldConfig(voxel=0.03, probability=form)
    grid = bake(splat_set(centers, radii), BOX, config, channels=("sdf", "probability"))
    values = grid.channels["probability"]
    points = grid.origin + grid.voxel * np.argwhere(np.ones(values.shape, bool))
    if form == "paper":
        expected = PaperProbability(Spheres.of(centers, radii), config).at(points, np.zeros(0))
    else:
        found = field_over(Spheres.of(centers, radii), config).query(points)[0]
        expected = CalibratedProbability(sigma=config.error, mean=config.error_mean).of(found)
    np.testing.assert_allclose(values.ravel(), expected, atol=5e-3)  # 2e-5 m of truncation over 2 mm
    assert values.max() > 0.3
    assert grid.header["probability"] == form
    name, value = {"calibrated": ("sigma", 0.002), "paper": ("variance_divisor", 9)}[form]
    assert grid.header["probability_numbers"][name] == value  # type: ignore[call-overload, index]


def test_a_header_names_no_probability_without_the_channel_and_how_a_full_process_was_solved() -> None:
    header = bake(splat_set(*cloud()), BOX, FieldConfig(voxel=0.05)).header
    assert "probability" not in header and "weights_solved" not in header
    solved = bake(splat_set(*cloud(200)), BOX, FieldConfig(voxel=0.05, weights="cg", distance="gpdf")).header
    assert solved["weights_solved"]["gpdf"]["residual"] < 1e-6  # type: ignore[call-overload, index]


def test_the_probability_of_the_paper_has_no_full_process() -> None:
    expect_refusal(
        r"expected field.weights = rowsum or voxel, got cg",
        PaperProbability,
        Spheres.of(*cloud(10)),
        FieldConfig(weights="cg"),
        error=UsageError,
    )

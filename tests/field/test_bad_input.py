"""Splats and length scales at the edge of what can be: every field is finite and right, or refused in words."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.field import weights as weights_module
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import KERNEL_OF, field_over
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.field.weights import METHODS
from splatctrl_cli.records import Box
from tests.field.scenes import cloud, queries, splat_set
from tests.reference import field as reference
from tests.reference.unknown import apply_unknown
from tests.refused import expect_refusal

LENGTHS = [10.0**exponent for exponent in range(-10, 3)]
CENTERS, RADII = cloud(80)
SCENES = {
    "one": (CENTERS[:1], np.array([0.01])),
    "duplicates": (np.concatenate([CENTERS[:30]] * 3), np.concatenate([RADII[:30]] * 3)),
    "zero radii": (CENTERS, np.zeros(80)),
    "mixed radii": (CENTERS, np.geomspace(0.001, 0.3, 80).astype(np.float32).astype(np.float64)),
    "one place": (np.zeros((4, 3)), np.full(4, 0.02)),
}
KERNELS = [name for name in KERNEL_OF if name != "hard"]


@pytest.mark.parametrize("weights", METHODS)
@pytest.mark.parametrize("distance", KERNELS)
@pytest.mark.parametrize("name", SCENES)
def test_every_length_scale_gives_finite_distances_or_is_refused_in_words(
    name: str, distance: str, weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights_module, "NODES", 40)  # smaller blocks, for speed
    centers, radii = SCENES[name]
    points = np.concatenate([queries(40), centers[:10], centers[:10] + 1e-4, 30.0 + queries(3)])
    hard = reference.hard(points, centers, radii)
    between = reference.distances(points, centers)
    nearest = between.argmin(axis=1)  # the Gaussian kernel's limit has the radius of the nearest centre
    limit = between.min(axis=1) - radii[nearest] if distance == "se" else hard
    num_refused = 0
    for length in LENGTHS:
        config = FieldConfig(distance=distance, weights=weights, length_scale=length, noise=1e-3)
        try:
            found, gradient = field_over(Spheres.of(centers, radii), config).query(points)
        except (UsageError, NotEvaluableError) as error:
            assert weights == "cg", (length, error)  # what is lumped can always be made
            assert "field.weights" in str(error) and error.remedy
            num_refused += 1
            continue
        assert np.isfinite(found).all(), length
        assert np.isfinite(gradient).all(), length
        if distance.startswith("safe"):
            assert (found <= hard + 1e-5).all(), length
        if length <= 1e-5:
            np.testing.assert_allclose(found, limit, atol=20 * length + 1e-5)
    assert num_refused < len(LENGTHS) - 6


@pytest.mark.parametrize("distance", KERNEL_OF)
def test_bad_splats_are_refused_by_every_field(distance: str) -> None:
    centers, radii = cloud(10)
    odd_center, odd_radius = centers.copy(), radii.copy()
    odd_center[4, 2], odd_radius[2] = np.nan, np.inf
    for place, size, words in (
        (odd_center, radii, r"splat 4: expected a finite centre, got \[.*nan.*1 such"),
        (centers, odd_radius, "splat 2: expected a finite radius of 0 m or more"),
        (centers, radii - 1.0, "splat 0: expected a finite radius of 0 m or more"),
        (centers[:, :2], radii, r"expected centres \(N, 3\)"),
        (centers[:0], radii[:0], "got none"),
    ):
        with pytest.raises((InputError, NotEvaluableError), match=words):
            field_over(Spheres.of(place, size), FieldConfig(distance=distance))


@pytest.mark.parametrize(
    ("distance", "points", "words"),
    [
        ("hard", [[0.0, 0, 0], [0, np.inf, 0]], "query point 1: expected finite coordinates"),
        ("safe", [[0.0, 0, 0], [0, 0, np.nan]], "query point 1: expected finite coordinates"),
        ("gpdf", [0.0, 0, 0], r"expected shape \(Q, 3\)"),
    ],
)
def test_bad_queries_are_named(distance: str, points: ArrayLike, words: str) -> None:
    expect_refusal(words, field_over(Spheres.of(*cloud(10)), FieldConfig(distance=distance)).query, np.array(points))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"weights": "mass"}, "weights: expected rowsum, voxel or cg, got 'mass'"),
        ({"truncation": 0.0}, "truncation"),
        *[({"length_scale": value}, "length_scale: expected 1e-10 to 1000 m") for value in (0.0, 1e-13, 1e7, np.nan)],
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], words: str) -> None:
    expect_refusal(words, FieldConfig, error=UsageError, **settings)


@pytest.mark.parametrize("weights", METHODS)
def test_a_box_that_holds_no_splat_has_the_distances_to_those_beyond(weights: str) -> None:
    centers, radii = cloud(200)
    box = Box(lower=np.array([5.0, 5.0, 5.0]), upper=np.array([5.3, 5.3, 5.3]))
    channels = ("sdf", "gradient", "bound", "hard", "gpdf", "se", "label", "probability")
    grid = bake(
        splat_set(centers, radii), box, FieldConfig(voxel=0.1, weights=weights, noise=1e-2), channels=channels
    )
    points = grid.origin + grid.voxel * np.argwhere(np.ones(grid.channels["sdf"].shape, bool))
    hard = reference.hard(points, centers, radii)
    np.testing.assert_allclose(grid.channels["hard"].ravel(), hard, atol=2e-6)
    assert (grid.channels["sdf"].ravel() <= hard + 2e-6).all() and (grid.channels["bound"].ravel() <= hard).all()
    assert (grid.channels["probability"] == 0).all()
    for values in grid.channels.values():
        assert np.isfinite(values).all()
    expect_refusal(
        "expected a cell that some camera saw",
        apply_unknown,
        bake(splat_set(centers, radii), box, FieldConfig(voxel=0.1)),
        "obstacle",
        error=NotEvaluableError,
    )

"""The rules by which Gaussians are added and removed, one by one."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.densify import (
    GaussianSettings,
    densify,
    fresh,
    prune_reasons,
    reset_opacity,
    rotations,
    split_parts,
)
from experiments.gaussian_step import CENTER, LOG_SCALE, LOGIT, QUAT, GaussianArrays
from splatctrl_cli.records import Float32

SETTINGS = GaussianSettings()
EXTENT = 1.0  # [m]: up to 1 cm is cloned
QUIET, LOUD = 0.5 * SETTINGS.densify_gradient, 2.0 * SETTINGS.densify_gradient


def arrays(sigmas: list[float], gradients: list[float], num_views: int = 4) -> GaussianArrays:
    """Opaque Gaussians in a row, of these largest sigmas, flat and turned, with moments that are not zero."""
    parameters = np.zeros((len(sigmas), 59), np.float32)
    parameters[:, 0] = np.arange(len(sigmas))
    parameters[:, LOG_SCALE] = np.log(np.outer(sigmas, [0.2, 1.0, 0.5]))
    parameters[:, QUAT] = [0.9, 0.1, -0.3, 0.2]
    parameters[:, LOGIT] = 1.0
    out = fresh(parameters)
    out.first[:], out.second[:], out.num_steps[:] = 0.3, 0.2, 7
    out.growth[:, 0], out.growth[:, 1] = np.multiply(gradients, num_views), num_views
    return out


def grown(before: GaussianArrays, settings: GaussianSettings = SETTINGS, **flags: bool) -> GaussianArrays:
    return densify(before, settings, EXTENT, np.random.default_rng(0), prunes_large=flags.get("prunes_large", False))[
        0
    ]


def test_what_the_images_pull_at_little_stays_as_it_is() -> None:
    before = arrays([0.005, 0.05], [QUIET, QUIET])
    after = grown(before)
    assert np.array_equal(after.parameters, before.parameters) and (after.first == np.float32(0.3)).all()
    assert after.num_steps.tolist() == [7, 7]


def test_a_small_gaussian_is_cloned_where_it_is_and_the_clone_has_no_moments() -> None:
    after = grown(arrays([0.005, 0.005], [LOUD, QUIET]))
    assert len(after) == 3 and np.array_equal(after.parameters[2], after.parameters[0])
    assert not after.first[2].any() and not after.second[2].any() and after.num_steps.tolist() == [7, 7, 0]


def test_a_large_gaussian_becomes_two_smaller_ones() -> None:
    before = arrays([0.05, 0.05], [QUIET, LOUD])
    after = grown(before)
    assert after.num_steps.tolist() == [7, 0, 0] and np.array_equal(after.parameters[0], before.parameters[0])
    for part in after.parameters[1:]:
        assert np.exp(part[LOG_SCALE]) == pytest.approx(np.exp(before.parameters[1, LOG_SCALE]) / 1.6, rel=1e-5)
        assert np.array_equal(part[6:], before.parameters[1, 6:])
        assert 0 < np.linalg.norm(part[CENTER] - before.parameters[1, CENTER]) < 4 * 0.05


def test_the_mean_gradient_decides_and_not_the_sum() -> None:
    assert len(grown(arrays([0.005], [QUIET], num_views=50))) == 1
    assert len(grown(arrays([0.005], [LOUD], num_views=1))) == 2


def test_parts_of_a_split_are_drawn_from_the_gaussian() -> None:
    parent = arrays([0.05], [LOUD]).parameters
    parts = split_parts(np.repeat(parent, 20_000, axis=0), 1.6, np.random.default_rng(1))
    offsets = (parts[:, CENTER] - parent[0, CENTER]).astype(np.float64)
    axes = rotations(parent[:, QUAT])[0] * np.exp(parent[0, LOG_SCALE])
    assert np.cov(offsets.T) == pytest.approx(axes @ axes.T, abs=5 * 0.05**2 / np.sqrt(40_000))
    assert np.abs(offsets.mean(axis=0)).max() < 5 * 0.05 / np.sqrt(40_000)


def test_rotations_turn_axes_as_quaternions_do_whatever_their_length() -> None:
    quarter_about_z = np.float32([[2.0, 0.0, 0.0, 2.0]])
    expected = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert rotations(quarter_about_z)[0] == pytest.approx(expected, abs=1e-7)


def test_what_is_faint_or_not_finite_is_removed() -> None:
    before = arrays([0.005] * 3, [QUIET] * 3)
    before.parameters[0, LOGIT] = np.log(0.004 / 0.996)
    before.parameters[1, 20] = np.nan
    reasons = prune_reasons(before, SETTINGS, EXTENT, prunes_large=False)
    assert {name: mask.tolist() for name, mask in reasons.items()} == {
        "broken": [False, True, False],
        "opacity": [True, False, False],
        "screen": [False] * 3,
        "size": [False] * 3,
    }


def test_what_is_large_is_removed_once_opacities_were_reset() -> None:
    before = arrays([0.005, 0.005, 0.2], [QUIET] * 3)
    before.growth[1, 2] = 21.0
    assert len(grown(before)) == 3
    after = grown(before, prunes_large=True)
    assert after.parameters[:, 0].tolist() == [0.0]


def test_growth_starts_again_after_each_round() -> None:
    assert not grown(arrays([0.005, 0.05], [LOUD, QUIET])).growth.any()


def test_where_room_is_short_the_largest_gradients_have_it() -> None:
    before = arrays([0.005] * 4, [LOUD, 3 * LOUD, QUIET, 2 * LOUD])
    settings = replace(SETTINGS, max_gaussians=6)
    after, done = densify(before, settings, EXTENT, np.random.default_rng(0), prunes_large=False)
    assert sorted(after.parameters[:, 0].tolist()) == [0, 1, 1, 2, 3, 3]
    assert (done.cloned, done.split, done.unmet) == (2, 0, 1)


def test_a_reset_lowers_opacities_and_forgets_their_moments_alone() -> None:
    before = arrays([0.005, 0.005], [QUIET] * 2)
    before.parameters[1, LOGIT] = -6.0
    reset_opacity(before, 0.01)
    opacity: Float32 = 1 / (1 + np.exp(-before.parameters[:, LOGIT]))
    assert opacity == pytest.approx([0.01, 1 / (1 + np.exp(6.0))], rel=1e-5)
    assert not before.first[:, LOGIT].any() and not before.second[:, LOGIT].any()
    assert np.count_nonzero(before.first) == 2 * 58

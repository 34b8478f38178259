"""Depth cameras: each statistic that a model states, measured on planes and on a box before a wall."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from splatctrl_cli.records import Float32, Float64
from splatctrl_cli.simulate.render import BASELINE, FOCAL, STEPS, DepthNoise, StereoDepth

QUIET = StereoDepth(spread=0.0, dropout=0.0)


@pytest.mark.parametrize("depth", [1.0, 2.0])
def test_noise_has_the_stated_spread_and_grows_with_depth_squared(depth: float) -> None:
    noise = DepthNoise(step=1e-5, dropout=0.0)
    noisy = noise.applied(np.full((240, 320), depth, np.float32), np.random.default_rng(0))
    assert np.std(noisy - depth) == pytest.approx(noise.spread * depth**2, rel=0.1)


def test_noise_loses_edges_dropouts_and_what_is_too_far() -> None:
    exact_depth = np.full((60, 80), 1.0, np.float32)
    exact_depth[:, 40:] = 1.1
    exact_depth[:20, 60:] = 3.5
    noisy = DepthNoise(dropout=0.0).applied(exact_depth, np.random.default_rng(0))
    assert not noisy[30:, 39:41].any() and not noisy[:20, 60:].any() and (noisy[30:, 42:] > 0).all()
    share = (DepthNoise(dropout=0.02).applied(np.ones((240, 320), np.float32), np.random.default_rng(0)) == 0).mean()
    assert share == pytest.approx(0.02, abs=0.002)


def test_noise_comes_in_steps_of_disparity() -> None:
    noisy = DepthNoise().applied(np.full((60, 80), 1.0, np.float32), np.random.default_rng(0))
    steps = 1 / (noisy[noisy > 0].astype(np.float64) * DepthNoise().step)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


def test_what_the_second_imager_does_not_see_has_no_depth() -> None:
    """A plate at 1 m before a wall at 2 m hides as much of it, left of itself, as their disparities differ by."""
    exact = np.full((20, 200), 2.0, np.float32)
    exact[:, 100:140] = 1.0
    plain = DepthNoise(dropout=0.0, edge=10.0, spread=0.0)
    shadowed = replace(plain, baseline=0.05).applied(exact, np.random.default_rng(0), focal=300.0)
    assert (plain.applied(exact, np.random.default_rng(0)) > 0).all()
    hidden = np.flatnonzero(shadowed[10] == 0)
    width = 300.0 * 0.05 * (1 / 1.0 - 1 / 2.0)
    assert hidden.max() == 99 and abs(len(hidden) - width) <= 1.5


# --- two imagers ---


def plane(depth: float, shape: tuple[int, int] = (480, 640)) -> Float32:
    return np.full(shape, depth, np.float32)


def before_a_wall() -> Float32:
    """A box at 1 m, 160 pixels wide and 140 high, before a wall at 2 m."""
    exact = plane(2.0)
    exact[170:310, 240:400] = 1.0
    return exact


def measured(noise: StereoDepth, exact: Float32, seed: int = 0, focal: float = FOCAL) -> Float64:
    return noise.applied(exact, np.random.default_rng(seed), focal=focal).astype(np.float64)


@pytest.mark.parametrize(("depth", "spread"), [(0.5, 0.03), (1.3, StereoDepth().spread), (2.0, 0.08)])
def test_depth_errs_by_the_square_of_depth_times_the_spread_of_disparity(depth: float, spread: float) -> None:
    found = measured(StereoDepth(spread=spread), plane(depth))
    assert np.std(found[found > 0]) == pytest.approx(depth**2 * spread / (FOCAL * BASELINE), rel=0.1)
    assert np.mean(found[found > 0]) == pytest.approx(depth, rel=2e-3)
    steps = STEPS * FOCAL * BASELINE / found[found > 0]
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


@pytest.mark.parametrize("focal", [FOCAL, 2 * FOCAL])
def test_errors_agree_over_the_window_in_depth_pixels(focal: float) -> None:
    error = measured(StereoDepth(dropout=0.0), plane(1.0), focal=focal) - 1.0
    error -= error.mean()
    for lag in (1, 2, 4, 8):
        expected = np.exp(-((lag * FOCAL / focal / StereoDepth().window) ** 2))
        for a, b in ((error[:, :-lag], error[:, lag:]), (error[:-lag], error[lag:])):
            assert np.mean(a * b) / np.var(error) == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("focal", [FOCAL, 2 * FOCAL])
def test_the_wall_takes_the_depth_of_the_box_for_one_to_three_depth_pixels(focal: float) -> None:
    exact, scale = before_a_wall(), focal / FOCAL
    found = measured(QUIET, exact, focal=focal)
    is_fat = (exact == 2.0) & (np.abs(found - 1.0) < 0.01)
    assert distance_transform_edt(exact == 2.0)[is_fat].max() < 3 * scale + 1.5
    assert (np.abs(found - 1.0) < 0.01)[exact == 1.0].all()
    rows, columns = slice(175, 305), slice(245, 395)
    widths = [is_fat[rows, :240].sum(1), is_fat[rows, 400:].sum(1), is_fat[:170, columns].sum(0)]
    assert np.concatenate(widths).min() >= scale - 1
    assert np.mean(np.concatenate(widths)) == pytest.approx(2 * scale, abs=0.3 * scale)


@pytest.mark.parametrize("width", [0.0, 1.0, 3.0])
def test_fattening_and_its_absence_are_as_wide_as_asked_for(width: float) -> None:
    found = measured(replace(QUIET, fattening=(width, width)), before_a_wall())
    assert (np.abs(found - 1.0) < 0.01)[240, 400:].sum() == width


def test_a_plane_that_tilts_is_not_fattened() -> None:
    row = 1 / np.linspace(1 / 0.6, 1 / 3.0, 480)
    exact = np.repeat(row[:, None], 640, axis=1).astype(np.float32)
    found = measured(QUIET, exact)
    step = found**2 / (FOCAL * BASELINE * STEPS)
    assert (np.abs(found - exact) <= 0.51 * step).all()


def test_the_wall_left_of_the_box_is_lost_for_the_difference_of_disparities() -> None:
    exact, thin = before_a_wall(), replace(QUIET, fattening=(0.0, 0.0))
    for focal in (FOCAL, 2 * FOCAL):
        lost = np.flatnonzero(measured(thin, exact, focal=focal)[240] == 0)
        assert lost.max() == 239 and abs(len(lost) - focal * BASELINE * (1 / 1.0 - 1 / 2.0)) <= 1.5
    fat = measured(QUIET, exact)
    beside = (fat[240] == 0).sum() + (np.abs(fat[240, :240] - 1.0) < 0.01).sum()
    assert beside == (measured(thin, exact)[240] == 0).sum()


def test_what_is_nearer_than_28_cm_or_too_far_is_lost_and_dropouts_are_blobs() -> None:
    assert not any(measured(QUIET, plane(depth)).any() for depth in (0.27, 6.2, 0.0))
    is_lost = measured(StereoDepth(dropout=0.02), plane(1.0)) == 0
    assert is_lost.mean() == pytest.approx(0.02, abs=1e-3)
    assert (is_lost[:, 1:] & is_lost[:, :-1]).mean() > 0.6 * is_lost.mean()


def test_imagers_of_their_own_width_err_alike_at_any_width_of_the_image() -> None:
    found = measured(replace(StereoDepth(), width=640), plane(1.0, (96, 128)), focal=128.0)
    assert np.std(found[found > 0]) == pytest.approx(0.0036, rel=0.1)
    exact = plane(2.0, (96, 128))
    exact[30:70, 40:90] = 1.0
    widths = [
        (np.abs(measured(replace(QUIET, width=640), exact, seed, 128.0) - 1.0) < 0.01)[32:68, 90:].sum(1)
        for seed in range(20)
    ]
    assert np.mean(widths) == pytest.approx(2 * 128 / FOCAL, rel=0.15)  # two depth pixels: 5 mm at a metre


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    exact = before_a_wall()
    first, again, other = (measured(StereoDepth(), exact, seed).tobytes() for seed in (1, 1, 2))
    assert first == again != other

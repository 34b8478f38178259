"""What becomes of slots that nothing asks for."""

import numpy as np
import pytest

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.records import Float64, Label
from splatctrl_cli.scene.buffer import SplatBuffer
from splatctrl_cli.scene.removal import clone_shape, clone_sources, detail_seeds, draw_indices
from tests.scene.wall import HEIGHT, INTRINSICS, frame, plain_seeds

CONFIG = SceneConfig()


SCREEN = np.hypot(*np.mgrid[-0.12:0.12:0.0002, -0.12:0.12:0.0002])


def blended(opacity: float, radius: float, count: int) -> Float64:
    """Opacity over the screen of `count` coinciding splats in its middle, without dilation or cut-offs."""
    return 1.0 - (1.0 - opacity * np.exp(-0.5 * np.square(SCREEN / radius))) ** count


@pytest.mark.parametrize("count", [1, 2, 3, 20])
@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.99])
def test_clones_keep_the_peak_and_the_opacity_summed_over_the_screen(opacity: float, count: int) -> None:
    """The copies' sum is no Gaussian."""
    a, r = (float(value[0]) for value in clone_shape(np.array([opacity]), np.array([0.01]), np.array([count])))
    before, after = blended(opacity, 0.01, 1), blended(a, r, count)
    assert after.max() == pytest.approx(before.max(), abs=1e-6)
    assert after.sum() == pytest.approx(before.sum(), rel=0.005)
    assert 0.01 * opacity * (count > 1 and opacity > 0.5) <= np.abs(after - before).max() < 0.2 * opacity


def test_the_one_dimensional_rule_would_lose_opacity() -> None:
    a = 1.0 - (1.0 - 0.9) ** (1.0 / 3.0)
    factor = 0.9 / sum((-1) ** k * n * a ** (k + 1) / np.sqrt(k + 1) for k, n in enumerate((3, 3, 1)))
    assert abs(1.0 - blended(a, 0.01 * factor, 3).sum() / blended(0.9, 0.01, 1).sum()) > 0.02


def test_sources_of_clones_are_drawn_in_proportion_to_opacity() -> None:
    counts = np.bincount(clone_sources(np.array([0.0, 0.1, 0.3]), 4000, np.random.default_rng(0)), minlength=3)
    assert (counts[0], counts[2] / counts[1]) == (0, pytest.approx(3.0, rel=0.15))
    assert len(clone_sources(np.zeros(3), 10, np.random.default_rng(0))) == 0


def test_copies_take_dead_slots_and_start_without_moments() -> None:
    buffer, copies = SplatBuffer(5), [1, 3, 4]  # 0 and 2 are not copied
    buffer.fill(plain_seeds(np.eye(3), 0.01), 0.5)
    buffer.labels[1] = Label.HUMAN
    for array in (buffer.moments.first, buffer.moments.second, buffer.moments.num_steps):
        array[...] = 7
    assert buffer.copy(np.array([1, 1, 1, 0]), np.full(5, 0.25), np.full(5, 0.02)) == 2 and buffer.is_alive.all()
    assert np.array_equal(buffer.centers[copies], np.tile([0, 1, 0], (3, 1)))
    assert buffer.opacities == pytest.approx(np.array([0.5, 0.25, 0.5, 0.25, 0.25]))
    assert buffer.radii[copies] == pytest.approx(0.02) and (buffer.labels[copies] == Label.HUMAN).all()
    assert not buffer.moments.first[copies].any() and not buffer.moments.num_steps[copies].any()
    assert (buffer.moments.first[[0, 2]] == 7).all()


def test_detail_is_seeded_where_the_colours_are_wrong_and_nowhere_else() -> None:
    error, pixel = np.zeros((60, 80), np.float32), HEIGHT / INTRINSICS.fx
    assert len(detail_seeds([(frame(), error)], 30, CONFIG, np.random.default_rng(0))) == 0
    error[20:30, 40:60] = 0.3
    seeds = detail_seeds([(frame(), error)], 30, CONFIG, np.random.default_rng(0))
    assert 10 <= len(seeds) <= 30 and seeds.radii == pytest.approx(pixel)
    u, v = seeds.centers[:, 0] / pixel + INTRINSICS.cx, -seeds.centers[:, 1] / pixel + INTRINSICS.cy
    assert ((u > 39.5) & (u < 59.5) & (v > 19.5) & (v < 29.5)).all()
    assert (
        np.linalg.norm(seeds.centers[:, None] - seeds.centers[None], axis=2) + np.eye(len(seeds))
    ).min() >= 2 * pixel - 1e-6


def test_pixels_are_drawn_as_numpy_draws_them() -> None:
    """Heavy ones are drawn again and again, which takes several rounds."""
    weight = np.random.default_rng(1).random(500) ** 8
    weight[::7] = 0.0
    for count in (1, 30, int(np.count_nonzero(weight))):
        wanted = np.random.default_rng(2).choice(500, count, replace=False, p=weight / weight.sum())
        np.testing.assert_array_equal(draw_indices(weight, count, np.random.default_rng(2)), wanted)

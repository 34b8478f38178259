"""What becomes of slots that nothing asks for."""

import numpy as np
import pytest

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.records import Float64, Label
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.relocation import Misfit, clone_shape, clone_sources, detail_seeds, drawn
from tests.scene.wall import HEIGHT, INTRINSICS, frame

CONFIG = SceneConfig()


def blended(opacity: float, radius: float, count: int, distance: Float64) -> Float64:
    """Opacity at a distance from the centre of `count` coinciding splats, without dilation or cut-offs."""
    return 1.0 - (1.0 - opacity * np.exp(-0.5 * np.square(distance / radius))) ** count


@pytest.mark.parametrize("count", [1, 2, 3, 5, 20])
@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.9, 0.99])
def test_clones_keep_the_peak_and_the_opacity_summed_over_the_screen(opacity: float, count: int) -> None:
    radius, step = 0.01, 0.0001
    a, r = (float(value[0]) for value in clone_shape(np.array([opacity]), np.array([radius]), np.array([count])))
    x = np.arange(-0.12, 0.12, step)
    distance = np.hypot(x[:, None], x[None, :])
    before, after = blended(opacity, radius, 1, distance), blended(a, r, count, distance)
    assert after.max() == pytest.approx(before.max(), abs=1e-6)
    assert after.sum() == pytest.approx(before.sum(), rel=0.005)
    largest_change = np.abs(after - before).max()  # not zero: the copies' sum is no Gaussian
    assert largest_change < 0.2 * opacity
    if count > 1 and opacity > 0.5:
        assert largest_change > 0.01 * opacity


def test_the_one_dimensional_rule_would_lose_opacity() -> None:
    a = 1.0 - (1.0 - 0.9) ** (1.0 / 3.0)
    x = np.arange(-0.12, 0.12, 0.0002)
    factor = 0.9 / sum((-1) ** k * n * a ** (k + 1) / np.sqrt(k + 1) for k, n in enumerate((3, 3, 1)))
    distance = np.hypot(x[:, None], x[None, :])
    loss = 1.0 - blended(a, 0.01 * factor, 3, distance).sum() / blended(0.9, 0.01, 1, distance).sum()
    assert abs(loss) > 0.02


def test_sources_of_clones_are_drawn_in_proportion_to_opacity() -> None:
    drawn = clone_sources(np.array([0.0, 0.1, 0.3]), 4000, np.random.default_rng(0))
    counts = np.bincount(drawn, minlength=3)
    assert counts[0] == 0
    assert counts[2] / counts[1] == pytest.approx(3.0, rel=0.15)
    assert len(clone_sources(np.zeros(3), 10, np.random.default_rng(0))) == 0


def test_copies_take_dead_slots_and_start_without_moments() -> None:
    buffer = SplatBuffer(5)
    seeds = Seeds(
        centers=np.eye(3, dtype=np.float32), radii=np.full(3, 0.01, np.float32), colors=np.ones((3, 3), np.float32)
    )
    buffer.fill(seeds, 0.5)
    buffer.labels[1] = Label.HUMAN
    for array in (buffer.moments.first, buffer.moments.second, buffer.moments.num_steps):
        array[...] = 7
    sources = np.array([1, 1, 1, 0])
    opacities, radii = np.full(5, 0.25), np.full(5, 0.02)
    assert buffer.copy(sources, opacities, radii) == 2
    assert buffer.is_alive.all()
    assert np.array_equal(buffer.centers[[1, 3, 4]], np.tile(seeds.centers[1], (3, 1)))
    assert buffer.opacities[[1, 3, 4]] == pytest.approx(0.25)
    assert buffer.radii[[1, 3, 4]] == pytest.approx(0.02)
    assert buffer.opacities[[0, 2]] == pytest.approx(0.5)  # neither was copied
    assert (buffer.labels[[1, 3, 4]] == Label.HUMAN).all()
    assert (buffer.moments.first[[1, 3, 4]] == 0).all()
    assert (buffer.moments.num_steps[[1, 3, 4]] == 0).all()
    assert (buffer.moments.first[[0, 2]] == 7).all()


def test_detail_is_seeded_where_the_colours_are_wrong_and_nowhere_else() -> None:
    seen = frame()
    error = np.zeros(seen.depth.shape, np.float32)
    error[20:30, 40:60] = 0.3
    seeds = detail_seeds([Misfit(frame=seen, error=error)], 30, CONFIG, np.random.default_rng(0))
    assert 10 <= len(seeds) <= 30
    u = seeds.centers[:, 0] / HEIGHT * INTRINSICS.fx + INTRINSICS.cx
    v = -seeds.centers[:, 1] / HEIGHT * INTRINSICS.fy + INTRINSICS.cy
    assert ((u > 39.5) & (u < 59.5) & (v > 19.5) & (v < 29.5)).all()
    assert seeds.radii == pytest.approx(HEIGHT / INTRINSICS.fx)
    apart = np.linalg.norm(seeds.centers[:, None] - seeds.centers[None], axis=2) + np.eye(len(seeds))
    assert apart.min() >= 2 * HEIGHT / INTRINSICS.fx - 1e-6


def test_no_detail_is_seeded_where_every_colour_is_right() -> None:
    seen = frame()
    misfits = [Misfit(frame=seen, error=np.zeros(seen.depth.shape, np.float32))]
    assert len(detail_seeds(misfits, 30, CONFIG, np.random.default_rng(0))) == 0


def test_pixels_are_drawn_as_numpy_draws_them() -> None:
    """Heavy ones are drawn again and again, which takes several rounds."""
    weight = np.random.default_rng(1).random(500) ** 8
    weight[::7] = 0.0
    for count in (1, 30, int(np.count_nonzero(weight))):
        wanted = np.random.default_rng(2).choice(500, count, replace=False, p=weight / weight.sum())
        np.testing.assert_array_equal(drawn(weight, count, np.random.default_rng(2)), wanted)

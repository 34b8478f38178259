"""3D Gaussian splatting of a textured floor."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from experiments.densify import GaussianSettings
from experiments.gaussian_fitter import (
    GaussianAuditRow,
    GaussianFitter,
    center_rate,
    first_map,
    gaussians_of,
    scene_extent,
)
from splatctrl_cli.config import Config, SceneConfig
from splatctrl_cli.records import Box, GaussianSet, RgbdFrame
from splatctrl_cli.scene.render import parameters_of, render_gaussians
from tests.refused import expect_refusal
from tests.scene.wall import HEIGHT, INTRINSICS, WORKSPACE, frame, looking_down

FAST = GaussianSettings(iterations=300, densify_from=60, densify_every=30, reset_every=0.2)
CONFIG = Config(scene=SceneConfig(max_splats=200))


def frames() -> list[RgbdFrame]:
    return [frame(x=0.1), frame(x=-0.1), frame(y=0.05)]


def checked() -> list[RgbdFrame]:
    """A pattern finer than the seeds can show."""
    v, u = np.mgrid[: INTRINSICS.height, : INTRINSICS.width]
    squares = ((u // 3 + v // 3) % 2 * 200 + 20).astype(np.uint8)
    return [replace(frame(), color=np.repeat(squares[:, :, None], 3, axis=2))]


def fitted(
    settings: GaussianSettings = FAST, threads: int = 1, seed: int = 0
) -> tuple[GaussianFitter, list[GaussianAuditRow]]:
    rows: list[GaussianAuditRow] = []
    fitter = GaussianFitter(CONFIG, WORKSPACE, frames(), settings=settings, seed=seed, threads=threads)
    fitter.fit(rows.append)
    return fitter, rows


def test_a_floor_is_reconstructed_in_colour_and_depth_from_a_view_not_trained_on() -> None:
    fitter, rows = fitted(replace(FAST, reset_every=0.0))
    view = render_gaussians(fitter.gaussians(), INTRINSICS, looking_down(0.03, -0.02))
    inside = (slice(8, 52), slice(10, 68))
    error = (view.color - frame(x=0.03, y=-0.02).color / 255.0)[inside]
    assert -10 * np.log10(np.mean(error**2)) > 30
    assert np.median(np.abs(view.normalised_depth()[inside] - HEIGHT)) < 0.01 * HEIGHT
    assert rows[-1].psnr > 30


def test_growing_shows_detail_that_the_seeds_cannot() -> None:
    psnr = {}
    for until in (0.0, 1.0):
        rules = replace(FAST, iterations=300, densify_until=until, reset_every=0.0, lr_color=0.05)
        fitter = GaussianFitter(CONFIG, WORKSPACE, checked(), settings=rules, threads=1)
        start, psnr[until] = len(fitter.arrays), fitter.fit().psnr or 0.0
        assert (len(fitter.arrays) > 2 * start) == (until > 0)
    assert psnr[1.0] > psnr[0.0] + 2.0


def test_the_audit_adds_up_and_follows_the_schedule() -> None:
    start = len(GaussianFitter(CONFIG, WORKSPACE, frames(), settings=FAST, threads=1).arrays)
    fitter, rows = fitted()
    assert start <= 200
    count = start
    for row in rows:
        count += row.cloned + row.split - sum(row.pruned.values())
        assert row.gaussians == count and set(asdict(row)["pruned"]) == {"broken", "opacity", "screen", "size"}
    assert count == len(fitter.gaussians())
    assert [row.iteration for row in rows] == [60, 90, 120, 300]
    assert [row.opacity_reset for row in rows] == [True, False, True, False]
    assert [row.degree for row in rows] == [3, 3, 3, 3]


def test_the_degree_rises_with_the_iterations() -> None:
    rules = replace(FAST, iterations=50, degree_every=0.3)
    fitter = GaussianFitter(CONFIG, WORKSPACE, frames(), settings=rules, threads=1)
    fitter.fit()
    assert (fitter.degree, fitter.gaussians().harmonics.shape[1]) == (3, 16)
    assert GaussianFitter(CONFIG, WORKSPACE, frames(), threads=1).gaussians().harmonics.shape[1] == 1


def test_the_number_of_gaussians_never_exceeds_its_limit() -> None:
    rules = replace(FAST, max_gaussians=220, iterations=150, densify_until=1.0)
    fitter = GaussianFitter(CONFIG, WORKSPACE, checked(), settings=rules, threads=1)
    rows: list[GaussianAuditRow] = []
    fitter.fit(rows.append)
    assert all(row.gaussians <= 220 for row in rows) and any(row.unmet for row in rows)


def test_same_seed_gives_the_same_bytes_at_any_thread_count() -> None:
    rules = replace(FAST, iterations=150)
    results = [fitted(rules, threads) for threads in (1, 2, 4)]
    bytes_ = [fitter.arrays.parameters.tobytes() for fitter, _ in results]
    assert bytes_[0] == bytes_[1] == bytes_[2]
    assert results[0][1] == results[1][1] == results[2][1]
    assert fitted(rules, seed=1)[0].arrays.parameters.tobytes() != bytes_[0]


def test_seeds_are_those_that_an_empty_map_asks_for() -> None:
    seeds = first_map(CONFIG, WORKSPACE, frames()).splats()
    assert 50 < len(seeds) <= 200 and np.abs(seeds.centers[:, 2]).max() < 1e-3


def test_the_colour_of_what_has_no_depth_is_the_background() -> None:
    sky = frame()
    sky.color[:, :30], sky.depth[:, :30] = (51, 102, 204), 0.0
    fitter = GaussianFitter(CONFIG, WORKSPACE, [sky], threads=1)
    assert fitter.background == pytest.approx((0.2, 0.4, 0.8))
    black = replace(CONFIG, scene=replace(CONFIG.scene, background="black"))
    assert GaussianFitter(black, WORKSPACE, [sky], threads=1).background == (0.0, 0.0, 0.0)


def test_a_scene_without_depth_is_refused() -> None:
    away = Box(lower=np.array([5.0, 5.0, 5.0]), upper=np.array([6.0, 6.0, 6.0]))
    expect_refusal("no pixel of any view has a depth inside the workspace", GaussianFitter, CONFIG, away, frames())


def test_the_extent_is_that_of_the_cameras_or_of_what_they_see() -> None:
    apart = [frame(x=1.0), frame(x=-1.0)]
    assert scene_extent(apart) == pytest.approx(1.1) and scene_extent([frame()]) == pytest.approx(0.5 * HEIGHT)


def test_the_rate_of_centres_falls_exponentially_to_its_end() -> None:
    rates = [center_rate(FAST, k) for k in (0, 150, 300)]
    assert rates == pytest.approx([1.6e-4, 1.6e-5, 1.6e-6])


def test_parameters_and_sets_say_the_same() -> None:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(9, 4))
    gaussians = GaussianSet(
        centers=rng.normal(size=(9, 3)).astype(np.float32),
        scales=rng.uniform(0.01, 0.1, (9, 3)).astype(np.float32),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacities=np.linspace(0, 1, 9, dtype=np.float32),
        harmonics=rng.normal(size=(9, 4, 3)).astype(np.float32),
        labels=np.zeros(9, np.uint8),
    )
    back = gaussians_of(parameters_of(gaussians), 1)
    assert np.array_equal(back.centers, gaussians.centers)
    assert np.array_equal(back.harmonics, gaussians.harmonics)
    assert back.scales == pytest.approx(gaussians.scales, rel=1e-6)
    assert back.quats_wxyz == pytest.approx(gaussians.quats_wxyz, abs=1e-6)
    assert back.opacities == pytest.approx(gaussians.opacities, abs=2e-7)


@pytest.mark.parametrize(("iterations", "rounds"), [(800, [200, 300]), (2300, [500, 600, 700, 800, 900, 1000, 1100])])
def test_few_iterations_are_densified_in_the_second_quarter(iterations: int, rounds: list[int]) -> None:
    rules = GaussianSettings(iterations=iterations)
    fitter = GaussianFitter(CONFIG, WORKSPACE, frames(), settings=rules, threads=1)
    rng, found = np.random.default_rng(0), []
    for done in range(1, iterations + 1):
        fitter.num_iterations = done
        fitter._terms = [fitter._evaluate(fitter.views[0])] if done % 100 == 0 else []
        if fitter._after_iteration(rng) is not None:
            found.append(done)
    assert found == rounds

"""The map's lengths follow from the recorded depth."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from splatctrl_cli.config import Config, OccupancyConfig, SceneConfig
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.kernels.raster import LossTerms, OptimiserSettings
from splatctrl_cli.records import Box, Float32, Float64, RgbdFrame, SplatSet
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import View
from splatctrl_cli.scene.render import render
from splatctrl_cli.scene.scale import RecordedDepth, depth_noise, describe_scale, fitted_to
from tests.scene.wall import INTRINSICS, WORKSPACE, frame, looking_down

CONFIG = Config(scene=SceneConfig(max_splats=800, first_iterations=10))
ROOM = RecordedDepth(median=2.4, nearest=1.6, farthest=12.0)


def larger(recorded: RgbdFrame, factor: float) -> RgbdFrame:
    """The frame as a scene `factor` times as large would have given it, or this one in another unit."""
    return replace(
        recorded, depth=recorded.depth * np.float32(factor), T_world_camera=grown(recorded.T_world_camera, factor)
    )


def grown(T: Float64, factor: float) -> Float64:
    return pose_at(T[:3, 3] * factor, T[:3, :3])


@cache
def fitted(factor: float, given: Config = CONFIG) -> SplatSet:
    """The map of a block on a floor, `factor` times as large."""
    frames = [larger(frame(0, block=0.2, x=x, camera=f"cam{k}"), factor) for k, x in enumerate((0.1, -0.1))]
    depth = RecordedDepth.of(frames)
    config, box = fitted_to(given, depth), Box(lower=WORKSPACE.lower * factor, upper=WORKSPACE.upper * factor)
    target = SceneFitter(config.scene, config.occupancy, box)
    target.step(frames)
    return target.splats()


def psnr(splats: SplatSet, factor: float) -> float:
    view = render(splats, INTRINSICS, grown(looking_down(), factor))
    error = (view.color - frame(0, block=0.2).color / 255.0)[view.opacity > 0.5]
    return float(-10 * np.log10(np.mean(error**2)))


def test_at_the_depth_of_a_table_the_lengths_are_those_of_the_configuration() -> None:
    """And a scale of one is the paper's; what a camera carries stays too near beside a near scene."""
    made = fitted_to(Config(), RecordedDepth(median=0.8, nearest=0.5, farthest=1.5))
    assert made.occupancy == OccupancyConfig()
    assert made.scene == replace(SceneConfig(), scale=1.0, radius_depth=0.8)
    paper = Config(scene=SceneConfig(scale=1.0))
    assert fitted_to(paper, ROOM) == paper
    near = fitted_to(Config(), RecordedDepth(median=0.5, nearest=0.1, farthest=0.8))
    assert near.occupancy.min_range == OccupancyConfig().min_range


def test_lengths_grow_with_the_depth_and_what_is_set_stays() -> None:
    """The robot has one size: so has its contact."""
    made, plain = fitted_to(Config(occupancy=OccupancyConfig(voxel=0.05)), ROOM), SceneConfig()
    lengths = made.scene.scale, made.scene.max_radius, made.scene.max_gap, made.scene.lambda_depth
    assert lengths == pytest.approx((3.0, 0.06, 3 * plain.max_gap, 1 / 3))
    assert made.scene.contact_radius == plain.contact_radius
    assert (made.occupancy.min_range, made.occupancy.max_range, made.occupancy.voxel) == pytest.approx(
        (0.6, 12.0, 0.05)
    )


@pytest.mark.parametrize(("pixel", "expected"), [(0.004, 0.004), (0.01, 0.006)])
def test_a_splat_may_be_as_small_as_a_pixel(pixel: float, expected: float) -> None:
    depth = replace(ROOM, pixel=pixel)
    assert fitted_to(Config(), depth).scene.min_radius == pytest.approx(expected)
    assert fitted_to(Config(scene=SceneConfig(min_radius=0.008)), depth).scene.min_radius == 0.008
    assert fitted_to(Config(), depth, has_robot=True).scene.min_radius == SceneConfig().min_radius
    seen = frame(0, block=0.2)
    recorded = RecordedDepth.of([seen])
    assert recorded.pixel == pytest.approx(recorded.median / seen.intrinsics.fx)


def slanted(noise: float, seed: int = 0) -> Float32:
    """Depth (240, 320) of a floor seen from the side, with a box on it; noise [1/m]."""
    v, u = np.mgrid[0:240, 0:320]
    inverse = 0.6 + 0.9 * v / 240 + 0.2 * u / 320
    inverse[60:160, 100:220] += 0.4
    return (1 / (inverse + np.random.default_rng(seed).normal(0, noise, inverse.shape))).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0005, 0.0015, 0.006])
def test_the_noise_of_depth_is_found_on_slanted_surfaces_and_beside_edges(noise: float) -> None:
    """The noisiest of several cameras decides."""
    assert depth_noise([slanted(noise)]) == pytest.approx(noise, rel=0.15)
    assert depth_noise([slanted(noise, seed) for seed in range(3)]) == pytest.approx(noise, rel=0.15)
    frames = [replace(frame(camera=f"{each}"), depth=slanted(each)) for each in (0.0003, noise)]
    assert RecordedDepth.of(frames).noise == pytest.approx(noise, rel=0.15)


def test_noise_that_neighbouring_pixels_share_is_found_though_a_narrow_fit_takes_it_away() -> None:
    shared = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(480, 640)), (0, 0), 4.0)
    v, u = np.mgrid[0:480, 0:640]
    depth = (1 / (0.6 + 0.9 * v / 480 + 0.2 * u / 640 + 0.003 * shared / shared.std())).astype(np.float32)
    assert depth_noise([depth]) == pytest.approx(0.003, rel=0.25)


def test_depth_with_holes_everywhere_says_nothing_of_its_noise() -> None:
    depth = slanted(0.01)
    depth[::5, ::5] = 0
    assert depth_noise([depth]) == 0.0 == depth_noise([])


def test_beside_a_robot_the_sensors_error_alone_follows_from_the_recording() -> None:
    noisy, given = replace(ROOM, noise=0.004), Config(occupancy=OccupancyConfig(depth_error=0.003))
    made = fitted_to(Config(), noisy, has_robot=True)
    assert made.occupancy == OccupancyConfig(depth_error=0.004) and made.scene == SceneConfig()
    assert "4 mm at 1 m" in describe_scale(made, noisy) and fitted_to(given, noisy, has_robot=True) is given
    assert fitted_to(CONFIG, ROOM, has_robot=True) is CONFIG


def test_a_recording_without_depth_says_nothing_of_its_scale() -> None:
    assert RecordedDepth.of([replace(frame(), depth=np.zeros_like(frame().depth))]) is None
    assert RecordedDepth.of([]) is None


@pytest.mark.parametrize("factor", [8.0, 1000.0])
def test_a_larger_scene_or_another_unit_gives_the_same_map_in_its_lengths(factor: float) -> None:
    one, other = fitted(1.0), fitted(factor)
    assert len(other) == pytest.approx(len(one), rel=0.02)
    assert np.median(other.radii) == pytest.approx(factor * np.median(one.radii), rel=0.01)
    assert psnr(other, factor) == pytest.approx(psnr(one, 1.0), abs=0.1) and psnr(one, 1.0) > 18
    if factor == 8.0:  # lengths that do not grow give another map
        assert len(fitted(8.0, Config(scene=replace(CONFIG.scene, scale=1.0)))) != len(other)


def test_the_depth_counts_more_at_the_end_of_refining(monkeypatch: pytest.MonkeyPatch) -> None:
    target, heard = SceneFitter(CONFIG.scene, CONFIG.occupancy, WORKSPACE), []
    target.step([frame()])

    def listening(views: Sequence[View], settings: OptimiserSettings, depth: float = 1.0) -> dict[int, LossTerms]:
        heard.append(depth)
        return {}

    monkeypatch.setattr(target.descent, "run", listening)
    target.refine(10)
    assert heard[0] == 1.0 < heard[-1] == CONFIG.scene.refine_depth and heard == sorted(heard)

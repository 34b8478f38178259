"""The map's lengths follow from the recorded depth."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatctrl_cli.config import Config, OccupancyConfig, SceneConfig
from splatctrl_cli.kernels.raster import LossTerms, OptimiserSettings
from splatctrl_cli.records import Box, Float32, RgbdFrame, SplatSet
from splatctrl_cli.scene.descent import Descent
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import View
from splatctrl_cli.scene.render import render
from splatctrl_cli.scene.scale import RecordedDepth, depth_noise, fitted_to, in_words
from tests.scene.wall import INTRINSICS, WORKSPACE, frame, looking_down

CONFIG = Config(scene=SceneConfig(max_splats=800, first_iterations=10))
ROOM = RecordedDepth(median=2.4, nearest=1.6, farthest=12.0)


def larger(recorded: RgbdFrame, factor: float) -> RgbdFrame:
    """The frame as a scene `factor` times as large would have given it, or this one in another unit."""
    T = recorded.T_world_camera.copy()
    T[:3, 3] *= factor
    return replace(recorded, depth=recorded.depth * np.float32(factor), T_world_camera=T)


def fitted(factor: float, given: Config = CONFIG) -> SplatSet:
    """The map of a block on a floor, `factor` times as large."""
    frames = [larger(frame(0, block=0.2, x=x, camera=f"cam{k}"), factor) for k, x in enumerate((0.1, -0.1))]
    depth = RecordedDepth.of(frames)
    assert depth is not None
    config = fitted_to(given, depth)
    box = Box(lower=WORKSPACE.lower * factor, upper=WORKSPACE.upper * factor)
    target = SceneFitter(config.scene, config.occupancy, box)
    target.step(frames)
    return target.splats()


def psnr(splats: SplatSet, factor: float) -> float:
    recorded = larger(frame(0, block=0.2), factor)
    T = looking_down()
    T[:3, 3] *= factor
    view = render(splats, INTRINSICS, T)
    seen = view.opacity > 0.5
    error = (view.color - recorded.color / 255.0)[seen]
    return float(-10 * np.log10(np.mean(error**2)))


def test_at_the_depth_of_a_table_the_lengths_are_those_of_the_configuration() -> None:
    made = fitted_to(Config(), RecordedDepth(median=0.8, nearest=0.5, farthest=1.5))
    assert made.occupancy == OccupancyConfig()
    assert made.scene == replace(SceneConfig(), scale=1.0, radius_depth=0.8)


def test_lengths_grow_with_the_depth_and_what_is_set_stays() -> None:
    config = Config(occupancy=OccupancyConfig(voxel=0.05))
    made = fitted_to(config, ROOM)
    assert made.scene.scale == pytest.approx(3.0)
    assert made.scene.max_radius == pytest.approx(0.06)
    assert made.scene.max_gap == pytest.approx(3 * SceneConfig().max_gap)
    assert made.scene.lambda_depth == pytest.approx(1 / 3)
    assert made.occupancy.voxel == 0.05
    assert made.occupancy.min_range == pytest.approx(0.6)
    assert made.occupancy.max_range == 12.0
    assert made.scene.contact_radius == SceneConfig().contact_radius  # the robot has one size


def test_what_a_camera_carries_stays_too_near_beside_a_near_scene() -> None:
    made = fitted_to(Config(), RecordedDepth(median=0.5, nearest=0.1, farthest=0.8))
    assert made.occupancy.min_range == OccupancyConfig().min_range


def slanted(noise: float, seed: int = 0) -> Float32:
    """Depth (240, 320) of a floor seen from the side, with a box on it; noise [1/m]."""
    v, u = np.mgrid[0:240, 0:320]
    inverse = 0.6 + 0.9 * v / 240 + 0.2 * u / 320
    inverse[60:160, 100:220] += 0.4
    return (1 / (inverse + np.random.default_rng(seed).normal(0, noise, inverse.shape))).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0005, 0.0015, 0.006])
def test_the_noise_of_depth_is_found_on_slanted_surfaces_and_beside_edges(noise: float) -> None:
    assert depth_noise([slanted(noise)]) == pytest.approx(noise, rel=0.15)
    assert depth_noise([slanted(noise, seed) for seed in range(3)]) == pytest.approx(noise, rel=0.15)


def test_noise_that_neighbouring_pixels_share_is_found_though_a_narrow_fit_takes_it_away() -> None:
    white = np.random.default_rng(0).normal(size=(480, 640))
    shared = cv2.GaussianBlur(white, (0, 0), 4.0)
    noise = 0.003 * shared / shared.std()
    v, u = np.mgrid[0:480, 0:640]
    depth = (1 / (0.6 + 0.9 * v / 480 + 0.2 * u / 640 + noise)).astype(np.float32)
    assert depth_noise([depth]) == pytest.approx(0.003, rel=0.25)


def test_depth_with_holes_everywhere_says_nothing_of_its_noise() -> None:
    depth = slanted(0.01)
    depth[::5, ::5] = 0
    assert depth_noise([depth]) == 0.0 == depth_noise([])


def test_beside_a_robot_the_sensors_error_alone_follows_from_the_recording() -> None:
    noisy = replace(ROOM, noise=0.004)
    made = fitted_to(Config(), noisy, has_robot=True)
    assert made.occupancy == OccupancyConfig(depth_error=0.004) and made.scene == SceneConfig()
    assert "4 mm at 1 m" in in_words(made, noisy)
    for given, depth in ((Config(), ROOM), (Config(occupancy=OccupancyConfig(depth_error=0.003)), noisy)):
        assert fitted_to(given, depth, has_robot=True) is given


def test_of_several_cameras_the_noisiest_counts() -> None:
    frames = [replace(frame(0, camera=name), depth=slanted(noise)) for name, noise in (("a", 0.001), ("b", 0.004))]
    depth = RecordedDepth.of(frames)
    assert depth is not None and depth.noise == pytest.approx(0.004, rel=0.15)


def test_a_scale_of_one_is_the_papers() -> None:
    config = Config(scene=SceneConfig(scale=1.0))
    assert fitted_to(config, ROOM) == config


def test_a_recording_without_depth_says_nothing_of_its_scale() -> None:
    assert RecordedDepth.of([replace(frame(), depth=np.zeros_like(frame().depth))]) is None
    assert RecordedDepth.of([]) is None


@pytest.mark.parametrize("factor", [8.0, 1000.0])
def test_a_larger_scene_or_another_unit_gives_the_same_map_in_its_lengths(factor: float) -> None:
    one, other = fitted(1.0), fitted(factor)
    assert len(other) == pytest.approx(len(one), rel=0.02)
    assert np.median(other.radii) == pytest.approx(factor * np.median(one.radii), rel=0.01)
    assert psnr(other, factor) == pytest.approx(psnr(one, 1.0), abs=0.1)
    assert psnr(one, 1.0) > 18


def test_lengths_that_do_not_grow_give_another_map_of_a_larger_scene() -> None:
    assert len(fitted(8.0, Config(scene=replace(CONFIG.scene, scale=1.0)))) != len(fitted(8.0))


def test_the_depth_counts_more_at_the_end_of_refining() -> None:
    heard = []

    class Listening(Descent):
        def run(self, views: Sequence[View], settings: OptimiserSettings, depth: float = 1.0) -> dict[int, LossTerms]:
            heard.append(depth)
            return {}

    target = SceneFitter(CONFIG.scene, CONFIG.occupancy, WORKSPACE)
    target.step([frame()])
    target.descent = Listening(CONFIG.scene, target.buffer, 0, 1)
    target.descent.background = (0.0, 0.0, 0.0)
    target.refine(10)
    assert heard[0] == 1.0
    assert heard[-1] == CONFIG.scene.refine_depth > 1.0
    assert heard == sorted(heard)

"""The map's lengths follow from the recorded depth."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import Config, OccupancyConfig, SceneConfig
from splatctrl_cli.kernels.raster import LossTerms, OptimiserSettings
from splatctrl_cli.records import Box, RgbdFrame, SplatSet
from splatctrl_cli.scene.descent import Descent
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import View
from splatctrl_cli.scene.render import render
from splatctrl_cli.scene.scale import RecordedDepth, fitted_to
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

"""Splats and an occupancy grid that are not of one scene are told from those that are."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.records import SplatSet
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.splats_and_occupancy import GridAgreement, agreement_with_grid
from splatctrl_cli.voxels import KnownVoxels
from tests.scene.wall import WORKSPACE, frame

SCENE, OCCUPANCY = SceneConfig(max_splats=600, first_iterations=20, iterations_per_step=5), OccupancyConfig()


@pytest.fixture(scope="module")
def fitter() -> SceneFitter:
    made = SceneFitter(SCENE, OCCUPANCY, WORKSPACE)
    for step in range(3):
        made.step([frame(step, block=0.2, y=0.05), frame(step, block=0.2, y=-0.05)])
    return made


def of(splats: SplatSet, known: KnownVoxels) -> GridAgreement:
    return agreement_with_grid(splats, known, SCENE, OCCUPANCY)


def moved(splats: SplatSet, scale: float, shift: float) -> SplatSet:
    return replace(splats, centers=(splats.centers * scale + np.float32(shift)).astype(np.float32))


def test_a_map_agrees_with_its_own_grid(fitter: SceneFitter) -> None:
    found = of(fitter.splats(), fitter.known_voxels())
    assert found.holds
    assert found.on_surface > 0.95
    assert found.represented > 0.98
    assert found.num_splats == len(fitter.splats())
    assert found.num_voxels == len(fitter.occupancy.occupied_voxels())


@pytest.mark.parametrize(("scale", "shift"), [(1000.0, 0.0), (1.0, 3.0), (1.0, 0.1)])
def test_splats_in_other_units_or_moved_do_not(fitter: SceneFitter, scale: float, shift: float) -> None:
    found = of(moved(fitter.splats(), scale, shift), fitter.known_voxels())
    assert not found.holds
    assert found.on_surface < 0.6
    assert found.represented < 0.95


def test_one_splat_of_many_does_not(fitter: SceneFitter) -> None:
    splats = fitter.splats()
    found = of(splats.select(np.arange(len(splats)) == 5), fitter.known_voxels())
    assert found.represented < 0.1
    assert not found.holds


def test_balls_stand_for_their_voxels_and_only_for_them(fitter: SceneFitter) -> None:
    splats, known = fitter.splats(), fitter.known_voxels()
    few = splats.select(splats.centers[:, 0] > 0)
    assert not of(few, known).holds
    centers = fitter.occupancy.occupied_centers()
    balls = replace(known.unrepresented, centers=centers, labels=np.zeros(len(centers), np.uint8))
    assert of(few, replace(known, unrepresented=balls)).represented == 1.0


def test_nothing_to_compare_does_not_agree(fitter: SceneFitter) -> None:
    splats, known = fitter.splats(), fitter.known_voxels()
    assert not of(splats.select(np.zeros(len(splats), bool)), known).holds
    blank = replace(known.grid, log_odds=np.zeros_like(known.grid.log_odds), num_updates=known.grid.num_updates * 0)
    assert not of(splats, replace(known, grid=blank)).holds

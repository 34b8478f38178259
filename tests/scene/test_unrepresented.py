"""What is occupied and has no splat is known, and becomes balls."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import OccupancyConfig, SceneConfig
from splatctrl_cli.records import Box, Label, SplatSet
from splatctrl_cli.scene.checkpoint import fitter_state, restore_fitter
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.unrepresented import (
    GridAgreement,
    agreement_with_grid,
    bare_voxels,
    confirmed,
    representing_reach,
    unrepresented_voxels,
)
from splatctrl_cli.voxels import SWEPT, Balls, KnownVoxels
from tests.plain import plain_splats
from tests.reference.unrepresented import unrepresented
from tests.scene.wall import WORKSPACE, frame

CONFIG = SceneConfig()
BOX = Box(lower=np.zeros(3), upper=np.full(3, 0.4))


def occupied(*cells: tuple[int, int, int], voxel: float = 0.02) -> OccupancyMap:
    """A grid with these voxels hit often."""
    grid = OccupancyMap(BOX, OccupancyConfig(voxel=voxel), 1)
    for cell in cells:
        grid.log_odds[cell] = 2.0
    return grid


@pytest.mark.parametrize("voxel", [0.02, 0.025, 0.05])
def test_the_voxels_are_those_of_the_plain_reference(voxel: float) -> None:
    rng = np.random.default_rng(1)
    grid = occupied(voxel=voxel)
    grid.log_odds[rng.random(grid.log_odds.shape) < 0.2] = 2.0
    splats = plain_splats(rng.uniform(-0.02, 0.42, (150, 3)), rng.uniform(0.002, 0.02, 150))
    found = unrepresented_voxels(grid, splats, CONFIG)
    centers = grid.occupied_centers().astype(np.float64)
    reach = representing_reach(CONFIG, voxel)
    missing = unrepresented(centers, splats.centers.astype(float), splats.radii.astype(float), reach)
    assert 20 < missing.sum() < 0.9 * len(missing)
    assert found.centers.tolist() == centers[missing].astype(np.float32).tolist()
    assert found.radius == pytest.approx(0.5 * 3**0.5 * voxel)


def balls(*cells: tuple[int, int, int]) -> Balls:
    centers = 0.02 * np.array(cells, np.float32).reshape(-1, 3)
    return Balls.of_voxels(centers, 0.02, np.full(len(cells), Label.OBJECT, np.uint8))


LONE, PAIR, ROW = [(0, 0, 0)], [(9, 9, 9), (10, 10, 10)], [(5, 5, 5), (5, 5, 6), (6, 6, 7)]


@pytest.mark.parametrize(
    ("before", "kept"),
    [
        pytest.param(None, [*LONE, *PAIR, *ROW], id="the first step knows none before"),
        pytest.param([], ROW, id="three that touch, by a corner too, count at once"),
        pytest.param([*LONE, (9, 9, 9)], [*LONE, (9, 9, 9), *ROW], id="what was there before counts"),
        pytest.param([(0, 0, 1), (10, 9, 9)], ROW, id="beside it is not there"),
    ],
)
def test_few_voxels_count_where_they_were_before(
    before: list[tuple[int, int, int]] | None, kept: list[tuple[int, int, int]]
) -> None:
    found = confirmed(balls(*LONE, *PAIR, *ROW), None if before is None else balls(*before))
    assert found.centers.tolist() == balls(*kept).centers.tolist()


def test_none_are_confirmed_by_none() -> None:
    assert not len(confirmed(balls(), balls(*LONE)))


def test_a_voxel_is_represented_up_to_the_gap_that_is_filled() -> None:
    grid, center = occupied((10, 10, 10)), np.array([0.21, 0.21, 0.21])
    reach = 0.018 + 0.01
    assert representing_reach(CONFIG, 0.02) == pytest.approx(reach)
    near, far = (plain_splats(center + np.array([0.0, 0.01 + reach + e, 0.0]), 0.01) for e in (-1e-4, 1e-4))
    assert len(unrepresented_voxels(grid, near, CONFIG)) == 0
    assert len(unrepresented_voxels(grid, far, CONFIG)) == 1
    assert len(unrepresented_voxels(grid, far, CONFIG, error=2e-4)) == 0  # the sensor may be off by as much


def test_the_reach_is_at_most_a_voxels_diagonal() -> None:
    assert representing_reach(SceneConfig(max_gap=0.5), 0.02) == pytest.approx(0.02 * 3**0.5)


def test_one_hit_is_not_enough() -> None:
    grid = occupied((3, 3, 3))
    grid.log_odds[3, 3, 3] = grid.config.log_odds_hit
    assert len(unrepresented_voxels(grid, plain_splats([], 0.01), CONFIG)) == 0


def test_the_robots_splats_stand_for_nothing_and_its_voxels_are_none() -> None:
    grid = occupied((3, 3, 3), (9, 9, 9))
    assert len(unrepresented_voxels(grid, plain_splats([0.07, 0.07, 0.07], 0.01, labels=Label.ROBOT), CONFIG)) == 2
    grid.entity[3, 3, 3] = SWEPT
    balls = unrepresented_voxels(grid, plain_splats([], 0.01), CONFIG)
    assert balls.centers.tolist() == pytest.approx(np.float32([[0.19, 0.19, 0.19]]))


def test_a_persons_voxels_are_balls_of_a_person() -> None:
    grid = occupied((3, 3, 3), (9, 9, 9))
    grid.entity[9, 9, 9] = Label.HUMAN
    assert unrepresented_voxels(grid, plain_splats([], 0.01), CONFIG).labels.tolist() == [Label.OBJECT, Label.HUMAN]


def test_a_fitter_that_goes_on_has_the_balls_of_the_one_before() -> None:
    """A robot's meshes tell which voxels are its own; they are no part of the state."""
    before, after = (SceneFitter(SCENE, OCCUPANCY, WORKSPACE) for _ in range(2))
    before.step([frame(0, block=0.2)])
    center = np.float32([[0.1, 0.2, 0.3]])
    before.unrepresented = Balls.of_voxels(center, OCCUPANCY.voxel, np.array([Label.OBJECT], np.uint8))
    restore_fitter(after, fitter_state(before))
    assert after.unrepresented.centers.tolist() == center.tolist()


def test_a_ball_contains_its_voxel() -> None:
    balls = Balls.of_voxels(np.zeros((1, 3), np.float32), 0.02, np.zeros(1, np.uint8))
    assert balls.radius >= np.linalg.norm([0.01, 0.01, 0.01])


def test_gap_filling_looks_at_all_that_is_bare_and_half_of_it_in_turn() -> None:
    rng = np.random.default_rng(1)
    grid = occupied()
    grid.log_odds[rng.random(grid.log_odds.shape) < 0.2] = 2.0
    splats = plain_splats(rng.uniform(0.0, 0.4, (150, 3)), 0.02)
    everything = bare_voxels(grid, splats, BOX, CONFIG)
    halves = [bare_voxels(grid, splats, BOX, CONFIG, half) for half in (0, 1)]
    assert sorted(np.concatenate(halves).tolist()) == sorted(everything.tolist())
    assert min(len(half) for half in halves) > 0.3 * len(everything) > 0
    missing = unrepresented_voxels(grid, splats, CONFIG).centers
    assert {tuple(c) for c in missing.tolist()} <= {tuple(c) for c in everything.tolist()}
    above = Box(lower=np.array([0.0, 0.0, 0.2]), upper=BOX.upper)
    assert (bare_voxels(grid, splats, above, CONFIG)[:, 2] > 0.2).all()


def test_what_a_starved_budget_leaves_out_is_told_and_kept() -> None:
    fitter = SceneFitter(
        SceneConfig(max_splats=30, first_iterations=5, iterations_per_step=2), OccupancyConfig(), WORKSPACE
    )
    fitter.step([frame(), frame(y=0.02)])
    row = fitter.step([frame(1, block=0.2), frame(1, block=0.2, y=0.02)])
    row = fitter.step([frame(2, block=0.2), frame(2, block=0.2, y=0.02)])
    balls = fitter.known_voxels().unrepresented
    assert row.unrepresented == len(balls) > 0
    assert row.unmet > 0
    top = np.abs(balls.centers[:, 2] - 0.2) < 0.03
    alive = fitter.splats().centers
    covered = sum(np.linalg.norm(alive - center, axis=1).min() < 0.06 for center in balls.centers[top])
    assert top.sum() > covered


SCENE, OCCUPANCY = SceneConfig(max_splats=600, first_iterations=20, iterations_per_step=5), OccupancyConfig()


@pytest.fixture(scope="module")
def fitter() -> SceneFitter:
    made = SceneFitter(SCENE, OCCUPANCY, WORKSPACE)
    for step in range(3):
        made.step([frame(step, block=0.2, y=0.05), frame(step, block=0.2, y=-0.05)])
    return made


def agreement(splats: SplatSet, known: KnownVoxels) -> GridAgreement:
    return agreement_with_grid(splats, known, SCENE, OCCUPANCY)


def moved(splats: SplatSet, scale: float, shift: float) -> SplatSet:
    return replace(splats, centers=(splats.centers * scale + np.float32(shift)).astype(np.float32))


def test_a_map_agrees_with_its_own_grid(fitter: SceneFitter) -> None:
    found = agreement(fitter.splats(), fitter.known_voxels())
    assert found.holds
    assert found.on_surface > 0.95
    assert found.represented > 0.98
    assert found.num_splats == len(fitter.splats())
    assert found.num_voxels == len(fitter.occupancy.occupied_voxels())


@pytest.mark.parametrize(("scale", "shift"), [(1000.0, 0.0), (1.0, 3.0), (1.0, 0.1)])
def test_splats_in_other_units_or_moved_do_not(fitter: SceneFitter, scale: float, shift: float) -> None:
    found = agreement(moved(fitter.splats(), scale, shift), fitter.known_voxels())
    assert not found.holds
    assert found.on_surface < 0.6
    assert found.represented < 0.95


def test_splats_where_nobody_looked_say_nothing(fitter: SceneFitter) -> None:
    """As on a wall that is farther than depth counts: half of the splats and the voxels about them."""
    splats, known = fitter.splats(), fitter.known_voxels()
    log_odds, num_updates = known.grid.log_odds.copy(), known.grid.num_updates.copy()
    half = log_odds.shape[0] // 2
    log_odds[:half], num_updates[:half] = 0.0, 0
    found = agreement(splats, replace(known, grid=replace(known.grid, log_odds=log_odds, num_updates=num_updates)))
    assert found.on_surface > 0.95


def test_one_splat_of_many_does_not(fitter: SceneFitter) -> None:
    splats = fitter.splats()
    found = agreement(splats.select(np.arange(len(splats)) == 5), fitter.known_voxels())
    assert found.represented < 0.1
    assert not found.holds


def test_balls_stand_for_their_voxels_and_only_for_them(fitter: SceneFitter) -> None:
    splats, known = fitter.splats(), fitter.known_voxels()
    few = splats.select(splats.centers[:, 0] > 0)
    assert not agreement(few, known).holds
    centers = fitter.occupancy.occupied_centers()
    balls = replace(known.unrepresented, centers=centers, labels=np.zeros(len(centers), np.uint8))
    assert agreement(few, replace(known, unrepresented=balls)).represented == 1.0


def test_nothing_to_compare_does_not_agree(fitter: SceneFitter) -> None:
    splats, known = fitter.splats(), fitter.known_voxels()
    assert not agreement(splats.select(np.zeros(len(splats), bool)), known).holds
    blank = replace(known.grid, log_odds=np.zeros_like(known.grid.log_odds), num_updates=known.grid.num_updates * 0)
    assert not agreement(splats, replace(known, grid=blank)).holds

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
    confirm_bare,
    representing_reach,
    unrepresented_voxels,
)
from splatctrl_cli.voxels import SWEPT, Balls, KnownVoxels
from tests.plain import plain_splats
from tests.reference.unrepresented import unrepresented
from tests.scene.wall import WORKSPACE, frame

CONFIG = SceneConfig()
BOX = Box(lower=np.zeros(3), upper=np.full(3, 0.4))
NONE = plain_splats([], 0.01)


def occupied(*cells: tuple[int, int, int], voxel: float = 0.02, share: float = 0.0) -> OccupancyMap:
    """A grid with these voxels hit often, and a share of all."""
    grid = OccupancyMap(BOX, OccupancyConfig(voxel=voxel), 1)
    grid.log_odds[np.random.default_rng(1).random(grid.log_odds.shape) < share] = 2.0
    for cell in cells:
        grid.log_odds[cell] = 2.0
    return grid


def some_splats(largest: float = 0.02) -> SplatSet:
    rng = np.random.default_rng(2)
    return plain_splats(rng.uniform(-0.02, 0.42, (150, 3)), rng.uniform(0.002, largest, 150))


def reads_bare(grid: OccupancyMap, splats: SplatSet = NONE, error: float = 0.0) -> Balls:
    return unrepresented_voxels(grid, splats, CONFIG, error=error)


@pytest.mark.parametrize("voxel", [0.02, 0.025, 0.05])
def test_the_voxels_are_those_of_the_plain_reference(voxel: float) -> None:
    """And a ball contains its voxel."""
    grid, splats = occupied(voxel=voxel, share=0.2), some_splats()
    found, centers = reads_bare(grid, splats), grid.centers_of(grid.occupied_voxels()).astype(np.float64)
    missing = unrepresented(
        centers, splats.centers.astype(float), splats.radii.astype(float), representing_reach(CONFIG, voxel)
    )
    assert 20 < missing.sum() < 0.9 * len(missing)
    assert found.centers.tolist() == centers[missing].astype(np.float32).tolist()
    assert found.radius == pytest.approx(0.5 * 3**0.5 * voxel)


def balls(*cells: tuple[int, int, int]) -> Balls:
    centers = 0.02 * np.array(cells, np.float32).reshape(-1, 3)
    return Balls.from_voxels(centers, 0.02, np.full(len(cells), Label.OBJECT, np.uint8))


Cells = list[tuple[int, int, int]]
LONE, PAIR, ROW = [(0, 0, 0)], [(9, 9, 9), (10, 10, 10)], [(5, 5, 5), (5, 5, 6), (6, 6, 7)]
ALL = [*LONE, *PAIR, *ROW]


@pytest.mark.parametrize(
    ("now", "before", "kept"),
    [
        pytest.param(ALL, None, ALL, id="the first step knows none before"),
        pytest.param(ALL, [], ROW, id="three that touch, by a corner too, count at once"),
        pytest.param(ALL, [*LONE, (9, 9, 9)], [*LONE, (9, 9, 9), *ROW], id="what was there before counts"),
        pytest.param(ALL, [(0, 0, 1), (10, 9, 9)], ROW, id="beside it is not there"),
        pytest.param([], LONE, [], id="none"),
    ],
)
def test_few_voxels_count_where_they_were_before(now: Cells, before: Cells | None, kept: Cells) -> None:
    found = confirm_bare(balls(*now), None if before is None else balls(*before))
    assert found.centers.tolist() == balls(*kept).centers.tolist()


def test_a_voxel_is_represented_up_to_the_gap_that_is_filled() -> None:
    """Or up to its diagonal, and where the sensor may be off by as much."""
    grid, center, reach = occupied((10, 10, 10)), np.array([0.21, 0.21, 0.21]), 0.018 + 0.01
    assert representing_reach(CONFIG, 0.02) == pytest.approx(reach)
    assert representing_reach(SceneConfig(max_gap=0.5), 0.02) == pytest.approx(0.02 * 3**0.5)
    near, far = (plain_splats(center + np.array([0.0, 0.01 + reach + e, 0.0]), 0.01) for e in (-1e-4, 1e-4))
    assert [len(reads_bare(grid, near)), len(reads_bare(grid, far)), len(reads_bare(grid, far, 2e-4))] == [0, 1, 0]


def test_the_robots_splats_stand_for_nothing_and_its_voxels_are_none() -> None:
    """A person's are balls of a person, and one hit is not enough."""
    grid = occupied((3, 3, 3), (9, 9, 9), (12, 12, 12))
    grid.log_odds[12, 12, 12] = grid.config.log_odds_hit
    assert len(reads_bare(grid, plain_splats([0.07, 0.07, 0.07], 0.01, labels=Label.ROBOT))) == 2
    grid.entity[9, 9, 9] = Label.HUMAN
    assert reads_bare(grid).labels.tolist() == [Label.OBJECT, Label.HUMAN]
    grid.entity[3, 3, 3] = SWEPT
    assert reads_bare(grid).centers.tolist() == pytest.approx(np.float32([[0.19, 0.19, 0.19]]))


def test_a_fitter_that_goes_on_has_the_balls_of_the_one_before() -> None:
    """A robot's meshes tell which voxels are its own; they are no part of the state."""
    before, after = (SceneFitter(SCENE, OCCUPANCY, WORKSPACE) for _ in range(2))
    before.step([frame(0, block=0.2)])
    before.unrepresented = balls((5, 10, 15))
    restore_fitter(after, fitter_state(before))
    assert after.unrepresented.centers.tolist() == balls((5, 10, 15)).centers.tolist()


def test_gap_filling_looks_at_all_that_is_bare_and_half_of_it_in_turn() -> None:
    grid, splats = occupied(share=0.2), some_splats()
    everything = bare_voxels(grid, splats, BOX, CONFIG)
    halves = [bare_voxels(grid, splats, BOX, CONFIG, half) for half in (0, 1)]
    assert sorted(np.concatenate(halves).tolist()) == sorted(everything.tolist())
    assert min(len(half) for half in halves) > 0.3 * len(everything) > 0
    assert {tuple(c) for c in reads_bare(grid, splats).centers.tolist()} <= {tuple(c) for c in everything.tolist()}
    above = Box(lower=np.array([0.0, 0.0, 0.2]), upper=BOX.upper)
    assert (bare_voxels(grid, splats, above, CONFIG)[:, 2] > 0.2).all()


def test_what_a_starved_budget_leaves_out_is_told_and_kept() -> None:
    fitter = SceneFitter(
        SceneConfig(max_splats=30, first_iterations=5, iterations_per_step=2), OccupancyConfig(), WORKSPACE
    )
    for k, block in enumerate((0.0, 0.2, 0.2)):
        row = fitter.step([frame(k, block=block), frame(k, block=block, y=0.02)])
    balls, alive = fitter.known_voxels().unrepresented, fitter.splats().centers
    assert row.unrepresented == len(balls) > 0 and row.unmet > 0
    top = balls.centers[np.abs(balls.centers[:, 2] - 0.2) < 0.03]
    assert (np.linalg.norm(alive - top[:, None], axis=2).min(axis=1) >= 0.06).any()


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
    assert found.holds and found.on_surface > 0.95 and found.represented > 0.98
    assert (found.num_splats, found.num_voxels) == (len(fitter.splats()), len(fitter.occupancy.occupied_voxels()))


@pytest.mark.parametrize(("scale", "shift"), [(1000.0, 0.0), (1.0, 3.0), (1.0, 0.1)])
def test_splats_in_other_units_or_moved_do_not(fitter: SceneFitter, scale: float, shift: float) -> None:
    found = agreement(moved(fitter.splats(), scale, shift), fitter.known_voxels())
    assert not found.holds and found.on_surface < 0.6 and found.represented < 0.95


def test_splats_where_nobody_looked_say_nothing(fitter: SceneFitter) -> None:
    """As on a wall that is farther than depth counts: half of the splats and the voxels about them."""
    assert agreement(fitter.splats(), forgotten(fitter, 0.5)).on_surface > 0.95


def forgotten(fitter: SceneFitter, share: float) -> KnownVoxels:
    """The voxels of whose first share along x nothing is known."""
    known = fitter.known_voxels()
    log_odds, num_updates = known.grid.log_odds.copy(), known.grid.num_updates.copy()
    part = slice(round(share * len(log_odds)))
    log_odds[part], num_updates[part] = 0.0, 0
    return replace(known, grid=replace(known.grid, log_odds=log_odds, num_updates=num_updates))


def test_few_splats_and_nothing_to_compare_do_not_agree(fitter: SceneFitter) -> None:
    splats, known = fitter.splats(), fitter.known_voxels()
    found = agreement(splats.select(np.arange(len(splats)) == 5), known)
    assert found.represented < 0.1 and not found.holds
    assert not agreement(splats.select(np.zeros(len(splats), bool)), known).holds
    assert not agreement(splats, forgotten(fitter, 1.0)).holds


def test_balls_stand_for_their_voxels_and_only_for_them(fitter: SceneFitter) -> None:
    known, centers = fitter.known_voxels(), fitter.occupancy.centers_of(fitter.occupancy.occupied_voxels())
    few = fitter.splats().select(fitter.splats().centers[:, 0] > 0)
    assert not agreement(few, known).holds
    every = replace(known.unrepresented, centers=centers, labels=np.zeros(len(centers), np.uint8))
    assert agreement(few, replace(known, unrepresented=every)).represented == 1.0

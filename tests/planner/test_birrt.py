from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from experiments.paths import joint_length
from experiments.solids import OnlyDistance, Solids
from splatctrl_cli.config import PlannerConfig
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.planner import birrt
from splatctrl_cli.planner.birrt import PlanOutcome, plan, shorten_path
from splatctrl_cli.planner.configuration_clearance import Clearance, EdgeCheck, check_edges
from splatctrl_cli.planner.planned import resample
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, Nowhere, PlanarArm, Plane
from tests.planner.walls import clearance, closed_ring, one_wall, thin_post

CONFIG = PlannerConfig(max_iterations=300, max_time=60.0)
START, GOAL = np.array([0.7, 0.2]), np.array([-0.7, -0.2])


APART = np.array([1.5, 0.1]), np.array([-1.5, 0.1])  # postures on either side of the closed ring


def densest(room: Clearance, waypoints: Float64) -> float:
    """The least clearance at samples 2 mrad apart."""
    return float(np.min(room.at(resample(waypoints, 2e-3))))


def densest_of(room: Clearance, start: Float64, end: Float64) -> Float64:
    """Least sampled clearance (N,) [m] of straight edges."""
    return np.array([densest(room, np.array(edge)) for edge in zip(start, end, strict=True)])


@pytest.mark.parametrize(("margin", "seed"), [(0.0, 0), (0.0, 1), (0.0, 2), (0.03, 0)])
def test_a_way_round_a_wall_is_found_and_is_free(margin: float, seed: int) -> None:
    """The path keeps margin and joint limits, and the same seed gives the same path."""
    room, arm = clearance(one_wall()), PlanarArm()
    assert densest(room, np.array([START, GOAL])) < 0  # the straight edge is not
    found, again = (plan(clearance(one_wall(), margin=margin), START, GOAL, CONFIG, seed=seed) for _ in range(2))
    assert found.is_solved
    np.testing.assert_array_equal(found.waypoints[[0, -1]], [START, GOAL])
    for waypoints in (found.waypoints, found.raw_path):
        assert densest(room, waypoints) > margin
        assert np.all((waypoints >= arm.lower) & (waypoints <= arm.upper))
    np.testing.assert_array_equal(found.waypoints, again.waypoints)
    assert (found.num_checks, found.num_edges) == (again.num_checks, again.num_edges)
    other = plan(room, START, GOAL, CONFIG, seed=seed + 9).waypoints
    assert found.waypoints.shape != other.shape or not np.array_equal(found.waypoints, other)


@pytest.mark.parametrize(
    ("limits", "outcome", "num"),
    [
        ({"max_iterations": 60}, PlanOutcome.OUT_OF_ITERATIONS, 60),
        ({"max_time": 0.0}, PlanOutcome.OUT_OF_TIME, 0),
    ],
)
def test_a_goal_behind_a_closed_wall_runs_out_of_iterations_or_time(
    limits: dict[str, Any], outcome: PlanOutcome, num: int
) -> None:
    found = plan(clearance(closed_ring()), *APART, replace(CONFIG, **limits))
    assert (found.outcome, found.num_iterations) == (outcome, num)
    assert not found.is_solved and len(found.waypoints) == 0


def test_trees_join_only_where_the_whole_edge_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """The straight edge is not free, the trees' edges are."""
    num_asked = []

    def checked(_: Clearance, start: Float64, end: Float64, *, only_whole: bool, **__: object) -> EdgeCheck:
        num_asked.append(len(start))
        share = float(len(num_asked) > 1) if only_whole else 0.999
        return EdgeCheck(free_share=np.full(len(start), share), num_checks=len(start))

    monkeypatch.setattr(birrt, "check_edges", checked)
    found = plan(clearance(one_wall()), START, GOAL, replace(CONFIG, max_iterations=5))
    assert found.outcome is PlanOutcome.OUT_OF_ITERATIONS


def test_of_several_goals_the_one_reached_is_named() -> None:
    start, beyond = APART
    found = plan(clearance(closed_ring()), start, np.array([beyond, [2.0, -0.3]]), CONFIG)
    assert found.is_solved and found.goal == 1
    np.testing.assert_array_equal(found.waypoints[-1], [2.0, -0.3])


@pytest.mark.parametrize(
    ("start", "goals", "error", "words"),
    [
        ([0.0, 0.0], [GOAL], NotEvaluableError, r"start: .*got fore\[\d\] at -0\.0\d+ m"),
        (START, [GOAL, [0.0, 0.0]], NotEvaluableError, r"goal 1: .*got fore\[\d\] at -0\.0\d+ m"),
        (START, [0.7, 2.7], InputError, r"goal: joint elbow: expected within \[-2.6000, 2.6000\] rad, got 2.7000"),
        ([np.nan, 0.0], [GOAL], InputError, "start: joint shoulder is nan"),
    ],
)
def test_a_start_or_goal_that_cannot_be_is_named(
    start: ArrayLike, goals: ArrayLike, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        plan(clearance(one_wall()), np.array(start), np.array(goals), CONFIG)


@pytest.mark.parametrize("seed", range(5))
def test_shortcuts_are_proved_and_never_longer(seed: int) -> None:
    room = clearance(one_wall())
    found = plan(room, START, GOAL, replace(CONFIG, shortcut_rounds=0), seed=seed).raw_path
    short, _, _ = shorten_path(room, found, CONFIG, np.random.default_rng(seed))
    np.testing.assert_array_equal(short[[0, -1]], found[[0, -1]])
    assert joint_length(short) <= joint_length(found) + 1e-12 and densest(room, short) > 0


def random_edges(num: int) -> Float64:
    """Starts and ends (2, num, 2)."""
    arm = PlanarArm()
    return np.random.default_rng(7).uniform(arm.lower, arm.upper, (2, num, 2))


@pytest.mark.parametrize("room", [one_wall(), closed_ring(), thin_post()], ids=["wall", "ring", "needle"])
def test_no_edge_is_accepted_that_dense_samples_find_in_collision(room: Solids) -> None:
    free, edges = clearance(room), random_edges(120)
    is_free, dense = check_edges(free, *edges, contact=1e-4).is_free, densest_of(free, *edges)
    assert np.all(dense[is_free] > 0) and 0.1 < is_free.mean() < 0.9  # the edges try both
    assert np.all(is_free[dense > 0.01])  # and no edge with room to spare is refused


def test_a_needle_between_samples_is_not_stepped_over() -> None:
    free = clearance(thin_post(radius=1e-3))
    slim = replace(free, taken=np.full_like(free.taken, 1e-3))
    angle = np.arctan2(0.31, 0.62) + np.array([-0.37, 0.33])
    near = np.hypot(0.62, 0.31)
    bend = np.arccos((near**2 - 0.5**2 - 0.4**2) / (2 * 0.5 * 0.4))  # the tip's sphere sweeps through the needle
    reach = np.arctan2(0.4 * np.sin(bend), 0.5 + 0.4 * np.cos(bend))
    start, end = np.array([[angle[0] - reach, bend]]), np.array([[angle[1] - reach, bend]])
    samples = start + np.linspace(0, 1, 15)[:, None] * (end - start)  # 0.05 rad apart
    assert np.min(slim.at(samples)) > 0
    assert not check_edges(slim, start, end, contact=1e-5).is_free[0]


def test_the_free_share_of_an_edge_is_free_and_ends_at_the_wall() -> None:
    free, (start, end) = clearance(one_wall()), random_edges(120)
    share = check_edges(free, start, end, contact=1e-4, give_up=0.02, only_whole=False).free_share
    beyond = np.clip(share + 0.1 / np.linalg.norm(end - start, axis=1), 0, 1)
    last, after = (start + part[:, None] * (end - start) for part in (share, beyond))
    assert np.all(densest_of(free, start, last)[share > 0] > 0)
    assert np.all(densest_of(free, last, after)[share < 1] < 0.05)


def test_pairs_of_the_robots_own_spheres_count() -> None:
    folded, free = np.array([0.0, 2.6]), clearance(thin_post())
    own = PlanarArm().sphere_centers(folded)
    tip = free.rows(folded[None])[0][free.names.index("base[0]~fore[1]")]
    assert tip == pytest.approx(np.linalg.norm(own[0] - own[4]) - 0.06 - 0.04, abs=1e-12)


def test_a_field_without_a_distance_is_an_error_that_says_where() -> None:
    with pytest.raises(NotEvaluableError, match=r"sphere upper\[0\] at \(0.250, 0.000, 0.000\) m: the field has no"):
        Clearance.of(PlanarArm(), OnlyDistance(field=Nowhere())).at(np.zeros((1, 2)))


def test_a_distance_field_is_a_scene_as_solids_are() -> None:
    q = random_edges(50)[0]
    field = OnlyDistance(field=Balls([[0.62, 0.31, 0.0]], [0.002]))
    np.testing.assert_allclose(Clearance.of(PlanarArm(), field).rows(q), clearance(thin_post()).rows(q), atol=1e-12)


def test_a_field_steeper_than_a_distance_is_checked_with_its_own_slope() -> None:
    steep, (start, end) = OnlyDistance(field=Plane([0.0, 1.0, 0.0], -0.5, scale=3.0)), random_edges(100)
    trusting, wary = (Clearance.of(PlanarArm(), steep, lipschitz=slope) for slope in (1.0, 3.0))
    assert np.all(densest_of(wary, start, end)[check_edges(wary, start, end, contact=1e-4).is_free] > 0)
    ratio = wary.speeds(end - start) / np.maximum(trusting.speeds(end - start), 1e-12)
    assert np.allclose(ratio[:, :4], 3.0)

"""Bounds of the clearance between two states, against dense sampling and a plain reference."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.control.intervals import Between, Reach, between_states, clearances
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from tests.control.fakes import Balls, PlanarArm
from tests.reference.intervals import interval_bound

MARGIN = 0.02


def bounds(
    arm: PlanarArm | RobotModel,
    balls: Balls,
    states: Float64,
    *,
    seconds: float = 0.05,
    velocities: Float64 | None = None,
    margin: float = MARGIN,
) -> Between:
    """Between states (T, J) that are `seconds` apart, by a longest interval of 0.1 s."""
    reach = Reach.of(arm)
    stamps = np.round(np.arange(len(states)) * seconds * 1e9).astype(np.int64)
    return between_states(
        arm,
        reach,
        stamps,
        states,
        np.zeros_like(states) if velocities is None else velocities,
        clearances(arm, reach, states, lambda points: balls.query(points)[0]),
        lambda points: balls.query(points)[0],
        margin=margin,
        longest=0.1,
    )


def least_on_the_way(arm: PlanarArm | RobotModel, balls: Balls, states: Float64, num: int = 400) -> Float64:
    """(T - 1,) [m] by `num` samples of each straight motion."""
    reach = Reach.of(arm)
    share = np.linspace(0, 1, num)[:, None]
    ways = [a + share * (b - a) for a, b in pairwise(states)]
    return np.array([clearances(arm, reach, way, lambda points: balls.query(points)[0]).min() for way in ways])


def test_far_away_the_bound_is_that_of_both_ends() -> None:
    arm, balls = PlanarArm(), Balls([[0.2, 0.9, 0.0]], [0.05])
    states = np.array([[0.0, 0.3], [0.1, 0.25]])
    reach = Reach.of(arm)
    first, last = clearances(arm, reach, states, lambda points: balls.query(points)[0])
    expected = interval_bound(first, last, states[1] - states[0], reach.levers)
    assert expected < min(first.min(), last.min())
    assert bounds(arm, balls, states).lower == pytest.approx([expected], abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_no_motion_comes_nearer_than_its_bound(seed: int) -> None:
    generator = np.random.default_rng(seed)
    arm = PlanarArm()
    balls = Balls(
        np.c_[generator.uniform(-1, 1, (6, 2)), np.zeros(6)].tolist(), generator.uniform(0.01, 0.1, 6).tolist()
    )
    states = generator.uniform(-2, 2, (1, 2)) + np.cumsum(generator.uniform(-0.4, 0.4, (60, 2)), axis=0)
    found, truth = bounds(arm, balls, states), least_on_the_way(arm, balls, states)
    assert found.is_bounded.all()
    is_kept = found.lower >= MARGIN
    assert 5 < is_kept.sum() < 60
    assert (truth[is_kept] >= found.lower[is_kept] - 1e-9).all()
    assert (found.lower[truth < MARGIN] < MARGIN).all()
    assert not (found.lower[truth > MARGIN + 2e-3] < MARGIN).any()  # nor is a motion that keeps it refused


def test_the_sample_arm_keeps_its_bounds_among_balls(sample_arm: RobotModel) -> None:
    generator = np.random.default_rng(7)
    start = np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.0])
    balls = Balls(generator.uniform([0.2, -0.6, 0.1], [0.8, 0.6, 0.8], (8, 3)).tolist(), [0.04] * 8)
    states = start + np.cumsum(generator.uniform(-0.15, 0.15, (25, 7)), axis=0)
    found, truth = bounds(sample_arm, balls, states), least_on_the_way(sample_arm, balls, states, 200)
    is_kept = found.lower >= MARGIN
    assert (truth[is_kept] >= found.lower[is_kept] - 1e-9).all()
    assert (found.lower[truth < MARGIN] < MARGIN).all()
    assert is_kept.any() and (truth < MARGIN).any()


@pytest.fixture(scope="module")
def sample_arm(plain_arm: Path) -> RobotModel:
    tabletop = plain_arm / "tabletop"
    return RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml")


def test_a_contact_between_two_free_states_is_found() -> None:
    arm = PlanarArm()
    tip = arm.sphere_centers(np.array([0.0, 0.0]))[-1]
    balls, states = Balls([tip.tolist()], [0.005]), np.array([[-0.12, 0.0], [0.12, 0.0]])
    ends = clearances(arm, Reach.of(arm), states, lambda points: balls.query(points)[0])
    assert ends.min() > MARGIN
    found = bounds(arm, balls, states)
    assert found.is_bounded.all() and found.lower[0] < 0
    assert found.is_met.all() and found.lower[0] >= least_on_the_way(arm, balls, states, 401)[0] - 1e-12, "a witness"
    moving = bounds(arm, balls, states, velocities=np.array([[8.0, 0.0], [8.0, 0.0]]))  # more than the straight way
    assert moving.is_met.all() and moving.lower == pytest.approx(found.lower, abs=1e-12)
    far = Balls([[1.2, 0.0, 0.0]], [0.005])
    assert not bounds(arm, far, states).is_met.any()


def test_a_state_that_breaks_the_margin_settles_both_of_its_intervals() -> None:
    arm = PlanarArm()
    balls = Balls([[0.9, 0.06, 0.0]], [0.005])
    states = np.array([[-0.5, 0.0], [0.0, 0.0], [-0.5, 0.0], [-0.55, 0.0]])
    found = bounds(arm, balls, states)
    assert (found.lower[:2] < MARGIN).all() and found.lower[2] > MARGIN
    assert found.is_bounded.all()


@pytest.mark.parametrize(("seconds", "is_bounded"), [(0.1, True), (0.1000009, True), (0.12, True), (0.41, False)])
def test_a_long_gap_is_bounded_only_where_the_arm_cannot_reach(seconds: float, is_bounded: bool) -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.45, 0.0]], [0.05])
    states = np.zeros((2, 2))  # the tip may move 1.3 m/s by both joints
    assert bounds(arm, balls, states, seconds=seconds).is_bounded.tolist() == [is_bounded]


def test_a_gap_just_within_reach_of_the_margin_is_not_bounded() -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.45, 0.0]], [0.05])
    reach, states = Reach.of(arm), np.zeros((2, 2))
    gaps = clearances(arm, reach, states[:1], lambda points: balls.query(points)[0])[0]
    speeds = reach.levers @ reach.velocity_limit
    longest = float(np.min((gaps - MARGIN) / speeds * 2))  # there and back
    assert bounds(arm, balls, states, seconds=0.999 * longest).is_bounded.all()
    assert not bounds(arm, balls, states, seconds=1.001 * longest).is_bounded.any()


def test_a_gap_in_which_the_arm_moved_further_than_it_may_is_bounded_by_what_it_moved() -> None:
    arm, balls = PlanarArm(), Balls([[5.0, 0.0, 0.0]], [0.1])
    states = np.array([[-2.8, 0.0], [2.8, 0.0]])  # 5.6 rad in 0.2 s, limit 1.5 rad/s
    reach = Reach.of(arm)
    first, last = clearances(arm, reach, states, lambda points: balls.query(points)[0])
    expected = interval_bound(first, last, states[1] - states[0], reach.levers)
    assert bounds(arm, balls, states, seconds=0.2).lower[0] <= expected + 1e-12


def test_velocities_that_say_more_than_the_states_widen_the_bound() -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.3, 0.0]], [0.05])
    states = np.zeros((2, 2))
    fast = np.array([[1.0, 0.0], [1.0, 0.0]])
    still, moved = (bounds(arm, balls, states, velocities=v).lower[0] for v in (np.zeros((2, 2)), fast))
    assert still - moved == pytest.approx(0.5 * 0.9 * 0.05, abs=1e-9)  # half of lever times 0.05 rad
    assert bounds(arm, balls, states, velocities=np.full((2, 2), np.nan)).lower[0] == pytest.approx(still)
    assert bounds(arm, balls, states, velocities=-fast).lower[0] == pytest.approx(moved)


def test_velocities_can_break_a_margin_that_the_straight_motion_keeps() -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.13, 0.0]], [0.05])  # 40 mm from the tip
    states, fast = np.zeros((2, 2)), np.full((2, 2), [1.4, 0.0])
    assert bounds(arm, balls, states).lower[0] > MARGIN
    assert bounds(arm, balls, states, velocities=fast).lower[0] < MARGIN


def test_what_the_spheres_leave_uncovered_is_taken_off() -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.3, 0.0]], [0.05])
    states = np.zeros((2, 2))
    whole = bounds(arm, balls, states).lower[0]
    arm.sphere_deficit = np.array([0.5, 0.01, 0.01, 0.01, 0.01])  # the base does not move
    assert whole - bounds(arm, balls, states).lower[0] == pytest.approx(0.01)


def test_where_the_scene_has_no_distance_nothing_is_bounded() -> None:
    arm, states = PlanarArm(), np.zeros((2, 2))
    reach = Reach.of(arm)

    def blank(points: Float64) -> Float64:
        return np.full(len(points), np.nan)

    stamps = np.array([0, 50_000_000], np.int64)
    at_states = clearances(arm, reach, states, blank)
    found = between_states(
        arm, reach, stamps, states, np.zeros_like(states), at_states, blank, margin=MARGIN, longest=0.1
    )
    assert not found.is_bounded.any()

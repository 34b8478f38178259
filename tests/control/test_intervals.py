"""Bounds of the clearance between two states, against dense sampling and a plain reference."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.control.audit import Between, Reach, between_states, clearances
from splatctrl_cli.records import DistanceField, Float64
from splatctrl_cli.robot.model import RobotModel
from tests.control.fakes import Balls, Nowhere, PlanarArm, sample_arm
from tests.reference.intervals import interval_bound

MARGIN = 0.02
STILL = np.zeros((2, 2))


def bounds(
    arm: PlanarArm | RobotModel,
    field: DistanceField,
    states: Float64,
    *,
    seconds: float = 0.05,
    velocities: ArrayLike = 0.0,
) -> Between:
    """Between states (T, J) that are `seconds` apart, by a longest interval of 0.1 s."""
    reach = Reach.of(arm)
    stamps = np.round(np.arange(len(states)) * seconds * 1e9).astype(np.int64)
    moving = np.broadcast_to(np.asarray(velocities, np.float64), states.shape)
    at = gaps(arm, field, states)
    return between_states(
        arm, reach, stamps, states, moving, at, lambda points: field.query(points)[0], margin=MARGIN, longest=0.1
    )


def gaps(arm: PlanarArm | RobotModel, field: DistanceField, states: Float64) -> Float64:
    """(T, S) [m] of every sphere at every state."""
    return clearances(arm, Reach.of(arm), states, lambda points: field.query(points)[0])


def bound_of_ends(arm: PlanarArm, balls: Balls, states: Float64) -> float:
    """Reference bound between two states."""
    return interval_bound(*gaps(arm, balls, states), states[1] - states[0], Reach.of(arm).levers)


def least_on_the_way(arm: PlanarArm | RobotModel, balls: Balls, states: Float64, num: int = 400) -> Float64:
    """(T - 1,) [m] by `num` samples of each straight motion."""
    share = np.linspace(0, 1, num)[:, None]
    return np.array([gaps(arm, balls, a + share * (b - a)).min() for a, b in pairwise(states)])


def test_far_away_the_bound_is_that_of_both_ends() -> None:
    arm, balls, states = PlanarArm(), Balls([[0.2, 0.9, 0.0]], [0.05]), np.array([[0.0, 0.3], [0.1, 0.25]])
    expected = bound_of_ends(arm, balls, states)
    assert expected < gaps(arm, balls, states).min()
    assert bounds(arm, balls, states).lower == pytest.approx([expected], abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_no_motion_comes_nearer_than_its_bound(seed: int) -> None:
    generator, arm = np.random.default_rng(seed), PlanarArm()
    centers = np.c_[generator.uniform(-1, 1, (6, 2)), np.zeros(6)]
    balls = Balls(centers.tolist(), generator.uniform(0.01, 0.1, 6).tolist())
    states = generator.uniform(-2, 2, (1, 2)) + np.cumsum(generator.uniform(-0.4, 0.4, (60, 2)), axis=0)
    found, truth = bounds(arm, balls, states), least_on_the_way(arm, balls, states)
    assert found.is_bounded.all()
    is_kept = found.lower >= MARGIN
    assert 5 < is_kept.sum() < 60
    assert (truth[is_kept] >= found.lower[is_kept] - 1e-9).all()
    assert (found.lower[truth < MARGIN] < MARGIN).all()
    assert not (found.lower[truth > MARGIN + 2e-3] < MARGIN).any()  # nor is a motion that keeps it refused


def test_the_sample_arm_keeps_its_bounds_among_balls(plain_arm: Path) -> None:
    generator, arm = np.random.default_rng(7), sample_arm(plain_arm)
    balls = Balls(generator.uniform([0.2, -0.6, 0.1], [0.8, 0.6, 0.8], (8, 3)).tolist(), [0.04] * 8)
    start = np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.0])
    states = start + np.cumsum(generator.uniform(-0.15, 0.15, (25, 7)), axis=0)
    found, truth = bounds(arm, balls, states), least_on_the_way(arm, balls, states, 200)
    is_kept = found.lower >= MARGIN
    assert is_kept.any() and (truth < MARGIN).any()
    assert (truth[is_kept] >= found.lower[is_kept] - 1e-9).all()
    assert (found.lower[truth < MARGIN] < MARGIN).all()


def test_a_contact_between_two_free_states_is_found() -> None:
    arm, states = PlanarArm(), np.array([[-0.12, 0.0], [0.12, 0.0]])
    balls = Balls([arm.sphere_centers(np.zeros(2))[-1]], [0.005])
    assert gaps(arm, balls, states).min() > MARGIN
    found = bounds(arm, balls, states)
    assert found.is_bounded.all() and found.is_met.all() and found.lower[0] < 0
    assert found.lower[0] >= least_on_the_way(arm, balls, states, 401)[0] - 1e-12, "a witness"
    moving = bounds(arm, balls, states, velocities=[8.0, 0.0])  # more than the straight way
    assert moving.is_met.all() and moving.lower == pytest.approx(found.lower, abs=1e-12)
    assert not bounds(arm, Balls([[1.2, 0.0, 0.0]], [0.005]), states).is_met.any()


def test_a_state_that_breaks_the_margin_settles_both_of_its_intervals() -> None:
    states = np.array([[-0.5, 0.0], [0.0, 0.0], [-0.5, 0.0], [-0.55, 0.0]])
    found = bounds(PlanarArm(), Balls([[0.9, 0.06, 0.0]], [0.005]), states)
    assert (found.lower < MARGIN).tolist() == [True, True, False] and found.is_bounded.all()


@pytest.mark.parametrize(("seconds", "is_bounded"), [(0.1, True), (0.1000009, True), (0.12, True), (0.41, False)])
def test_a_long_gap_is_bounded_only_where_the_arm_cannot_reach(seconds: float, is_bounded: bool) -> None:
    """The tip may move 1.3 m/s by both joints."""
    found = bounds(PlanarArm(), Balls([[0.9, 0.45, 0.0]], [0.05]), STILL, seconds=seconds)
    assert found.is_bounded.tolist() == [is_bounded]


def test_a_gap_just_within_reach_of_the_margin_is_not_bounded() -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.45, 0.0]], [0.05])
    speeds = Reach.of(arm).levers @ Reach.of(arm).velocity_limit
    longest = float(np.min((gaps(arm, balls, STILL)[0] - MARGIN) / speeds * 2))  # there and back
    assert bounds(arm, balls, STILL, seconds=0.999 * longest).is_bounded.all()
    assert not bounds(arm, balls, STILL, seconds=1.001 * longest).is_bounded.any()


def test_a_gap_in_which_the_arm_moved_further_than_it_may_is_bounded_by_what_it_moved() -> None:
    arm, balls = PlanarArm(), Balls([[5.0, 0.0, 0.0]], [0.1])
    states = np.array([[-2.8, 0.0], [2.8, 0.0]])  # 5.6 rad in 0.2 s, limit 1.5 rad/s
    assert bounds(arm, balls, states, seconds=0.2).lower[0] <= bound_of_ends(arm, balls, states) + 1e-12


def test_velocities_that_say_more_than_the_states_widen_the_bound() -> None:
    arm, balls, fast = PlanarArm(), Balls([[0.9, 0.3, 0.0]], [0.05]), np.array([1.0, 0.0])
    still, unknown, moved, back = (
        bounds(arm, balls, STILL, velocities=v).lower[0] for v in (0.0, np.nan, fast, -fast)
    )
    assert still - moved == pytest.approx(0.5 * 0.9 * 0.05, abs=1e-9)  # half of lever times 0.05 rad
    assert (unknown, back) == (pytest.approx(still), pytest.approx(moved))
    near = Balls([[0.9, 0.13, 0.0]], [0.05])  # 40 mm from the tip: a margin that the straight motion keeps
    assert bounds(arm, near, STILL).lower[0] > MARGIN > bounds(arm, near, STILL, velocities=1.4 * fast).lower[0]


def test_what_the_spheres_leave_uncovered_is_taken_off() -> None:
    arm, balls = PlanarArm(), Balls([[0.9, 0.3, 0.0]], [0.05])
    whole = bounds(arm, balls, STILL).lower[0]
    arm.sphere_deficit = np.array([0.5, 0.01, 0.01, 0.01, 0.01])  # the base does not move
    assert whole - bounds(arm, balls, STILL).lower[0] == pytest.approx(0.01)


def test_where_the_scene_has_no_distance_nothing_is_bounded() -> None:
    assert not bounds(PlanarArm(), Nowhere(), STILL).is_bounded.any()

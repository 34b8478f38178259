"""Where a planner may go in our map: out of what no camera saw, beside its ends, and past the edges of things."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from experiments.problems import Problem, read_problem
from experiments.ways import Surroundings, beside_the_start, plain_ways
from splatctrl_cli.config import Config
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.planner.planned import resample
from splatctrl_cli.records import Bool, Float64, UInt8
from splatctrl_cli.voxels import OccupancyGrid, VoxelState

MARGIN = Config().control.margin
SHAPE = (90, 90, 90)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return read_problem("tabletop-0003", None)


def hand(problem: Problem, q: Float64) -> Float64:
    """(3,) [m] of the last sphere of the hand."""
    return problem.model.sphere_centers(q)[problem.model.moving_spheres][-1]


def surroundings(problem: Problem, balls: Float64, radius: float, states: UInt8 | None = None) -> Surroundings:
    if states is None:
        states = np.full(SHAPE, VoxelState.FREE, np.uint8)
    origin = hand(problem, problem.start) - 0.02 * np.array([45.0, 45.0, 45.0])
    return Surroundings(
        problem=problem,
        centers=np.asarray(balls, np.float32),
        radii=np.full(len(balls), radius, np.float32),
        num_known=len(balls),
        grid=OccupancyGrid.from_states(origin, 0.02, states),
        config=Config(),
    )


def test_what_reaches_into_the_arm_at_its_start_is_the_arms_own(problem: Problem) -> None:
    here = hand(problem, problem.start)
    balls = np.stack([here, here + np.array([0.0, 0.0, 0.4])]).astype(np.float32)
    centers, radii = beside_the_start(problem, balls, np.full(2, 0.01, np.float32))
    np.testing.assert_array_equal(centers, balls[1:])
    assert len(radii) == 1


def test_a_ball_yields_to_the_goal_as_far_as_its_centre_and_no_farther(problem: Problem) -> None:
    model, goal = problem.model, problem.goal
    moving, radii = model.sphere_centers(goal)[model.moving_spheres], model.sphere_set.radii[model.moving_spheres]
    out = moving[-1] - moving.mean(axis=0)
    out /= np.linalg.norm(out)
    for gap, is_free in ((0.005, True), (-0.005, False)):
        ball = moving[-1] + out * (radii[-1] + gap)
        assert np.min(np.linalg.norm(moving - ball, axis=1) - radii) == pytest.approx(gap, abs=1e-4)
        distance = surroundings(problem, ball[None], 0.02).things(MARGIN)
        assert (np.min(distance(moving) - radii) >= MARGIN) == is_free
        assert distance(ball[None] + out)[0] >= 1.0 - 0.02 - 1e-5  # and no ball grows


def test_things_are_thin_where_there_is_no_other_way(problem: Problem) -> None:
    far = hand(problem, problem.start) + np.array([[0.0, 0.0, 0.4], [0.0, 0.0, 0.6]])
    ways = list(replace(surroundings(problem, far, 0.02), num_known=1).ways())  # the second is a lost edge
    found = [way.scene.distance(far) for way in ways]  # type: ignore[attr-defined]
    np.testing.assert_allclose(found, [[-0.02, -0.02]] * 2 + [[-0.008, -0.01]] * 2, atol=1e-5)


def test_unseen_voxels_are_balls_but_beside_the_arms_start_and_goal(problem: Problem) -> None:
    states = np.full(SHAPE, VoxelState.FREE, np.uint8)
    states[45, 45, 45] = states[45, 45, 85] = VoxelState.NEVER_SEEN  # in the hand, and 80 cm above it
    here = hand(problem, problem.start)
    above = here + np.array([0.0, 0.0, 0.8])
    around = surroundings(problem, above[None] + [0.0, 0.0, 0.07], 0.01, states)
    assert around.unseen is not None and around.unseen_behind is None  # 7 cm from a surface is not behind it
    found = around.unseen(np.array([above, above - [0.0, 0.0, 0.1], here]))
    np.testing.assert_allclose(found, [-0.01, 0.09, 0.79], atol=1e-5)
    behind = surroundings(problem, above[None] + [0.0, 0.0, 0.05], 0.01, states).unseen_behind
    assert behind is not None
    np.testing.assert_allclose(behind(above[None]), [-0.01], atol=1e-5)
    assert surroundings(problem, above[None], 0.01).unseen is None


def test_the_ways_give_up_the_margin_before_known_space_and_that_before_the_rest(problem: Problem) -> None:
    states = np.full(SHAPE, VoxelState.FREE, np.uint8)
    states[45, 45, 85] = VoxelState.NEVER_SEEN
    above = hand(problem, problem.start) + np.array([0.0, 0.0, 0.8])
    ways = list(surroundings(problem, above[None] + [0.0, 0.0, 0.05], 0.01, states).ways())
    assert [way.in_known_space for way in ways] == [True] * 2 + [False] * 6
    assert np.allclose([way.margin / MARGIN for way in ways], [1, 0.4, 1, 0.4, 1, 0.4, 0.4, 0.15])
    reached = [way.scene.distance(above[None])[0] for way in ways]  # type: ignore[attr-defined]
    assert all(value < 0 for value in reached[:4]) and all(value > 0 for value in reached[4:])
    plain = [way.margin for way in plain_ways(problem.solids, Config())]
    assert plain[0] == MARGIN and all(a > b for a, b in pairwise(plain))


def test_unseen_space_that_a_motion_comes_to_is_counted_but_where_the_arm_begins_and_ends(problem: Problem) -> None:
    far = hand(problem, problem.start) + np.array([[0.0, 0.0, 0.4]])
    around = surroundings(problem, far, 0.01, np.full(SHAPE, VoxelState.NEVER_SEEN, np.uint8))
    position = np.stack([problem.start, problem.goal])
    assert around.unseen_on(np.stack([problem.start, problem.start])) == 0.0
    cells = np.argwhere(np.ones(SHAPE, bool)) * 0.02 + around.grid.origin
    moving, radii = problem.model.moving_spheres, problem.model.sphere_set.radii

    def held(postures: Float64) -> Bool:
        balls = problem.model.sphere_centers_batch(postures)[:, moving].reshape(-1, 3)
        return SphereField(Spheres.of(balls, np.tile(radii[moving], len(postures)))).query(cells)[0] < 0

    expected = 0.02**3 * np.sum(held(resample(position, 0.02)) & ~held(position))
    assert expected > 0.005 and around.unseen_on(position) == pytest.approx(expected, rel=0.15)
    assert surroundings(problem, far, 0.01).unseen_on(position) == 0.0

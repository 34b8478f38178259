"""Planned ways out of local minima, followed by the controller on the planar arm."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.goals import Detour
from splatctrl_cli.control.replay import Outcome, ReplayTask, closed_loop
from splatctrl_cli.planner.path import timed
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm

ARM = PlanarArm()
CONFIG = ControlConfig(goal_position=0.005, goal_rotation=0.01, max_detours=1, solver="daqp")
START, END = np.array([0.2, 0.3]), np.array([1.6, 0.3])
FOLDED, BEYOND = -2.3, 2.6  # [rad] of the elbow, the tip then far inside, and of the shoulder, where it unfolds
BEAM = Balls([[r * np.cos(1.15), r * np.sin(1.15), 0.0] for r in (0.64, 0.72, 0.8, 0.88, 0.96)], [0.04] * 5)
TASK = ReplayTask(start=START, T_world_goal=ARM.frame_pose(END, "tip"), frame="tip", home=END)


def folded_way(q: Float64, wait_distance: float = 0.05) -> Detour:
    """Fold, turn past the goal, unfold, turn back."""
    waypoints = np.array([q, [q[0], FOLDED], [BEYOND, FOLDED], [BEYOND, END[1]], END])
    return Detour(path=timed(waypoints, 0.5 * ARM.velocity_limit, 5.0), wait_distance=wait_distance)


def test_an_arm_that_stalls_goes_on_by_the_planned_way() -> None:
    asked = []

    def plan(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour:
        asked.append((stamp_ns, q, T_world_goal))
        return folded_way(q)

    alone = closed_loop(ARM, CONFIG, TASK, lambda _: BEAM)
    assert alone.outcome is Outcome.STALLED and alone.detours == ()
    trace = closed_loop(ARM, CONFIG, TASK, lambda _: BEAM, plan_detour=plan)
    assert trace.outcome is Outcome.GOAL_REACHED
    (stamp, q, goal), (index,) = asked[0], trace.detours
    assert index == len(alone.steps) - 1 and trace.stamp_ns[index] == stamp
    np.testing.assert_array_equal(trace.position[index], q)
    np.testing.assert_array_equal(goal, TASK.T_world_goal)
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - 1e-3
    assert np.min(trace.position[:, 1]) < 0.9 * FOLDED


@pytest.mark.parametrize("ways", [0, 2])
def test_no_more_ways_are_planned_than_allowed(ways: int) -> None:
    num_asked = 0

    def blocked(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour:
        """A way straight through the beam."""
        nonlocal num_asked
        num_asked += 1
        return Detour(path=timed(np.array([q, END]), ARM.velocity_limit, 5.0), wait_distance=0.05)

    config = replace(CONFIG, max_detours=ways)
    trace = closed_loop(ARM, config, TASK, lambda _: BEAM, plan_detour=blocked)
    assert trace.outcome is Outcome.STALLED
    assert num_asked == len(trace.detours) == ways
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - 1e-3


def test_an_arm_without_a_way_stays_stalled() -> None:
    trace = closed_loop(ARM, CONFIG, TASK, lambda _: BEAM, plan_detour=lambda *_: None)
    assert trace.outcome is Outcome.STALLED and trace.detours == ()


def test_the_goal_on_the_way_waits_for_an_arm_that_is_behind() -> None:
    detour = folded_way(START)
    detour.advance(0.1, np.array([0.06, 0, 0, 0, 0, 0]))
    assert detour.clock == 0
    detour.advance(0.1, np.array([0.04, 0, 0, 0.5, 0, 0]))
    assert detour.clock == pytest.approx(0.1)
    detour.advance(1e3, np.zeros(6))
    assert detour.is_over


def test_the_goal_on_the_way_moves_as_the_path_does() -> None:
    detour, dt = folded_way(START), 1e-6
    detour.clock = 0.3
    pose, guide = detour.goal(ARM, "tip")
    np.testing.assert_allclose(guide.posture, detour.path.at(0.3)[0][0])
    later = folded_way(START)
    later.clock = 0.3 + dt
    moved = (later.goal(ARM, "tip")[0][:3, 3] - pose[:3, 3]) / dt
    np.testing.assert_allclose(guide.twist[:3], moved, atol=1e-5)
    np.testing.assert_allclose(guide.velocity, (later.path.at(0.3 + dt)[0][0] - guide.posture) / dt, atol=1e-5)

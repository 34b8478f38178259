"""The closed loop, on the planar arm and on the seven-joint arm of the sample data; and the planned ways out where it
stalls.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.goals import Detour
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTask, Waypoint, _Course, closed_loop
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.planner.planned import time_path
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm, far_away, num_on_rung, sample_arm
from tests.refused import expect_refusal

CONFIG = ControlConfig(goal_position=0.002, goal_rotation=0.002)
NOTHING_NEAR = far_away()
START, END = np.array([0.2, 0.3]), np.array([1.0, 0.8])


def task(start: Float64 = START, end: Float64 = END, **changes: object) -> ReplayTask:
    T = PlanarArm().frame_pose(end, "tip")
    return replace(ReplayTask(start=start, T_world_goal=T, frame="tip", home=end), **changes)  # type: ignore[arg-type]


def test_a_free_arm_reaches_its_goal_with_every_program_solved() -> None:
    trace = closed_loop(PlanarArm(), CONFIG, task(), lambda _: NOTHING_NEAR)
    assert trace.outcome is Outcome.GOAL_REACHED
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    np.testing.assert_allclose(trace.position[-1], END, atol=0.02)
    assert np.all(np.abs(np.diff(trace.position, axis=0)) <= 1.5 * CONFIG.period + 1e-9)
    assert np.all(np.diff(trace.stamp_ns) == 10_000_000)


@pytest.mark.parametrize(
    ("end", "max_time", "outcome", "num"), [(START, 9.0, Outcome.GOAL_REACHED, 1), (END, 0.05, Outcome.TIMEOUT, 5)]
)
def test_a_run_ends_at_the_goal_or_with_its_time(end: Float64, max_time: float, outcome: Outcome, num: int) -> None:
    trace = closed_loop(PlanarArm(), replace(CONFIG, max_time=max_time), task(end=end), lambda _: NOTHING_NEAR)
    assert trace.outcome is outcome and len(trace.steps) == num


def test_a_scene_that_changes_on_the_way_changes_the_rows() -> None:
    late = Balls([[0.22, 0.44, 0.0]], [0.1])
    fields = (NOTHING_NEAR, late)
    trace = closed_loop(PlanarArm(), CONFIG, task(end=np.array([2.0, 0.3])), lambda t: fields[t >= 500_000_000])
    assert trace.steps[49].clearance > 40 and trace.steps[50].clearance < 1
    assert trace.outcome is Outcome.STALLED and trace.steps[-1].intervening
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - 1e-3


def test_rows_are_relaxed_where_an_obstacle_appears_in_the_arm() -> None:
    fields = (NOTHING_NEAR, Balls([PlanarArm().sphere_centers(START)[4]], [0.3]))
    trace = closed_loop(PlanarArm(), CONFIG, task(end=START + 1), lambda t: fields[t >= 10_000_000])
    assert trace.steps[1].rung is Rung.RELAXED


def test_the_seven_joint_arm_passes_a_sphere_and_keeps_its_distance(plain_arm: Path) -> None:
    arm, config, ball = sample_arm(plain_arm), ControlConfig(), Balls([[0.5, 0.0, 0.3]], [0.08])
    frame = arm.frame_names[-1]
    start, end = np.array([0.6, 0.3, 0, -1.8, 0, 2.1, 0.78]), np.array([-0.6, 0.3, 0, -1.8, 0, 2.1, 0.78])
    sevenfold = ReplayTask(start=start, T_world_goal=arm.frame_pose(end, frame), frame=frame)
    trace = closed_loop(arm, config, sevenfold, lambda _: ball)
    assert trace.outcome is Outcome.GOAL_REACHED
    assert min(step.clearance for step in trace.steps) >= config.margin - 1e-3
    assert {step.rung for step in trace.steps} <= {Rung.SOLVED, Rung.RELAXED}
    assert any("[" in name for step in trace.steps for name in step.intervening)
    assert max(step.residual for step in trace.steps) <= config.max_residual
    again = closed_loop(arm, replace(config, max_time=0.5), sevenfold, lambda _: ball)
    assert again.position.tobytes() == trace.position[: len(again.position)].tobytes()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"T_world_goal": pose_at([2.0, 0, 0])}, r"goal: expected within 0.900 m of the base, got \(2.000, 0.000, 0"),
        ({"T_world_goal": np.full((4, 4), np.nan)}, "finite pose"),
        ({"start": np.array([0.0, 2.7])}, r"joint elbow: expected within \[-2.6000, 2.6000\] rad, got 2.7000"),
    ],
)
def test_a_task_that_cannot_be_is_refused(changes: dict[str, Float64], words: str) -> None:
    expect_refusal(words, closed_loop, PlanarArm(), CONFIG, task(**changes), lambda _: NOTHING_NEAR)


ARM = PlanarArm()
WITH_DETOURS = ControlConfig(goal_position=0.005, goal_rotation=0.01, max_detours=1, solver="daqp")
BEFORE_WALL, BEHIND_WALL = np.array([0.2, 0.3]), np.array([1.6, 0.3])
FOLDED, BEYOND = -2.3, 2.6  # [rad] of the elbow, the tip then far inside, and of the shoulder, where it unfolds
BEAM = Balls([[r * np.cos(1.15), r * np.sin(1.15), 0.0] for r in (0.64, 0.72, 0.8, 0.88, 0.96)], [0.04] * 5)
TASK = ReplayTask(start=BEFORE_WALL, T_world_goal=ARM.frame_pose(BEHIND_WALL, "tip"), frame="tip", home=BEHIND_WALL)


def folded_way(q: Float64, wait_distance: float = 0.05) -> Detour:
    """Fold, turn past the goal, unfold, turn back."""
    waypoints = np.array([q, [q[0], FOLDED], [BEYOND, FOLDED], [BEYOND, BEHIND_WALL[1]], BEHIND_WALL])
    return Detour(path=time_path(waypoints, 0.5 * ARM.velocity_limit, 5.0), wait_distance=wait_distance)


def test_an_arm_that_stalls_goes_on_by_the_planned_way() -> None:
    asked = []

    def plan(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour:
        asked.append((stamp_ns, q, T_world_goal))
        return folded_way(q)

    alone = closed_loop(ARM, WITH_DETOURS, TASK, lambda _: BEAM, plan_detour=lambda *_: None)
    assert alone.outcome is Outcome.STALLED and alone.detours == ()
    trace = closed_loop(ARM, WITH_DETOURS, TASK, lambda _: BEAM, plan_detour=plan)
    assert trace.outcome is Outcome.GOAL_REACHED
    (stamp, q, goal), (index,) = asked[0], trace.detours
    assert index == len(alone.steps) - 1 and trace.stamp_ns[index] == stamp
    np.testing.assert_array_equal(trace.position[index], q)
    np.testing.assert_array_equal(goal, TASK.T_world_goal)
    assert min(step.clearance for step in trace.steps) >= WITH_DETOURS.margin - 1e-3
    assert np.min(trace.position[:, 1]) < 0.9 * FOLDED


def test_a_waypoint_that_is_reached_begins_the_time_of_a_stall_anew() -> None:
    config, still = ControlConfig(), np.array([0.3, 0.4])
    num_back = round(config.stall_time / config.period)
    via = (Waypoint(T_world_goal=ARM.frame_pose(still, "tip"), posture=None),)
    course = _Course(ARM, config, replace(TASK, via=via), None)
    assert not any(course.has_stalled(0, index, still) for index in range(num_back))
    assert not course.has_ended(0, num_back, cast("ControlStep", SimpleNamespace(pose_error=np.zeros(6))))
    assert not any(course.has_stalled(0, num_back + index, still) for index in range(num_back))
    assert course.has_stalled(0, 2 * num_back, still)


@pytest.mark.parametrize("ways", [0, 2])
def test_no_more_ways_are_planned_than_allowed(ways: int) -> None:
    """Each leads straight through the beam."""
    asked: list[int] = []

    def blocked(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour:
        asked.append(stamp_ns)
        return Detour(path=time_path(np.array([q, BEHIND_WALL]), ARM.velocity_limit, 5.0), wait_distance=0.05)

    config = replace(WITH_DETOURS, max_detours=ways)
    trace = closed_loop(ARM, config, TASK, lambda _: BEAM, plan_detour=blocked)
    assert trace.outcome is Outcome.STALLED and len(asked) == len(trace.detours) == ways
    assert min(step.clearance for step in trace.steps) >= WITH_DETOURS.margin - 1e-3


def test_the_goal_on_the_way_waits_for_an_arm_that_is_behind() -> None:
    detour = folded_way(BEFORE_WALL)
    for seconds, error, clock in ((0.1, [0.06, 0, 0, 0, 0, 0], 0.0), (0.1, [0.04, 0, 0, 0.5, 0, 0], 0.1)):
        detour.advance(seconds, np.array(error))
        assert detour.clock == pytest.approx(clock)
    detour.advance(1e3, np.zeros(6))
    assert detour.is_over


def test_the_goal_on_the_way_moves_as_the_path_does() -> None:
    detour, later, dt = folded_way(BEFORE_WALL), folded_way(BEFORE_WALL), 1e-6
    detour.clock, later.clock = 0.3, 0.3 + dt
    (pose, guide), (pose_later, guide_later) = detour.goal(ARM, "tip"), later.goal(ARM, "tip")
    np.testing.assert_allclose(guide.posture, detour.path.at(0.3)[0][0])
    np.testing.assert_allclose(guide.twist[:3], (pose_later - pose)[:3, 3] / dt, atol=1e-5)
    np.testing.assert_allclose(guide.velocity, (guide_later.posture - guide.posture) / dt, atol=1e-5)

"""The closed loop, on the planar arm and on the seven-joint arm of the sample data."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTask, closed_loop, num_on_rung
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from tests.control.fakes import Balls, PlanarArm, far_away

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


def test_a_start_at_the_goal_takes_one_step() -> None:
    trace = closed_loop(PlanarArm(), CONFIG, task(end=START), lambda _: NOTHING_NEAR)
    assert trace.outcome is Outcome.GOAL_REACHED and len(trace.steps) == 1


def test_an_obstacle_the_arm_cannot_pass_stalls_it_outside_the_margin() -> None:
    wall = Balls([[0.22, 0.44, 0.0]], [0.1])
    trace = closed_loop(PlanarArm(), CONFIG, task(end=np.array([2.0, 0.3])), lambda _: wall)
    assert trace.outcome is Outcome.STALLED
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - 1e-3
    assert trace.steps[-1].intervening


def test_the_time_limit_ends_a_run_that_does_not() -> None:
    trace = closed_loop(PlanarArm(), replace(CONFIG, max_time=0.05), task(), lambda _: NOTHING_NEAR)
    assert trace.outcome is Outcome.TIMEOUT and len(trace.steps) == 5


def test_a_scene_that_changes_on_the_way_changes_the_rows() -> None:
    late = Balls([[0.22, 0.44, 0.0]], [0.1])
    fields = (NOTHING_NEAR, late)
    trace = closed_loop(PlanarArm(), CONFIG, task(end=np.array([2.0, 0.3])), lambda t: fields[t >= 500_000_000])
    assert trace.steps[49].clearance > 40 and trace.steps[50].clearance < 1
    (change,) = trace.scene_changes
    assert change.stamp_ns == 500_000_000 and not change.is_hit
    assert change.before > 40 and change.after == trace.steps[50].clearance
    assert trace.outcome is Outcome.STALLED


def test_an_obstacle_that_appears_in_the_arm_is_a_hit_of_the_scene_and_not_of_the_controller() -> None:
    fields = (NOTHING_NEAR, Balls([PlanarArm().sphere_centers(START)[4]], [0.3]))
    trace = closed_loop(PlanarArm(), CONFIG, task(end=START + 1), lambda t: fields[t >= 10_000_000])
    assert trace.scene_changes[0].is_hit
    assert trace.steps[1].rung is Rung.RELAXED


def test_the_seven_joint_arm_passes_a_sphere_and_keeps_its_distance(sample_data: Path) -> None:
    arm = RobotModel.from_urdf(
        sample_data / "tabletop" / "robot.urdf", sample_data / "tabletop" / "robot_spheres.yaml"
    )
    frame = arm.frame_names[-1]
    start, end = np.array([0.6, 0.3, 0, -1.8, 0, 2.1, 0.78]), np.array([-0.6, 0.3, 0, -1.8, 0, 2.1, 0.78])
    ball = Balls([[0.5, 0.0, 0.3]], [0.08])
    sevenfold = ReplayTask(start=start, T_world_goal=arm.frame_pose(end, frame), frame=frame)
    trace = closed_loop(arm, ControlConfig(), sevenfold, lambda _: ball)
    assert trace.outcome is Outcome.GOAL_REACHED
    assert min(step.clearance for step in trace.steps) >= ControlConfig().margin - 1e-3
    assert {step.rung for step in trace.steps} <= {Rung.SOLVED, Rung.RELAXED}
    assert any("[" in name for step in trace.steps for name in step.intervening)
    assert max(step.residual for step in trace.steps) <= ControlConfig().max_residual
    again = closed_loop(arm, ControlConfig(), sevenfold, lambda _: ball)
    assert again.position.tobytes() == trace.position.tobytes()


def test_a_goal_out_of_reach_is_refused() -> None:
    far = np.eye(4)
    far[:3, 3] = [2.0, 0, 0]
    with pytest.raises(InputError, match=r"goal: expected within 0.900 m of the base, got \(2.000, 0.000, 0.000\)"):
        closed_loop(PlanarArm(), CONFIG, task(T_world_goal=far), lambda _: NOTHING_NEAR)
    with pytest.raises(InputError, match="finite pose"):
        closed_loop(PlanarArm(), CONFIG, task(T_world_goal=np.full((4, 4), np.nan)), lambda _: NOTHING_NEAR)


def test_a_start_in_collision_names_the_sphere_and_the_depth() -> None:
    tip = PlanarArm().sphere_centers(START)[4]
    with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0.0700 m deep"):
        closed_loop(PlanarArm(), CONFIG, task(), lambda _: Balls([tip], [0.03]))


def test_a_start_outside_the_limits_names_the_joint() -> None:
    with pytest.raises(InputError, match=r"joint elbow: expected within \[-2.6000, 2.6000\] rad, got 2.7000"):
        closed_loop(PlanarArm(), CONFIG, task(start=np.array([0.0, 2.7])), lambda _: NOTHING_NEAR)


def test_a_period_of_zero_is_refused() -> None:
    with pytest.raises(UsageError, match=r"control\.period"):
        closed_loop(PlanarArm(), replace(CONFIG, period=0.0), task(), lambda _: NOTHING_NEAR)


def test_a_panda_with_a_public_sphere_set_passes_a_sphere_too(real_data: Path) -> None:
    arm = RobotModel.from_urdf(real_data / "vamp_panda" / "resources" / "panda" / "panda_spherized.urdf")
    start = np.array([0.6, 0.3, 0, -1.8, 0, 2.1, 0.78])
    goal = arm.frame_pose(start * [-1, 1, 1, 1, 1, 1, 1], "panda_hand")
    ball = Balls([[0.5, 0.0, 0.35]], [0.08])
    panda = ReplayTask(start=start, T_world_goal=goal, frame="panda_hand")
    trace = closed_loop(arm, ControlConfig(), panda, lambda _: ball)
    assert trace.outcome is Outcome.GOAL_REACHED
    assert num_on_rung(trace, Rung.SOLVED) == len(trace.steps)
    assert min(step.clearance for step in trace.steps) >= ControlConfig().margin - 1e-3

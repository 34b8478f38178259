"""Open loop on the planar arm: the command beside the logged velocity."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.control.open_loop import OpenLoopTask, OpenLoopTrace, is_shaped, open_loop
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import DistanceField, Float64
from tests.control.fakes import PlanarArm, Plane, far_away

CONFIG = ControlConfig()
START, END = np.array([0.6, 0.5]), np.array([0.1, 0.3])
FOLLOW = OpenLoopTask(frame="tip")
WALL = Plane([-1.0, 0.0, 0.0], -0.90)  # free where x < 0.90: the last of the motion is inside the margin


def motion(start: Float64 = START, end: Float64 = END, num: int = 21) -> LoggedMotion:
    """One second from `start` to `end` in a straight line."""
    share = np.linspace(0, 1, num)[:, None]
    stamps = np.round(np.linspace(0, 1e9, num)).astype(np.int64)
    return LoggedMotion(
        stamp_ns=stamps, position=start + share * (end - start), velocity=np.tile(end - start, (num, 1))
    )


def run(field: DistanceField, task: OpenLoopTask = FOLLOW, config: ControlConfig = CONFIG) -> OpenLoopTrace:
    asked = motion()
    return open_loop(PlanarArm(), config, asked, task, lambda _: field, has_distance=np.ones(21, np.bool_))


def test_what_was_logged_is_what_is_commanded_where_nothing_is_near() -> None:
    trace = run(far_away())
    np.testing.assert_allclose(trace.difference, 0.0, atol=1e-6)
    assert not any(is_shaped(step) for step in trace.steps)
    assert all(margin is not None and margin.barrier > 1 for margin in trace.margins)


def test_a_wall_shapes_the_command_where_the_logged_velocity_breaks_its_row() -> None:
    trace = run(WALL)
    is_broken = np.array([margin is not None and margin.barrier < -1e-3 for margin in trace.margins])
    has_shaped = np.array([is_shaped(step, RowKind.SCENE) for step in trace.steps])
    assert 0 < is_broken.sum() < 21 and np.all(has_shaped[is_broken])
    clear = np.array([margin is not None and margin.barrier > 1e-3 for margin in trace.margins])
    assert clear.any() and not has_shaped[clear].any()
    assert np.abs(trace.difference[clear]).max() < 1e-5 < np.abs(trace.difference[is_broken]).max()
    assert trace.margins[-1] is not None and trace.margins[-1].barrier_row == "fore[1]"


def test_a_goal_is_asked_for_at_every_state_alike() -> None:
    arm = PlanarArm()
    trace = run(far_away(), OpenLoopTask(frame="tip", T_world_goal=arm.frame_pose(START, "tip"), home=START))
    assert np.linalg.norm(trace.commanded[0]) < 1e-6
    assert np.all(np.sum(trace.commanded[1:] * (START - motion().position[1:]), axis=1) > 0)


def test_a_state_without_a_distance_has_no_command() -> None:
    has_distance = np.arange(21) != 3
    trace = open_loop(PlanarArm(), CONFIG, motion(), FOLLOW, lambda _: WALL, has_distance=has_distance)
    assert trace.steps[3] is None and trace.margins[3] is None and not is_shaped(trace.steps[3])
    assert np.isnan(trace.commanded[3]).all() and np.isfinite(trace.commanded[has_distance]).all()


def test_each_state_is_asked_in_the_field_of_its_time() -> None:
    fields = (far_away(), WALL)
    trace = open_loop(
        PlanarArm(), CONFIG, motion(), FOLLOW, lambda t: fields[t >= 500_000_000], has_distance=np.ones(21, np.bool_)
    )
    clearances = [step.clearance for step in trace.steps if step is not None]
    assert min(clearances[:10]) > 40 and max(clearances[10:]) < 1


def test_a_logged_velocity_above_the_limit_is_named() -> None:
    fast = replace(motion(), velocity=np.tile([0.0, -1.8], (21, 1)))
    trace = open_loop(PlanarArm(), CONFIG, fast, FOLLOW, lambda _: far_away(), has_distance=np.ones(21, np.bool_))
    assert trace.margins[0] is not None and trace.margins[0].limit_row == "elbow lowest"
    assert trace.margins[0].limit == pytest.approx(-0.3)
    assert all(is_shaped(step, RowKind.LIMIT) and not is_shaped(step, RowKind.SCENE) for step in trace.steps)


def test_a_logged_motion_is_linear_between_states_and_at_rest_after_the_last() -> None:
    logged = motion(num=3)
    position, velocity = logged.at(250_000_000)
    np.testing.assert_allclose(position, 0.75 * START + 0.25 * END)
    np.testing.assert_allclose(velocity, END - START)
    np.testing.assert_array_equal(logged.at(500_000_000)[0], logged.position[1])
    np.testing.assert_array_equal(logged.at(-5)[0], START)
    np.testing.assert_array_equal(logged.at(2_000_000_000)[0], logged.position[2])
    assert not logged.at(2_000_000_000)[1].any()


def test_a_guide_carries_the_frame_as_the_log_did() -> None:
    arm, logged = PlanarArm(), motion()
    _, guide = logged.goal_at(arm, "tip", 300_000_000)
    q, v = logged.at(300_000_000)
    step = (arm.frame_pose(q + 1e-6 * v, "tip") - arm.frame_pose(q - 1e-6 * v, "tip"))[:3, 3] / 2e-6
    np.testing.assert_allclose(guide.twist[:3], step, atol=1e-8)
    assert guide.twist[5] == pytest.approx(v.sum())

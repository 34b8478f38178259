"""Open loop on the planar arm: the command beside the logged velocity, and what logged twists ask for."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.goals import LoggedMotion, TwistTrack
from splatctrl_cli.control.open_loop import OpenLoopTask, OpenLoopTrace, is_shaped, open_loop
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
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


FLAT_CONFIG = replace(ControlConfig(), weight_angular=1e-6)  # two joints reach for two of six dimensions
SECOND = 1_000_000_000
BENT = np.array([0.3, 0.9])
NOTHING_NEAR = far_away()


def track(twist: list[float], *, until_s: float = 1.0, every_s: float = 0.1, axes: str | None = None) -> TwistTrack:
    """A constant twist from 0 to `until_s`."""
    stamps = np.round(np.arange(0, until_s, every_s) * SECOND).astype(np.int64)
    return TwistTrack(stamp_ns=stamps, twist=np.tile(twist, (len(stamps), 1)), axes=axes)


def driven(twists: TwistTrack, end_s: float = 1.0) -> ReplayTrace:
    arm = PlanarArm()
    task = ReplayTask(
        start=BENT,
        T_world_goal=arm.frame_pose(BENT, "tip"),
        frame="tip",
        twists=twists,
        end_ns=round(end_s * SECOND),
    )
    return closed_loop(arm, FLAT_CONFIG, task, lambda _: NOTHING_NEAR)


def tip(q: Float64) -> Float64:
    return PlanarArm().frame_pose(q, "tip")[:3, 3]


def test_the_newest_twist_not_later_holds_until_the_time_out() -> None:
    stamps = np.array([SECOND, 2 * SECOND])
    found = TwistTrack(stamp_ns=stamps, twist=np.array([np.full(6, 1.0), np.full(6, 2.0)]))
    asked = [found.at(round(s * SECOND), 0.5)[0] for s in (0.9, 1.0, 1.5, 1.51, 1.999, 2.0, 2.5, 2.6)]
    assert asked == [0, 1, 1, 0, 0, 2, 2, 0]
    assert found.is_known(np.array([0, SECOND, round(1.6 * SECOND)]), 0.5).tolist() == [False, True, False]


def test_the_tip_moves_with_the_twist_and_stands_still_when_it_times_out() -> None:
    trace = driven(track([-0.1, 0.05, 0, 0, 0, 0]), end_s=2.0)
    assert trace.outcome is Outcome.LOG_ENDED and len(trace.steps) == 201
    at_time_out = 141  # the last twist is of 0.9 s and holds 0.5 s
    np.testing.assert_allclose(tip(trace.position[at_time_out]) - tip(BENT), [-0.141, 0.0705, 0], atol=3e-3)
    np.testing.assert_allclose(trace.position[at_time_out:] - trace.position[at_time_out], 0, atol=1e-6)
    assert all(not step.pose_error.any() for step in trace.steps)


def test_a_twist_faster_than_allowed_is_capped_and_keeps_its_direction() -> None:
    fast = track([3.0, 4.0, 0, 0, 0, 9.0])
    reference = fast.reference(PlanarArm(), FLAT_CONFIG, BENT, 0)
    np.testing.assert_allclose(reference[:3], FLAT_CONFIG.max_linear_speed * np.array([0.6, 0.8, 0]))
    np.testing.assert_allclose(reference[3:], [0, 0, FLAT_CONFIG.max_angular_speed])


def test_axes_of_a_link_turn_with_it() -> None:
    body = track([0.1, 0, 0, 0, 0, 0.2], axes="tip")
    R = PlanarArm().frame_pose(BENT, "tip")[:3, :3]
    np.testing.assert_allclose(body.reference(PlanarArm(), FLAT_CONFIG, BENT, 0)[:3], R @ [0.1, 0, 0], atol=1e-12)
    along = track([0.0, 0.05, 0, 0, 0, 0], axes="tip")
    trace = driven(along)
    for q, step in zip(trace.position[::20], trace.steps[::20], strict=True):
        velocity = PlanarArm().frame_jacobian(q, "tip")[:3] @ step.velocity
        expected = PlanarArm().frame_pose(q, "tip")[:3, :3] @ [0, 0.05, 0]
        np.testing.assert_allclose(velocity, expected, atol=2e-3)


def test_angular_twists_turn_with_the_link_too() -> None:
    """The link's x axis is the world's y, its y the world's z."""
    R = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])

    class Turned(PlanarArm):
        def frame_pose(self, q: Float64, frame: str) -> Float64:
            T = np.eye(4)
            T[:3, :3] = R
            return T

    found = track([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], axes="tip").asked(Turned(), BENT, 0, 0.5)
    np.testing.assert_allclose(found, [0.3, 0.1, 0.2, 0.6, 0.4, 0.5])


@pytest.mark.parametrize("asked", [[-0.1, 0.0, 0, 0, 0, 0], [0.0, 0.1, 0, 0, 0, 0]])
def test_open_loop_asks_for_the_twist_and_not_for_what_was_done(asked: list[float]) -> None:
    num = 5
    motion = LoggedMotion(
        stamp_ns=np.arange(num) * SECOND // 10, position=np.tile(BENT, (num, 1)), velocity=np.ones((num, 2))
    )
    task = OpenLoopTask(frame="tip", twists=track(asked))
    has_distance = np.ones(num, np.bool_)
    trace = open_loop(PlanarArm(), FLAT_CONFIG, motion, task, lambda _: NOTHING_NEAR, has_distance=has_distance)
    for velocity in trace.commanded:
        np.testing.assert_allclose((PlanarArm().frame_jacobian(BENT, "tip") @ velocity)[:3], asked[:3], atol=2e-3)

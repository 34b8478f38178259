"""Open loop on the planar arm: the command beside the logged velocity, and what logged twists ask for."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.columns import NamedColumns
from splatctrl_cli.control.goals import LoggedMotion, TwistTrack, guided_goal
from splatctrl_cli.control.replay import OpenLoopTask, Outcome, ReplayTask, ReplayTrace, closed_loop, open_loop
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.records import Bool, DistanceField, Float64
from tests.control.fakes import PlanarArm, Plane, far_away

CONFIG = ControlConfig()
SECOND = 1_000_000_000
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


EVERY = np.ones(21, np.bool_)


def run(
    field: DistanceField,
    task: OpenLoopTask = FOLLOW,
    asked: LoggedMotion | None = None,
    has_distance: Bool = EVERY,
    later: DistanceField | None = None,
) -> NamedColumns:
    """Drive through a field, which `later` replaces after half a second."""
    fields = field, later or field
    given = asked or motion()
    return open_loop(PlanarArm(), CONFIG, given, task, lambda t: fields[t >= SECOND // 2], has_distance=has_distance)


def test_what_was_logged_is_what_is_commanded_where_nothing_is_near() -> None:
    trace = run(far_away())
    np.testing.assert_allclose(trace["dv"], 0.0, atol=1e-6)
    assert not trace["shaped"].any() and trace["barrier_margin_logged"].min() > 1


def test_a_wall_shapes_the_command_where_the_logged_velocity_breaks_its_row() -> None:
    trace = run(WALL)
    room, has_shaped = trace["barrier_margin_logged"], trace["shaped_scene"] == 1
    is_broken, is_clear = room < -1e-3, room > 1e-3
    assert 0 < is_broken.sum() < 21 and np.all(has_shaped[is_broken])
    assert is_clear.any() and not has_shaped[is_clear].any()
    assert np.abs(trace["dv"][is_clear]).max() < 1e-5 < np.abs(trace["dv"][is_broken]).max()
    assert trace["barrier_row_logged"][-1] == "fore[1]"


def test_a_goal_is_asked_for_at_every_state_alike() -> None:
    goal = PlanarArm().frame_pose(START, "tip")
    trace = run(far_away(), OpenLoopTask(frame="tip", T_world_goal=goal, home=START))
    assert np.linalg.norm(trace["v"][0]) < 1e-6
    assert np.all(np.sum(trace["v"][1:] * (START - motion().position[1:]), axis=1) > 0)


def test_a_state_without_a_distance_has_no_command() -> None:
    trace = run(WALL, has_distance=np.arange(21) != 3)
    assert (trace["rung"][3], trace["barrier_row_logged"][3]) == ("", "") and np.isnan(trace["shaped"][3])
    for name in ("v", "dv"):
        assert np.isnan(trace[name]).any(axis=1).tolist() == [k == 3 for k in range(21)]


def test_each_state_is_asked_in_the_field_of_its_time() -> None:
    clearances = run(far_away(), later=WALL)["barrier_clearance"]
    assert clearances[:10].min() > 40 and clearances[10:].max() < 1


def test_a_logged_velocity_above_the_limit_is_named() -> None:
    trace = run(far_away(), asked=replace(motion(), velocity=np.tile([0.0, -1.8], (21, 1))))
    assert trace["velocity_row_logged"][0] == "elbow lowest"
    assert trace["velocity_margin_logged"][0] == pytest.approx(-0.3)
    assert trace["shaped_limit"].all() and not trace["shaped_scene"].any()


def test_a_logged_motion_is_linear_between_states_and_at_rest_after_the_last() -> None:
    logged = motion(num=3)
    for stamp, position in ((SECOND // 4, 0.75 * START + 0.25 * END), (SECOND // 2, (START + END) / 2), (-5, START)):
        np.testing.assert_allclose(logged.at(stamp)[0], position)
    np.testing.assert_allclose(logged.at(SECOND // 4)[1], END - START)
    np.testing.assert_array_equal(logged.at(2 * SECOND), [logged.position[2], np.zeros(2)])


def test_a_guide_carries_the_frame_as_the_log_did() -> None:
    arm, logged = PlanarArm(), motion()
    _, guide = guided_goal(arm, "tip", *logged.at(300_000_000))
    q, v = logged.at(300_000_000)
    step = (arm.frame_pose(q + 1e-6 * v, "tip") - arm.frame_pose(q - 1e-6 * v, "tip"))[:3, 3] / 2e-6
    np.testing.assert_allclose(guide.twist[:3], step, atol=1e-8)
    assert guide.twist[5] == pytest.approx(v.sum())


FLAT_CONFIG = replace(ControlConfig(), weight_angular=1e-6)  # two joints reach for two of six dimensions
BENT = np.array([0.3, 0.9])


def track(twist: list[float], *, until_s: float = 1.0, every_s: float = 0.1, axes: str | None = None) -> TwistTrack:
    """A constant twist from 0 to `until_s`."""
    stamps = np.round(np.arange(0, until_s, every_s) * SECOND).astype(np.int64)
    return TwistTrack(stamp_ns=stamps, twist=np.tile(twist, (len(stamps), 1)), axes=axes)


def driven(twists: TwistTrack, end_s: float = 1.0) -> ReplayTrace:
    goal, end_ns = PlanarArm().frame_pose(BENT, "tip"), round(end_s * SECOND)
    task = ReplayTask(start=BENT, T_world_goal=goal, frame="tip", twists=twists, end_ns=end_ns)
    field = far_away()
    return closed_loop(PlanarArm(), FLAT_CONFIG, task, lambda _: field)


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
    reference = track([3.0, 4.0, 0, 0, 0, 9.0]).reference(PlanarArm(), FLAT_CONFIG, BENT, 0)
    linear, angular = FLAT_CONFIG.max_linear_speed, FLAT_CONFIG.max_angular_speed
    np.testing.assert_allclose(reference, [0.6 * linear, 0.8 * linear, 0, 0, 0, angular])


def test_axes_of_a_link_turn_with_it() -> None:
    trace = driven(track([0.0, 0.05, 0, 0, 0, 0], axes="tip"))
    for q, step in zip(trace.position[::20], trace.steps[::20], strict=True):
        velocity = PlanarArm().frame_jacobian(q, "tip")[:3] @ step.velocity
        np.testing.assert_allclose(velocity, PlanarArm().frame_pose(q, "tip")[:3, :3] @ [0, 0.05, 0], atol=2e-3)


def test_angular_twists_turn_with_the_link_too() -> None:
    """The link's x axis is the world's y, its y the world's z."""
    arm = PlanarArm()
    arm.frame_pose = lambda q, frame: pose_at([0, 0, 0], [[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # type: ignore[method-assign]
    found = track([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], axes="tip").find_world_twist(arm, BENT, 0, 0.5)
    np.testing.assert_allclose(found, [0.3, 0.1, 0.2, 0.6, 0.4, 0.5])


@pytest.mark.parametrize("asked", [[-0.1, 0.0, 0, 0, 0, 0], [0.0, 0.1, 0, 0, 0, 0]])
def test_open_loop_asks_for_the_twist_and_not_for_what_was_done(asked: list[float]) -> None:
    still = LoggedMotion(
        stamp_ns=np.arange(5) * SECOND // 10, position=np.tile(BENT, (5, 1)), velocity=np.ones((5, 2))
    )
    task = OpenLoopTask(frame="tip", twists=track(asked))
    trace = open_loop(PlanarArm(), FLAT_CONFIG, still, task, lambda _: far_away(), has_distance=EVERY[:5])
    found = trace["v"] @ PlanarArm().frame_jacobian(BENT, "tip").T
    np.testing.assert_allclose(found[:, :3], np.tile(asked[:3], (5, 1)), atol=2e-3)

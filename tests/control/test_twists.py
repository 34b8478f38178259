"""Logged twists as the controller's target, on the planar arm."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.goals import LoggedMotion, TwistTrack
from splatctrl_cli.control.open_loop import OpenLoopTask, open_loop
from splatctrl_cli.control.replay import Outcome, ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm, far_away

CONFIG = replace(ControlConfig(), weight_angular=1e-6)  # two joints reach for two of six dimensions
SECOND = 1_000_000_000
START = np.array([0.3, 0.9])
NOTHING_NEAR = far_away()


def track(twist: list[float], *, until_s: float = 1.0, every_s: float = 0.1, axes: str | None = None) -> TwistTrack:
    """A constant twist from 0 to `until_s`."""
    stamps = np.round(np.arange(0, until_s, every_s) * SECOND).astype(np.int64)
    return TwistTrack(stamp_ns=stamps, twist=np.tile(twist, (len(stamps), 1)), axes=axes)


def driven(twists: TwistTrack, end_s: float = 1.0) -> ReplayTrace:
    arm = PlanarArm()
    task = ReplayTask(
        start=START,
        T_world_goal=arm.frame_pose(START, "tip"),
        frame="tip",
        twists=twists,
        end_ns=round(end_s * SECOND),
    )
    return closed_loop(arm, CONFIG, task, lambda _: NOTHING_NEAR)


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
    np.testing.assert_allclose(tip(trace.position[at_time_out]) - tip(START), [-0.141, 0.0705, 0], atol=3e-3)
    np.testing.assert_allclose(trace.position[at_time_out:] - trace.position[at_time_out], 0, atol=1e-6)
    assert all(not step.pose_error.any() for step in trace.steps)


def test_a_twist_faster_than_allowed_is_capped_and_keeps_its_direction() -> None:
    fast = track([3.0, 4.0, 0, 0, 0, 9.0])
    reference = fast.reference(PlanarArm(), CONFIG, START, 0)
    np.testing.assert_allclose(reference[:3], CONFIG.max_linear_speed * np.array([0.6, 0.8, 0]))
    np.testing.assert_allclose(reference[3:], [0, 0, CONFIG.max_angular_speed])


def test_axes_of_a_link_turn_with_it() -> None:
    body = track([0.1, 0, 0, 0, 0, 0.2], axes="tip")
    R = PlanarArm().frame_pose(START, "tip")[:3, :3]
    np.testing.assert_allclose(body.reference(PlanarArm(), CONFIG, START, 0)[:3], R @ [0.1, 0, 0], atol=1e-12)
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

    found = track([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], axes="tip").asked(Turned(), START, 0, 0.5)
    np.testing.assert_allclose(found, [0.3, 0.1, 0.2, 0.6, 0.4, 0.5])


@pytest.mark.parametrize("asked", [[-0.1, 0.0, 0, 0, 0, 0], [0.0, 0.1, 0, 0, 0, 0]])
def test_open_loop_asks_for_the_twist_and_not_for_what_was_done(asked: list[float]) -> None:
    num = 5
    motion = LoggedMotion(
        stamp_ns=np.arange(num) * SECOND // 10, position=np.tile(START, (num, 1)), velocity=np.ones((num, 2))
    )
    task = OpenLoopTask(frame="tip", twists=track(asked))
    has_distance = np.ones(num, np.bool_)
    trace = open_loop(PlanarArm(), CONFIG, motion, task, lambda _: NOTHING_NEAR, has_distance=has_distance)
    for velocity in trace.commanded:
        np.testing.assert_allclose((PlanarArm().frame_jacobian(START, "tip") @ velocity)[:3], asked[:3], atol=2e-3)

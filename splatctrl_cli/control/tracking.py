"""A planned path, followed in closed loop: in joint space, or by the QP-IK controller with its barriers."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from splatctrl_cli.config import ControlConfig, PlannerConfig
from splatctrl_cli.control.clearance import Clearance
from splatctrl_cli.control.path import TimedPath, effector_length, joint_length
from splatctrl_cli.control.replay import is_at_goal
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.target import pose_error
from splatctrl_cli.records import DistanceField, Float64


@dataclass(frozen=True, kw_only=True)
class TrackingRun:
    """How a path was followed: position (T, J) [rad] per period, and what IV reports of it.

    has_arrived: the end effector is at the goal's pose; joint_length [rad], effector_length [m], effector_turn
    [degrees]; least_clearance [m], less its margin, over the T postures; duration [s].
    """

    position: Float64
    has_arrived: bool
    joint_length: float
    effector_length: float
    effector_turn: float
    least_clearance: float
    duration: float

    @property
    def is_success(self) -> bool:
        """True where the goal was reached and no posture was in collision."""
        return self.has_arrived and self.least_clearance > 0


def follow_joints(
    path: TimedPath, clearance: Clearance, frame: str, planner: PlannerConfig, control: ControlConfig
) -> TrackingRun:
    """Follow in joint space: the path's velocity plus a pull towards its position, within the velocity limits."""
    model = clearance.model
    q, positions = path.waypoints[0], [path.waypoints[0]]
    num_steps = int(np.ceil(path.duration / planner.period))
    clock = planner.period * np.arange(num_steps + 1)
    wanted = path.at(clock)[0]
    for now, following in pairwise(wanted):
        velocity = (following - now) / planner.period + planner.follow_gain * (now - q)
        q = q + planner.period * np.clip(velocity, -model.velocity_limit, model.velocity_limit)
        positions.append(q)
    return _run(np.array(positions), path, clearance, frame, planner.period, control)


def follow_with_controller(
    path: TimedPath,
    clearance: Clearance,
    field: DistanceField,
    frame: str,
    planner: PlannerConfig,
    control: ControlConfig,
) -> TrackingRun:
    """Follow with QP-IK: its goal is the end effector's pose on the path, its home the next waypoint.

    The path's clock waits while the end effector is `wait_distance` behind. Ends at the goal or at `max_time`.
    """
    model = clearance.model
    controllers = [QpIkController(model, control, field, frame=frame, home=home) for home in path.waypoints[1:]]
    T_world_goal = model.frame_pose(path.waypoints[-1], frame)
    q, clock, positions = path.waypoints[0], 0.0, [path.waypoints[0]]
    for _ in range(int(control.max_time / control.period)):
        has_ended = clock >= path.duration
        if has_ended and is_at_goal(pose_error(model.frame_pose(q, frame), T_world_goal), control):
            break
        edge = int(np.clip(np.searchsorted(path.start_time, clock, side="right") - 1, 0, len(controllers) - 1))
        T_world_wanted = T_world_goal if has_ended else model.frame_pose(path.at(clock)[0][0], frame)
        step = controllers[edge].step(q, T_world_wanted)
        q = q + control.period * step.velocity
        positions.append(q)
        if np.linalg.norm(step.pose_error[:3]) < planner.wait_distance:
            clock = min(clock + control.period, path.duration)
    return _run(np.array(positions), path, clearance, frame, control.period, control)


def _run(
    position: Float64, path: TimedPath, clearance: Clearance, frame: str, period: float, control: ControlConfig
) -> TrackingRun:
    model = clearance.model
    error = pose_error(model.frame_pose(position[-1], frame), model.frame_pose(path.waypoints[-1], frame))
    moved, turned = effector_length(model, position, frame)
    return TrackingRun(
        position=position,
        has_arrived=is_at_goal(error, control),
        joint_length=joint_length(position),
        effector_length=moved,
        effector_turn=turned,
        least_clearance=float(np.min(clearance.at(position))),
        duration=period * (len(position) - 1),
    )

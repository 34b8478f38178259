"""A planned path, followed in closed loop: in joint space, or by the QP-IK controller with its barriers."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from splatctrl_cli.config import ControlConfig, PlannerConfig
from splatctrl_cli.control.goals import Guide, guided_goal, pose_error
from splatctrl_cli.control.replay import FieldAt, is_at_goal
from splatctrl_cli.control.scene_field import SceneStepAt, rate_of
from splatctrl_cli.control.step import ControlStep, QpIkController
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.path import TimedPath, effector_length, joint_length
from splatctrl_cli.records import Float64


@dataclass(frozen=True, kw_only=True)
class TrackingRun:
    """How a path was followed: position (T, J) [rad] per period, the controller's steps between them (T - 1, none in
    joint space), and what IV reports of it.

    has_arrived: the end effector is at the goal's pose; joint_length [rad], effector_length [m], effector_turn
    [degrees]; least_clearance [m], less its margin, over the T postures; duration [s].
    """

    position: Float64
    steps: tuple[ControlStep, ...]
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
    model, period = clearance.model, control.period
    q, positions = path.waypoints[0], [path.waypoints[0]]
    clock = period * np.arange(int(np.ceil(path.duration / period)) + 1)
    for now, following in pairwise(path.at(clock)[0]):
        velocity = (following - now) / period + planner.follow_gain * (now - q)
        q = q + period * np.clip(velocity, -model.velocity_limit, model.velocity_limit)
        positions.append(q)
    return _run(np.array(positions), (), path, clearance, frame, control)


def follow_with_controller(
    path: TimedPath,
    clearance: Clearance,
    field_at: FieldAt,
    frame: str,
    planner: PlannerConfig,
    control: ControlConfig,
    *,
    stamp_ns: int = 0,
    scene_step_at: SceneStepAt | None = None,
) -> TrackingRun:
    """Follow with QP-IK from a stamp [ns] on: its goal is the end effector's pose on the path, as it moves there, and
    the posture it leans to is the path's.

    The path's clock waits while the end effector is `wait_distance` behind. Ends at the goal, or when the clock has
    stood still for `control.stall_time`. field_at and scene_step_at as in `closed_loop`.
    """
    model, period = clearance.model, control.period
    field = field_at(stamp_ns)
    controller = QpIkController(model, control, field, frame=frame)
    q, clock, waited, is_behind = path.waypoints[0], 0.0, 0.0, False
    positions: list[Float64] = [q]
    steps: list[ControlStep] = []
    while waited < control.stall_time:
        now = stamp_ns + round(len(steps) * period * 1e9)
        if field_at(now) is not field:
            field = field_at(now)
            controller = controller.with_field(field)
        wanted, velocity = (row[0] for row in path.at(clock))
        goal, guide = guided_goal(model, frame, wanted, velocity)
        if clock >= path.duration and is_at_goal(pose_error(model.frame_pose(q, frame), goal), control):
            break
        if is_behind:  # the goal waits
            guide = Guide(twist=np.zeros(6), posture=wanted, velocity=np.zeros_like(wanted))
        step = controller.step(q, goal, distance_rate=rate_of(control, model, scene_step_at, now, q), guide=guide)
        q = q + period * step.velocity
        steps.append(step)
        positions.append(q)
        is_behind = bool(np.linalg.norm(step.pose_error[:3]) >= planner.wait_distance)
        waited = waited + period if is_behind or clock >= path.duration else 0.0
        clock = clock if is_behind else min(clock + period, path.duration)
    return _run(np.array(positions), tuple(steps), path, clearance, frame, control)


def _run(
    position: Float64,
    steps: tuple[ControlStep, ...],
    path: TimedPath,
    clearance: Clearance,
    frame: str,
    control: ControlConfig,
) -> TrackingRun:
    model = clearance.model
    error = pose_error(model.frame_pose(position[-1], frame), model.frame_pose(path.waypoints[-1], frame))
    moved, turned = effector_length(model, position, frame)
    return TrackingRun(
        position=position,
        steps=steps,
        has_arrived=is_at_goal(error, control),
        joint_length=joint_length(position),
        effector_length=moved,
        effector_turn=turned,
        least_clearance=float(np.min(clearance.at(position))),
        duration=control.period * (len(position) - 1),
    )

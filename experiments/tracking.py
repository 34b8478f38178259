"""Follows a planned path in closed loop: in joint space, or by the QP-IK controller with its barriers."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from splatctrl_cli.blocks import (
    ControlConfig,
    ControlStep,
    DistanceField,
    Float64,
    Guide,
    PlannerConfig,
    QpIkController,
    RobotModel,
    SceneStep,
    TimedPath,
    guided_goal,
    is_at_goal,
    pose_error,
    rate_of,
)

FOLLOW_GAIN = 10.0  # [1/s] joint error to velocity, following a path in joint space


def follow_joints(path: TimedPath, model: RobotModel, control: ControlConfig) -> Float64:
    """Follow in joint space: the path's velocity plus a pull towards its position, within the velocity limits.

    Returns the position (T, J) [rad] at every period.
    """
    period, gain = control.period, min(FOLLOW_GAIN, 1 / control.period)
    q, positions = path.waypoints[0], [path.waypoints[0]]
    clock = period * np.arange(int(np.ceil(path.duration / period)) + 1)
    for now, following in pairwise(path.at(clock)[0]):
        velocity = (following - now) / period + gain * (now - q)
        q = q + period * np.clip(velocity, -model.velocity_limit, model.velocity_limit)
        positions.append(q)
    return np.array(positions)


def follow_with_controller(
    path: TimedPath,
    model: RobotModel,
    field_at: Callable[[int], DistanceField],
    frame: str,
    planner: PlannerConfig,
    control: ControlConfig,
    *,
    stamp_ns: int = 0,
    scene_step_at: Callable[[int], SceneStep | None] | None = None,
) -> tuple[Float64, Sequence[ControlStep]]:
    """Follow a path with QP-IK from `stamp_ns` [ns]. Its goal is the path's moving end-effector pose; its preferred
    posture is the path's.

    The path's clock waits while the end effector is `wait_distance` behind. Ends at the goal, or when the clock has
    stood still for `control.stall_time`. field_at and scene_step_at: see `closed_loop`. Returns the position (T, J)
    [rad] at every period, and the T - 1 steps between them.
    """
    period = control.period
    field = field_at(stamp_ns)
    controller = QpIkController(model, control, field, frame=frame)
    q, clock, waited, is_behind = path.waypoints[0], 0.0, 0.0, False
    positions: list[Float64] = [q]
    steps: list[ControlStep] = []
    while waited < control.stall_time:
        now = stamp_ns + round(len(steps) * period * 1e9)
        if field_at(now) is not field:
            field = field_at(now)
            controller = controller.replace_field(field)
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
    return np.array(positions), steps

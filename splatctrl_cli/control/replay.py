"""Closed loop: the controller drives the arm from a logged start to a goal, in the scene as it was known."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel, sphere_names
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.qp import QpSolver
from splatctrl_cli.control.step import (
    ControlStep,
    QpIkController,
    Rung,
    StaticViolation,
    check_config,
    checked_posture,
    static_violations,
)
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.records import DistanceField, Float64

FieldAt = Callable[[int], DistanceField]


class Outcome(StrEnum):
    """How a closed loop ended."""

    GOAL_REACHED = "goal-reached"
    STALLED = "stalled"
    TIMEOUT = "timeout"


@dataclass(frozen=True, kw_only=True)
class ReplayTask:
    """Where a closed loop starts, (J,) [rad] at a stamp [ns], and the pose (4, 4) its frame should reach.

    home (J,) [rad] is the posture the arm leans to where the task leaves it free; None is the middle of the limits.
    """

    start: Float64
    T_world_goal: Float64
    frame: str
    stamp_ns: int = 0
    home: Float64 | None = None


@dataclass(frozen=True, kw_only=True)
class ReplayTrace:
    """T steps: stamp_ns (T,), position (T, J) [rad] at which each step was taken, and the steps themselves."""

    stamp_ns: Stamps
    position: Float64
    steps: tuple[ControlStep, ...]
    outcome: Outcome
    static_violations: tuple[StaticViolation, ...]


def closed_loop(
    model: ArmModel,
    config: ControlConfig,
    task: ReplayTask,
    field_at: FieldAt,
    *,
    solver: QpSolver | None = None,
) -> ReplayTrace:
    """Integrate the controller's velocities at `config.period` until the goal, a stall or `config.max_time`.

    field_at gives the field known at a stamp [ns], the same object for the same scene. Raises InputError for a start
    outside the limits or a goal out of reach, NotEvaluableError for a start in collision or outside the field.
    """
    check_config(config)
    q = _checked_start(model, config, task)
    check_goal(model, task.T_world_goal)
    field = field_at(task.stamp_ns)
    controller = QpIkController(model, config, field, frame=task.frame, home=task.home, solver=solver)
    _check_free(model, field, q)
    statics = static_violations(model, config, field, q)
    stamps, positions, steps = [], [], []
    outcome = Outcome.TIMEOUT
    for index in range(max(round(config.max_time / config.period), 1)):
        stamp = task.stamp_ns + round(index * config.period * 1e9)
        if field_at(stamp) is not field:
            field = field_at(stamp)
            controller = controller.with_field(field)
        step = controller.step(q, task.T_world_goal)
        stamps.append(stamp)
        positions.append(q)
        steps.append(step)
        if is_at_goal(step.pose_error, config):
            outcome = Outcome.GOAL_REACHED
            break
        if _has_stalled(positions, config):
            outcome = Outcome.STALLED
            break
        q = q + config.period * step.velocity
    return ReplayTrace(
        stamp_ns=np.array(stamps, dtype=np.int64),
        position=np.array(positions),
        steps=tuple(steps),
        outcome=outcome,
        static_violations=statics,
    )


def is_at_goal(pose_error: Float64, config: ControlConfig) -> bool:
    """True where a pose error (6,) is within the goal's tolerances."""
    position, rotation = np.linalg.norm(pose_error[:3]), np.linalg.norm(pose_error[3:])
    return bool(position <= config.goal_position and rotation <= config.goal_rotation)


def check_goal(model: ArmModel, T_world_goal: Float64) -> None:
    """Raise InputError for a goal that is no pose, or that lies outside the ball the robot can reach."""
    if np.shape(T_world_goal) != (4, 4) or not np.all(np.isfinite(T_world_goal)):
        raise InputError("goal: expected a finite pose x,y,z,qx,qy,qz,qw")
    distance = float(np.linalg.norm(T_world_goal[:3, 3] - model.base_position))
    if distance > model.reach():
        where = ", ".join(f"{v:.3f}" for v in T_world_goal[:3, 3])
        raise InputError(
            f"goal: expected within {model.reach():.3f} m of the base, got ({where}) at {distance:.3f} m",
            remedy="give a nearer --goal, or check --base and the world frame",
        )


def _checked_start(model: ArmModel, config: ControlConfig, task: ReplayTask) -> Float64:
    q = checked_posture(model, task.start, what="start")
    outside = np.maximum(q - model.upper, model.lower - q)
    worst = int(np.argmax(outside))
    if outside[worst] > config.limit_tolerance:
        raise InputError(
            f"start: joint {model.joint_names[worst]}: expected within [{model.lower[worst]:.4f}, "
            f"{model.upper[worst]:.4f}] rad, got {q[worst]:.4f}",
            remedy="choose another --start-time, or check that the URDF is of this robot",
        )
    return q


def _check_free(model: ArmModel, field: DistanceField, q: Float64) -> None:
    moving = np.flatnonzero(model.moving_spheres)
    points = np.ascontiguousarray(model.sphere_centers(q)[moving])
    distance = field.query(points)[0] - model.sphere_set.radii[moving]
    worst = int(np.argmin(np.where(np.isfinite(distance), distance, np.inf)))
    if distance[worst] < 0:
        name = sphere_names(model.sphere_set)[moving[worst]]
        raise NotEvaluableError(
            f"start: expected a posture free of collision, got sphere {name} {-distance[worst]:.4f} m deep in it",
            remedy="choose another --start-time, or check the robot's labels in the scene and --base",
        )


def _has_stalled(positions: list[Float64], config: ControlConfig) -> bool:
    """True where the joints moved slower than `stall_speed` on average over `stall_time` (a local minimum)."""
    num_back = round(config.stall_time / config.period)
    if len(positions) <= num_back:
        return False
    moved = np.max(np.abs(positions[-1] - positions[-1 - num_back]))
    return bool(moved < config.stall_speed * config.stall_time)


def num_on_rung(trace: ReplayTrace, rung: Rung) -> int:
    """How many steps came about on a rung of the ladder."""
    return sum(step.rung is rung for step in trace.steps)

"""Closed loop: the controller drives the arm from a logged start to a goal, in the scene as it was known."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.checks import (
    StaticViolation,
    check_config,
    check_free,
    check_goal,
    check_within_limits,
    checked_posture,
    sphere_clearance,
    static_violations,
)
from splatctrl_cli.control.ladder import Rung
from splatctrl_cli.control.qp import QpSolver
from splatctrl_cli.control.step import ControlStep, QpIkController
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
class SceneChange:
    """A newer scene at `stamp_ns`: the least clearance [m] of the unmoved arm before and after.

    A recorded obstacle appears where the logged arm was not; an arm that went elsewhere may be in its place.
    """

    stamp_ns: int
    before: float
    after: float

    @property
    def is_hit(self) -> bool:
        """True where the newer scene has something inside the arm that the older did not: no controller's doing."""
        return self.after < 0 <= self.before


@dataclass(frozen=True, kw_only=True)
class ReplayTrace:
    """T steps: stamp_ns (T,), position (T, J) [rad] at which each step was taken, and the steps themselves."""

    stamp_ns: Stamps
    position: Float64
    steps: tuple[ControlStep, ...]
    outcome: Outcome
    static_violations: tuple[StaticViolation, ...]
    scene_changes: tuple[SceneChange, ...]


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
    q = checked_posture(model, task.start, what="start")
    check_within_limits(model, q, config.limit_tolerance)
    check_goal(model, task.T_world_goal)
    field = field_at(task.stamp_ns)
    controller = QpIkController(model, config, field, frame=task.frame, home=task.home, solver=solver)
    check_free(model, field, q)
    statics = static_violations(model, field, q, config.margin)
    stamps, positions, steps, changes = [], [], [], []
    outcome = Outcome.TIMEOUT
    for index in range(max(round(config.max_time / config.period), 1)):
        stamp = task.stamp_ns + round(index * config.period * 1e9)
        if field_at(stamp) is not field:
            changes.append(_change(model, stamp, q, field, field_at(stamp)))
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
        scene_changes=tuple(changes),
    )


def is_at_goal(pose_error: Float64, config: ControlConfig) -> bool:
    """True where a pose error (6,) is within the goal's tolerances."""
    position, rotation = np.linalg.norm(pose_error[:3]), np.linalg.norm(pose_error[3:])
    return bool(position <= config.goal_position and rotation <= config.goal_rotation)


def _change(model: ArmModel, stamp_ns: int, q: Float64, before: DistanceField, after: DistanceField) -> SceneChange:
    moving = np.asarray(model.moving_spheres)
    least = [float(np.min(sphere_clearance(model, field, q, moving)[1])) for field in (before, after)]
    return SceneChange(stamp_ns=stamp_ns, before=least[0], after=least[1])


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

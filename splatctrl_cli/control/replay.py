"""Open loop along a log, closed loop to a goal, in each stamp's scene."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import BallDistance, DistanceFunction
from splatctrl_cli.control.barriers import FieldAt, SceneStepAt, rate_of, scene_margin
from splatctrl_cli.control.columns import NamedColumns, step_columns
from splatctrl_cli.control.goals import Detour, Guide, LoggedMotion, PlanDetour, TwistTrack, guided_goal, pose_error
from splatctrl_cli.control.preconditions import (
    StaticViolation,
    check_free,
    check_goal,
    check_within_limits,
    checked_posture,
    static_violations,
)
from splatctrl_cli.control.step import OURS, Commander, ControlStep, Moment, QpIkController, VelocityMargin
from splatctrl_cli.files.spilled_rows import ObjectFile
from splatctrl_cli.records import Bool, Float64, FloatRows, Stamps
from splatctrl_cli.robot.model import RobotModel


class Outcome(StrEnum):
    """End of a closed loop."""

    GOAL_REACHED = "goal-reached"
    STALLED = "stalled"
    TIMEOUT = "timeout"
    LOG_ENDED = "log-ended"
    CONTROLLER_FAILED = "controller-failed"


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A pose (4, 4) to reach; posture (J,) [rad] to lean to (None: home)."""

    T_world_goal: Float64
    posture: Float64 | None = None


@dataclass(frozen=True, kw_only=True)
class ReplayTask:
    """Start (J,) [rad] at a stamp [ns] and goal pose (4, 4) of a frame.

    home (J,) [rad]: posture to lean to (None: `model.middle`). via: poses to reach first, in order. follow:
    motion whose pose at each time is the goal, until it ends. twists: velocities to reach instead of poses, until
    end_ns. anchors: motion into whose posture the arm is put back every anchor_period [s].
    """

    start: Float64
    T_world_goal: Float64
    frame: str
    stamp_ns: int = 0
    home: Float64 | None = None
    via: tuple[Waypoint, ...] = ()
    follow: LoggedMotion | None = None
    twists: TwistTrack | None = None
    end_ns: int = 0
    anchors: LoggedMotion | None = None
    anchor_period: float = 0.0

    @property
    def last_ns(self) -> int | None:
        """Last stamp; None if the task ends at a goal."""
        if self.twists is not None:
            return self.end_ns
        return None if self.follow is None else self.follow.last_ns


@dataclass(frozen=True, kw_only=True)
class ReplayTrace:
    """T steps with stamp_ns (T,) and position (T, J) [rad] before each.

    anchored: steps before which the arm was put back; num_reached: number of goals; detours: steps after which a
    planned detour began; by_surface: spheres that counted by their link's surface at the end.
    """

    stamp_ns: Stamps
    position: FloatRows
    steps: Sequence[ControlStep]
    outcome: Outcome
    static_violations: tuple[StaticViolation, ...]
    anchored: tuple[int, ...] = ()
    num_reached: int = 0
    detours: tuple[int, ...] = ()
    by_surface: tuple[str, ...] = ()


def closed_loop(
    model: RobotModel,
    config: ControlConfig,
    task: ReplayTask,
    field_at: FieldAt,
    *,
    scene_step_at: SceneStepAt | None = None,
    plan_detour: PlanDetour | None = None,
    record: ObjectFile[ControlStep] | None = None,
    commander: Commander = OURS,
    distance_to: DistanceFunction | None = None,
    balls_at: Callable[[int], BallDistance | None] = lambda stamp_ns: None,
) -> ReplayTrace:
    """Integrate the commander's velocities at `config.period` until goal, stall or `config.max_time`.

    field_at: field known at a stamp [ns], one object per scene; scene_step_at: for `config.distance_rate`;
    plan_detour: path out of a stall, up to `config.max_detours` times; record: of steps (None: in memory);
    distance_to: for `check_free`; balls_at: the field's balls, None where links' surfaces do not count. Raises
    InputError for a start outside the limits or an unreachable goal, NotEvaluableError for a start in collision or
    outside the field.
    """
    field = field_at(task.stamp_ns)
    q = checked_posture(model, task.start, what="start")
    check_within_limits(model, q, config.limit_tolerance)
    for waypoint in (*task.via, Waypoint(T_world_goal=task.T_world_goal)):
        check_goal(model, waypoint.T_world_goal)
    controller = QpIkController(model, config, field, frame=task.frame, home=task.home)
    check_free(model, field, q, distance_to)
    controller = controller.replace_field(field, balls_at(task.stamp_ns))
    by_surface: tuple[str, ...] = ()
    statics = static_violations(model, field, q, scene_margin(model, config))
    course, last_velocity = _Course(model, config, task, plan_detour), np.zeros(len(q))
    stamps, positions, anchored = [], [], []
    steps: list[ControlStep] | ObjectFile[ControlStep] = [] if record is None else record
    outcome = Outcome.TIMEOUT if task.last_ns is None else Outcome.LOG_ENDED
    for index in range(course.num_steps):
        stamp = task.stamp_ns + round(index * config.period * 1e9)
        if (logged := course.anchor(index, stamp)) is not None:
            q, last_velocity = logged
            anchored.append(index)
        if field_at(stamp) is not field:
            field = field_at(stamp)
            controller = controller.replace_field(field, balls_at(stamp))
        rate = rate_of(config, model, scene_step_at, stamp, q)
        goal, guide = course.goal(stamp, q)
        moment = Moment(
            stamp_ns=stamp,
            q=q,
            T_world_goal=goal,
            guide=guide,
            last_velocity=last_velocity,
            distance_rate=rate,
            by_surface=by_surface,
        )
        step = commander.step(controller, moment)
        by_surface = step.by_surface
        stamps.append(stamp)
        positions.append(q)
        steps.append(step)
        ended = Outcome.CONTROLLER_FAILED if commander.is_over else course.outcome(stamp, index, step, q)
        if ended is not None:
            outcome = ended
            break
        q, last_velocity = q + config.period * step.velocity, step.velocity
    return ReplayTrace(
        stamp_ns=np.array(stamps, dtype=np.int64),
        position=np.array(positions),
        steps=steps,
        outcome=outcome,
        static_violations=statics,
        anchored=tuple(anchored),
        num_reached=course.num_reached,
        detours=tuple(course.detours),
        by_surface=by_surface,
    )


class _Course:
    """Goals by step: waypoints in order, or the logged motion."""

    def __init__(
        self, model: RobotModel, config: ControlConfig, task: ReplayTask, plan_detour: PlanDetour | None
    ) -> None:
        self._model, self._config, self._task, self._plan_detour = model, config, task, plan_detour
        self._waypoints = (*task.via, Waypoint(T_world_goal=task.T_world_goal, posture=None))
        self.num_reached = 0
        self.detours: list[int] = []
        self._since = 0  # the step from which a stall counts: the last anchor, waypoint or detour
        self._positions: list[Float64] = []  # of every step that may stall
        self._detour: Detour | None = None
        last_ns = task.last_ns
        left = config.max_time if last_ns is None else (last_ns - task.stamp_ns) * 1e-9 + config.period
        self.num_steps = max(round(left / config.period), 1)

    def anchor(self, index: int, stamp_ns: int) -> tuple[Float64, Float64] | None:
        """Logged position and velocity (J,) if an anchor is due at this step, else None."""
        task = self._task
        num_steps = max(round(task.anchor_period / self._config.period), 1)
        is_due = task.anchor_period > 0 and index > 0 and index % num_steps == 0
        if task.anchors is None or not is_due or stamp_ns > task.anchors.last_ns:
            return None
        self._since = index
        return task.anchors.at(stamp_ns)

    def outcome(self, stamp_ns: int, index: int, step: ControlStep, q: Float64) -> Outcome | None:
        """Outcome if the course ends with this step from q (J,), else None."""
        if self.has_ended(stamp_ns, index, step):
            return Outcome.GOAL_REACHED
        return Outcome.STALLED if self.has_stalled(stamp_ns, index, q) else None

    def has_stalled(self, stamp_ns: int, index: int, q: Float64) -> bool:
        """True at a standstill before the goal, unless a planned detour begins.

        A run that ends with its log never stalls.
        """
        if self._task.last_ns is not None:
            return False
        self._positions.append(q)
        if not _has_stalled(self._positions[self._since :], self._config):
            return False
        if self._plan_detour is None or len(self.detours) >= self._config.max_detours:
            return True
        self._detour = self._plan_detour(stamp_ns, q, self._waypoints[self.num_reached].T_world_goal)
        if self._detour is None:
            return True
        self.detours.append(index)
        self._since = index
        return False

    def goal(self, stamp_ns: int, q: Float64) -> tuple[Float64, Guide | None]:
        task = self._task
        if self._detour is not None:
            return self._detour.goal(self._model, task.frame)
        if task.twists is not None:
            return task.twists.goal_at(self._model, self._config, task.frame, q, stamp_ns)
        if task.follow is not None:
            return guided_goal(self._model, task.frame, *task.follow.at(stamp_ns))
        waypoint = self._waypoints[self.num_reached]
        if waypoint.posture is None:
            return waypoint.T_world_goal, None
        return waypoint.T_world_goal, Guide(
            twist=np.zeros(6), posture=waypoint.posture, velocity=np.zeros(len(waypoint.posture))
        )

    def has_ended(self, stamp_ns: int, index: int, step: ControlStep) -> bool:
        """True at the last goal; after an earlier goal, the next begins. Twists have none."""
        if self._detour is not None:
            self._detour.advance(self._config.period, step.pose_error)
            self._detour = None if self._detour.is_over else self._detour
            return False
        if self._task.twists is not None or not is_at_goal(step.pose_error, self._config):
            return False
        if self._task.follow is not None:
            return stamp_ns >= self._task.follow.last_ns
        self.num_reached += 1
        self._since = index
        return self.num_reached == len(self._waypoints)


def divergence(
    model: RobotModel, frame: str, stamp_ns: Stamps, position: FloatRows, motion: LoggedMotion
) -> dict[str, Float64]:
    """Distances of postures (T, J) from the postures logged at their stamps (T,), as columns.

    Columns (T,): joint norm [rad], frame position [m] and rotation [rad and degrees]; NaN after the log's end.
    """
    joints, linear, angular = (np.full(len(stamp_ns), np.nan) for _ in range(3))
    for index in np.flatnonzero(stamp_ns <= motion.last_ns):
        logged = motion.at(int(stamp_ns[index]))[0]
        error = pose_error(model.frame_pose(position[index], frame), model.frame_pose(logged, frame))
        joints[index] = np.linalg.norm(position[index] - logged)
        linear[index], angular[index] = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    return {
        "divergence_joints": joints,
        "divergence_position": linear,
        "divergence_rotation": angular,
        "divergence_rotation_deg": np.degrees(angular),
    }


def is_at_goal(pose_error: Float64, config: ControlConfig) -> bool:
    """True if a pose error (6,) is within the goal's tolerances."""
    position, rotation = np.linalg.norm(pose_error[:3]), np.linalg.norm(pose_error[3:])
    return bool(position <= config.goal_position and rotation <= config.goal_rotation)


def _has_stalled(positions: list[Float64], config: ControlConfig) -> bool:
    """True if each joint's mean speed over `stall_time` is below `stall_speed` (a local minimum)."""
    num_back = round(config.stall_time / config.period)
    if len(positions) <= num_back:
        return False
    return bool(np.max(np.abs(positions[-1] - positions[-1 - num_back])) < config.stall_speed * config.stall_time)


@dataclass(frozen=True, kw_only=True)
class OpenLoopTask:
    """Goal at each state: logged motion, a frame's pose (4, 4), or logged twists.

    home (J,) [rad]: posture to lean to with a goal pose (None: `model.middle`).
    """

    frame: str
    T_world_goal: Float64 | None = None
    home: Float64 | None = None
    twists: TwistTrack | None = None


def open_loop(
    model: RobotModel,
    config: ControlConfig,
    motion: LoggedMotion,
    task: OpenLoopTask,
    field_at: FieldAt,
    *,
    has_distance: Bool,
    scene_step_at: SceneStepAt | None = None,
    commander: Commander = OURS,
) -> NamedColumns:
    """Ask the commander at every logged state, in the field known then; nothing is integrated.

    has_distance (T,): False skips a state. scene_step_at: for `config.distance_rate`. Returns `step_columns`, and:
    logged (T, J) [rad/s]; dv (T, J) [rad/s], commanded less logged velocity; velocity_difference, its norm;
    largest_difference, its largest joint; the logged velocity's `VelocityMargin`.
    """
    field = field_at(int(motion.stamp_ns[0]))
    controller = QpIkController(model, config, field, frame=task.frame, home=task.home)
    steps: list[ControlStep | None] = [None] * len(motion.stamp_ns)
    margins: list[VelocityMargin | None] = [None] * len(motion.stamp_ns)
    for index, (stamp, q, v) in enumerate(zip(motion.stamp_ns, motion.position, motion.velocity, strict=True)):
        if not has_distance[index]:
            continue
        if field_at(int(stamp)) is not field:
            field = field_at(int(stamp))
            controller = controller.replace_field(field)
        goal, guide = (task.T_world_goal, None)
        if task.twists is not None:
            goal, guide = task.twists.goal_at(model, config, task.frame, q, int(stamp))
        elif goal is None:
            goal, guide = guided_goal(model, task.frame, q, v)
        rate = rate_of(config, model, scene_step_at, int(stamp), q)
        margins[index] = controller.margin_of(q, v, distance_rate=rate)
        if commander.is_over:
            continue
        moment = Moment(stamp_ns=int(stamp), q=q, T_world_goal=goal, guide=guide, last_velocity=v, distance_rate=rate)
        steps[index] = commander.step(controller, moment)
    columns = step_columns(steps, motion.velocity.shape[1])
    difference = columns["v"] - motion.velocity
    return {
        **columns,
        "logged": np.asarray(motion.velocity),
        "dv": difference,
        "velocity_difference": np.linalg.norm(difference, axis=1),
        "largest_difference": np.max(np.abs(difference), axis=1),
        "barrier_margin_logged": np.array([np.nan if room is None else room.barrier for room in margins]),
        "barrier_row_logged": ["" if room is None else room.barrier_row for room in margins],
        "velocity_margin_logged": np.array([np.nan if room is None else room.limit for room in margins]),
        "velocity_row_logged": ["" if room is None else room.limit_row for room in margins],
    }

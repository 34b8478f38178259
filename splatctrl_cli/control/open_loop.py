"""Open loop: the controller's command at every logged state, next to the logged one."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.barriers import FieldAt, SceneStepAt, rate_of
from splatctrl_cli.control.goals import LoggedMotion, TwistTrack, guided_goal
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.step import OURS, Commander, ControlStep, Moment, QpIkController, VelocityMargin
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import Bool, Float64
from splatctrl_cli.robot.model import RobotModel


@dataclass(frozen=True, kw_only=True)
class OpenLoopTask:
    """Goal at each state: logged motion, a frame's pose (4, 4), or logged twists.

    home (J,) [rad]: the posture to lean to with a goal pose (None: the model's `middle`).
    """

    frame: str
    T_world_goal: Float64 | None = None
    home: Float64 | None = None
    twists: TwistTrack | None = None


@dataclass(frozen=True, kw_only=True)
class OpenLoopTrace:
    """T states: the controller's step, and the room that the logged velocity left.

    Both are None where the field has no distance; the step also after the commander's end. logged, commanded (T, J)
    [rad/s]; commanded: NaN without a step.
    """

    logged: Float64
    commanded: Float64
    steps: tuple[ControlStep | None, ...]
    margins: tuple[VelocityMargin | None, ...]

    @property
    def difference(self) -> Float64:
        """(T, J) [rad/s] commanded less logged."""
        return self.commanded - self.logged


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
) -> OpenLoopTrace:
    """Ask the commander at every logged state, in the field known then; nothing is integrated.

    has_distance (T,): False skips a state. scene_step_at: as in `closed_loop`.
    """
    field = field_at(int(motion.stamp_ns[0]))
    controller = QpIkController(model, config, field, frame=task.frame, home=task.home)
    steps: list[ControlStep | None] = [None] * len(motion.stamp_ns)
    margins: list[VelocityMargin | None] = [None] * len(motion.stamp_ns)
    commanded = np.full(motion.velocity.shape, np.nan)
    for index, (stamp, q, v) in enumerate(zip(motion.stamp_ns, motion.position, motion.velocity, strict=True)):
        if not has_distance[index]:
            continue
        if field_at(int(stamp)) is not field:
            field = field_at(int(stamp))
            controller = controller.with_field(field)
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
        steps[index] = step = commander.step(controller, moment)
        commanded[index] = step.velocity
    return OpenLoopTrace(
        logged=np.asarray(motion.velocity), commanded=commanded, steps=tuple(steps), margins=tuple(margins)
    )


def is_shaped(step: ControlStep | None, kind: RowKind | None = None) -> bool:
    """True if a row (of a kind) shapes the command.

    Without a kind, any fallback or scaling counts, too. False for external controllers.
    """
    if step is None or step.rung is Rung.OUTSIDE:
        return False
    if kind is not None:
        return any(row.kind is kind for row in step.interventions)
    return bool(step.interventions) or step.scale < 1 or step.rung is not Rung.SOLVED

"""Open loop: the controller's command at every logged state, next to the logged one."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.barriers import FieldAt, SceneStepAt, rate_of
from splatctrl_cli.control.columns import NamedColumns, step_columns
from splatctrl_cli.control.goals import LoggedMotion, TwistTrack, guided_goal
from splatctrl_cli.control.step import OURS, Commander, ControlStep, Moment, QpIkController, VelocityMargin
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

    has_distance (T,): False skips a state. scene_step_at: as in `closed_loop`. Returns `step_columns`, and by state:
    logged, dv (commanded less logged) (T, J) [rad/s]; velocity_difference: its norm, largest_difference: of a joint;
    the room that the logged velocity left, as in `VelocityMargin`.
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

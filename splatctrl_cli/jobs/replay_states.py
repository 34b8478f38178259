"""What ``splatctrl replay`` reads of a log: the robot's states, and whether they fit the robot and the cameras."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatctrl_cli.checks.state_check import PoseAgreement, check_angles, check_states, pose_agreement
from splatctrl_cli.checks.state_motion import ImageMotion
from splatctrl_cli.checks.state_offset import ClockOffset, RobotPoints, estimate_clock_offset, states_asked
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.jobs.replay_request import ReplayRequest
from splatctrl_cli.logs.state_columns import StateCollector, StateColumns
from splatctrl_cli.records import Box, Float64, JointState, RecordSource, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.states.state_source import StateSource, open_states

MAX_NOTES = 10  # printed
LOG_FIGURES = (
    *("num_poses", "max_pose_position", "max_pose_rotation", "max_pose_rest_position", "max_pose_rest_rotation"),
    *("clock_offset_s", "clock_uncertainty_s"),
)


@dataclass(frozen=True, kw_only=True)
class LoggedStates:
    """States in the model's joint order, where they are from, and what was found about them.

    poses: beside forward kinematics, None where the log has no end-effector poses; clock: of cameras against the
    robot, None where the log has no frames.
    """

    source: "RecordSource"
    states: "StateColumns"
    poses: "PoseAgreement | None"
    clock: "ClockOffset | None"

    def as_dict(self) -> "Mapping[str, Any]":
        """For states.json."""
        return {
            "num_states": len(self.states),
            "loss": asdict(self.source.loss),
            "end_effector_poses": None
            if self.poses is None
            else asdict(self.poses) | {"offset": self.poses.offset.tolist()},
            "clock_offset": None if self.clock is None else asdict(self.clock),
        }

    def metrics(self) -> "dict[str, float | None]":
        """`LOG_FIGURES`: None where the log has no poses, or the offset cannot be told."""
        poses, clock = self.poses, self.clock
        values = (
            0 if poses is None else poses.num_poses,
            None if poses is None else poses.difference.max_position,
            None if poses is None else poses.difference.max_rotation,
            None if poses is None else poses.rest.max_position,
            None if poses is None else poses.rest.max_rotation,
            None if clock is None else clock.offset_s,
            None if clock is None else clock.uncertainty_s,
        )
        return dict(zip(LOG_FIGURES, values, strict=True))

    def lines(self) -> list[str]:
        """A line for each thing that a person should know."""
        notes = self.source.loss.notes
        more = [f"and {len(notes) - MAX_NOTES} more notes in states.json"] if len(notes) > MAX_NOTES else []
        found = [check.sentence for check in (self.poses, self.clock) if check is not None]
        return [f"log: {line}" for line in (*notes[:MAX_NOTES], *more, *found)]


def read_states(request: ReplayRequest, model: "RobotModel") -> LoggedStates:
    """The states of the robot's joints in a log. Raises InputError where there are none, or none that can be its."""

    source = open_states(request.log, request.options, model.joint_names)
    if not source.joint_names:
        raise InputError(
            f"{request.log}: expected joint states, got none", remedy="replay needs a log with /joint_states"
        )
    order = model.joint_order(source.joint_names)
    collector, motion = StateCollector(len(source.joint_names)), ImageMotion()
    for record in () if isinstance(source, StateSource) else source.records():
        if isinstance(record, JointState):
            collector.add(record)
        elif isinstance(record, RgbdFrame):
            motion.add(record)
    logged = source.states if isinstance(source, StateSource) else collector.columns()
    states = logged.of_joints(order)
    check_states(states, model.joint_names)
    check_angles(model, states, source.name)
    clock = _clock(model, states, motion) if motion.cameras and source.has_clock and len(states) else None
    return LoggedStates(source=source, states=states, poses=pose_agreement(model, states), clock=clock)


def check_inside(model: "RobotModel", q: "Float64", box: "Box") -> None:
    """Raise NotEvaluableError for a posture (J,) of which no moving sphere is in the box of a baked field."""

    centers = model.sphere_centers(q)[np.flatnonzero(model.moving_spheres)]
    beyond = np.maximum(box.lower - centers, centers - box.upper).max(axis=1)
    if not len(centers) or beyond.min() <= 0:
        return
    lower, upper = ("(" + ", ".join(f"{v:.2f}" for v in corner) + ")" for corner in (box.lower, box.upper))
    raise NotEvaluableError(
        f"--field: expected the robot in the grid from {lower} to {upper} m, got all {len(centers)} moving spheres "
        f"outside it, the nearest by {beyond.min():.2f} m",
        remedy="check --base and the frame of the field, or bake a --box around the robot",
    )


def _clock(model: "RobotModel", states: "StateColumns", motion: "ImageMotion") -> "ClockOffset":
    """Of the states that it looks at."""

    asked = states.select(states_asked(states.stamp_ns, motion))
    centers = model.sphere_centers_batch(asked.position[: len(asked)])
    moving = model.moving_spheres
    return estimate_clock_offset(
        asked, motion, RobotPoints(centers=centers[:, moving], radii=model.sphere_set.radii[moving])
    )

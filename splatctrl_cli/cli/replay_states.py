"""What ``splatctrl replay`` reads of a log: the robot's states, and whether they fit the robot and the cameras."""

import argparse
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.source_options import source_options
from splatctrl_cli.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from splatctrl_cli.io.state_check import PoseAgreement
    from splatctrl_cli.io.state_motion import ImageMotion
    from splatctrl_cli.io.state_offset import ClockOffset
    from splatctrl_cli.records import JointState, RecordSource
    from splatctrl_cli.robot.model import RobotModel

MAX_NOTES = 10  # printed


@dataclass(frozen=True, kw_only=True)
class LoggedStates:
    """States in the model's joint order, where they are from, and what was found about them.

    poses: beside forward kinematics, None where the log has no end-effector poses; clock: of cameras against the
    robot, None where the log has no frames.
    """

    source: "RecordSource"
    states: "tuple[JointState, ...]"
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

    def lines(self) -> list[str]:
        """A line for each thing that a person should know."""
        notes = self.source.loss.notes
        more = [f"and {len(notes) - MAX_NOTES} more notes in states.json"] if len(notes) > MAX_NOTES else []
        found = [check.sentence for check in (self.poses, self.clock) if check is not None]
        return [f"log: {line}" for line in (*notes[:MAX_NOTES], *more, *found)]


def read_states(args: argparse.Namespace, model: "RobotModel") -> LoggedStates:
    """The states of the robot's joints in a log. Raises InputError where there are none, or none that can be its."""
    from splatctrl_cli.io.state_check import check_angles, pose_agreement
    from splatctrl_cli.io.state_motion import ImageMotion
    from splatctrl_cli.io.state_source import open_states
    from splatctrl_cli.records import JointState, RgbdFrame

    source = open_states(args.log, source_options(args), model.joint_names)
    if not source.joint_names:
        raise InputError(
            f"{args.log}: expected joint states, got none", remedy="replay needs a log with /joint_states"
        )
    order = model.joint_order(source.joint_names)
    states, motion = [], ImageMotion()
    for record in source.records():
        if isinstance(record, JointState):
            states.append(_ordered(record, order))
        elif isinstance(record, RgbdFrame):
            motion.add(record)
    check_angles(model, states, source.name)
    clock = _clock(model, states, motion) if motion.cameras and source.has_clock and states else None
    return LoggedStates(source=source, states=tuple(states), poses=pose_agreement(model, states), clock=clock)


def _ordered(state: "JointState", order: "NDArray[np.int64]") -> "JointState":
    commanded = state.commanded_velocity
    return replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
        commanded_velocity=None if commanded is None else commanded[order],
    )


def _clock(model: "RobotModel", states: "list[JointState]", motion: "ImageMotion") -> "ClockOffset":
    import numpy as np

    from splatctrl_cli.io.state_offset import RobotPoints, estimate_clock_offset

    centers = model.sphere_centers_batch(np.array([state.position for state in states]))
    moving = model.moving_spheres
    return estimate_clock_offset(
        states, motion, RobotPoints(centers=centers[:, moving], radii=model.sphere_set.radii[moving])
    )

"""Whether a scene or field, a log and a robot belong together, by what they contain."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from splatctrl_cli.evaluate.recording import changed_files, differences
from splatctrl_cli.io.scene_folder import SceneFolder
from splatctrl_cli.io.state_columns import StateColumns
from splatctrl_cli.records import RecordSource
from splatctrl_cli.robot.model import RobotModel

APART = 1_000_000_000  # [ns] between the times of two recordings that can still be one


@dataclass(frozen=True, kw_only=True)
class Mismatch:
    """What does not fit, as a sentence, and what to do about it."""

    sentence: str
    remedy: str


def scene_mismatches(
    scene: SceneFolder, source: RecordSource, states: StateColumns, model: RobotModel
) -> Iterator[Mismatch]:
    """How a reconstruction and a log with states of a robot do not belong together; nothing where they do.

    By the digests of files of the same names, each training camera's first frame, the times that both cover, and the
    joints of the robot that the scene was told apart with.
    """
    run: Mapping[str, Any] = scene.run
    other = changed_files(run.get("inputs", {}), source.digests())
    recorded = run.get("metrics", {}).get("first_frames")
    if not other and recorded and source.cameras:
        other = differences(recorded, source.records())
    if other:
        yield Mismatch(
            sentence=f"{scene.path} was made from another recording: {'; '.join(other[:3])}",
            remedy="reconstruct this log",
        )
    if scene.has_clock and len(states):
        stamps = [snapshot.stamp_ns for snapshot in scene.snapshots] or [scene.stamp_ns]
        first, last = int(states.stamp_ns[0]), int(states.stamp_ns[-1])
        if last < stamps[0] - APART or first > max(stamps[-1], scene.stamp_ns) + APART:
            yield Mismatch(
                sentence=f"joint states from {first} to {last} ns and a scene from {stamps[0]} to "
                f"{scene.stamp_ns} ns are of different times",
                remedy="record both by one clock, or reconstruct this log",
            )
    joints = run.get("metrics", {}).get("robot_joints")
    if joints is not None and tuple(joints) != tuple(model.joint_names):
        yield Mismatch(
            sentence=f"{scene.path} was told apart from another robot, with joints {', '.join(joints)}",
            remedy="reconstruct with this --urdf",
        )

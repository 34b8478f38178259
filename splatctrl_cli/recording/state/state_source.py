"""A robot's motion from recordings, logs without cameras, and tables."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import sha256
from splatctrl_cli.recording.calibrated import calibrated
from splatctrl_cli.recording.capture.capture import CaptureSource, is_capture
from splatctrl_cli.recording.container.raw_log import RawLog
from splatctrl_cli.recording.folder.folder_description import has_table
from splatctrl_cli.recording.folder.layouts import has_views
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.log.state_topics import joint_records, with_prefix
from splatctrl_cli.recording.log.state_track import RawTrack, cleaned
from splatctrl_cli.recording.log.stored_frame import FrameSource
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.log.video import open_log
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_table import (
    ARRAY_FILES,
    dataset_track,
    described_track,
    is_lerobot,
    is_libfranka,
    libfranka_track,
    read_csv,
)
from splatctrl_cli.records import LossReport

_FOR_CAMERAS = (
    *("cameras", "camera_topics", "camera_poses", "camera_pose_topics"),
    *("human_topics", "depth_scale", "world_frame", "calibration", "perturb"),
)
_NOT_FOR_TABLES = (*_FOR_CAMERAS, "joint_topic", "root", "holdout")


class StateSource(FrameSource):
    """Joint states without frames."""

    def __init__(
        self, name: str, files: Sequence[Path], names: tuple[str, ...], states: StateColumns, loss: LossReport
    ) -> None:
        self.name = name
        self.joint_names = names
        self._files = tuple(files)
        self.states = states
        self._loss = loss

    @property
    def loss(self) -> LossReport:
        return replace(self._loss, notes=list(self._loss.notes))

    def digests(self) -> dict[str, str]:
        return {file.name: sha256(file) for file in self._files}


def open_states(path: Path, options: SourceOptions, joints: Sequence[str]) -> FrameSource | StateSource:
    """Open an input's states of `joints` (a robot's) and its frames, where it has them.

    Raises InputError if missing, or without usable states.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder", remedy="check the path")
    if path.suffix == ".csv":
        options.refuse(_NOT_FOR_TABLES, "a table of joint states", path)
        return _libfranka(path, joints)
    if path.suffix == ".toml" and has_table(path, "states"):
        options.refuse(_NOT_FOR_TABLES, "a table of joint states", path)
        raw, file = described_track(path)
        return _of_table(path, (path, file), raw, LossReport())
    if path.suffix.lower() in ARRAY_FILES:
        raise InputError(
            f"{path}: a file of arrays, of which none is known to be joint states",
            remedy="describe them in a .toml and give that (splatctrl help replay, Logs)",
        )
    if is_lerobot(path):
        options.refuse(_NOT_FOR_TABLES, "a LeRobot dataset", path)
        raw, file = dataset_track(path)
        return _of_table(path, (file,), raw, LossReport(notes=["times are seconds from the episode's begin"]))
    if is_capture(path):
        return calibrated(CaptureSource(path, options, joints), options)
    if path.suffix == ".toml" or has_views(path):
        return open_source(path, options)
    return _of_log(path, open_log(path), options, joints)


def _of_log(path: Path, log: RawLog, options: SourceOptions, joints: Sequence[str]) -> FrameSource | StateSource:
    """Open with frames if possible; else the states, with a note."""
    default = SourceOptions()
    try:
        return calibrated(RosLogSource(log, options, joints), options)
    except InputError as error:
        if any(getattr(options, name) != getattr(default, name) for name in _FOR_CAMERAS):
            raise  # somebody asked for these cameras
        reason = error
    found = survey(log, by_log_time=options.stamps == "log")
    if not found.num_messages:
        raise reason
    loss = LossReport(
        damaged=found.damage.count, notes=[*found.damage.all_notes, f"no camera is used: {reason.message}"]
    )
    names, states = joint_records(found, options, loss, joints)
    if not states:
        topics = ", ".join(f"{name} ({t.topic.type_name})" for name, t in sorted(found.topics.items()) if t.count)
        raise InputError(
            f"{path}: expected joint states, got none", remedy=f"the log holds {topics or 'no messages'}"
        )
    return StateSource(path.name, log.files, names, states, loss)


def _libfranka(path: Path, joints: Sequence[str]) -> StateSource:
    table = read_csv(path)
    if not is_libfranka(table):
        raise InputError(
            f"{path}: expected libfranka's columns (time, q[0], ...), got {', '.join(table.names[:4])}, ...",
            remedy="describe the columns in a .toml and give that (splatctrl help replay, Logs)",
        )
    raw = libfranka_track(table)
    names = with_prefix(raw.names, joints)
    loss = LossReport(notes=["times are those of the robot, in ms since it was switched on"])
    if len(names) == len(raw.names):
        raw = replace(raw, names=tuple(names[name] for name in raw.names))
    return _of_table(path, (path,), raw, loss)


def _of_table(path: Path, files: Sequence[Path], raw: RawTrack, loss: LossReport) -> StateSource:
    states = cleaned(raw, loss)
    if not states:
        raise InputError(f"{path}: expected joint states, got none that is finite", remedy="check the file")
    return StateSource(path.name, files, raw.names, states, loss)

"""A robot's motion from recordings, logs without cameras, and tables.

Commanded twists are those of a log's topic, or of a TOML file's [twists].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.recording.calibrated import calibrated
from splatctrl_cli.recording.capture.capture import CaptureSource, is_capture
from splatctrl_cli.recording.container.log_formats import is_bag_folder, open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage, RawLog
from splatctrl_cli.recording.folder.folder_description import has_table, read_table
from splatctrl_cli.recording.folder.image_folder import has_views
from splatctrl_cli.recording.log.decoder import MessageDecoder, UndecodableMessageError, is_ros, stamp_ns
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.log.state_topics import joint_records, match_prefix
from splatctrl_cli.recording.log.state_track import RawTrack, clean_states
from splatctrl_cli.recording.log.stored_frame import FrameSource
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.log.video import open_log
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_table import (
    ARRAY_FILES,
    INFO,
    TIME_UNITS_NS,
    columns_of,
    dataset_track,
    libfranka_track,
    read_csv,
    read_described_track,
)
from splatctrl_cli.records import Float64, LossReport, Stamps

_FOR_CAMERAS = (
    *("cameras", "camera_topics", "camera_poses", "camera_pose_topics"),
    *("human_topics", "depth_scale", "world_frame", "calibration", "perturb"),
)
_NOT_FOR_TABLES = (*_FOR_CAMERAS, "joint_topic", "root", "holdout")


class StateSource(FrameSource):
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
    """Open an input's states of a robot's `joints`, and its frames, if any.

    Raises InputError if missing, or without usable states.
    """
    refuse_if(not path.exists(), f"{path}: no such file or folder", remedy="check the path")
    if path.suffix == ".csv":
        options.refuse(_NOT_FOR_TABLES, "a table of joint states", path)
        return _libfranka(path, joints)
    if path.suffix == ".toml" and has_table(path, "states"):
        options.refuse(_NOT_FOR_TABLES, "a table of joint states", path)
        raw, file = read_described_track(path)
        return _open_table(path, (path, file), raw, LossReport())
    refuse_if(
        path.suffix.lower() in ARRAY_FILES,
        f"{path}: a file of arrays, of which none is known to be joint states",
        remedy="describe them in a .toml and give that (splatctrl help replay, Logs)",
    )
    if (path / INFO).is_file() and (path / "data").is_dir():
        options.refuse(_NOT_FOR_TABLES, "a LeRobot dataset", path)
        raw, file = dataset_track(path)
        return _open_table(path, (file,), raw, LossReport(notes=["times are seconds from the episode's begin"]))
    if is_capture(path):
        return calibrated(CaptureSource(path, options, joints), options)
    if path.suffix == ".toml" or has_views(path):
        return open_source(path, options)
    return _open_log_states(path, open_log(path), options, joints)


def _open_log_states(
    path: Path, log: RawLog, options: SourceOptions, joints: Sequence[str]
) -> FrameSource | StateSource:
    default = SourceOptions()
    try:
        return calibrated(RosLogSource(log, options, joints), options)
    except InputError as error:
        if any(getattr(options, name) != getattr(default, name) for name in _FOR_CAMERAS):
            raise  # somebody asked for these cameras
        reason = error
    log_survey = survey(log, by_log_time=options.stamps == "log")
    if not log_survey.num_messages:
        raise reason
    loss = LossReport(
        damaged=log_survey.damage.count, notes=[*log_survey.damage.all_notes, f"no camera is used: {reason.message}"]
    )
    names, states = joint_records(log_survey, options, loss, joints)
    topics = ", ".join(f"{name} ({t.topic.type_name})" for name, t in sorted(log_survey.topics.items()) if t.count)
    refuse_if(
        not states, f"{path}: expected joint states, got none", remedy=f"the log holds {topics or 'no messages'}"
    )
    return StateSource(path.name, log.files, names, states, loss)


def _libfranka(path: Path, joints: Sequence[str]) -> StateSource:
    raw = libfranka_track(read_csv(path))
    names = match_prefix(raw.names, joints)
    loss = LossReport(notes=["times are those of the robot, in ms since it was switched on"])
    if len(names) == len(raw.names):
        raw = replace(raw, names=tuple(names[name] for name in raw.names))
    return _open_table(path, (path,), raw, loss)


def _open_table(path: Path, files: Sequence[Path], raw: RawTrack, loss: LossReport) -> StateSource:
    states = clean_states(raw, loss)
    refuse_if(not states, f"{path}: expected joint states, got none that is finite", remedy="check the file")
    return StateSource(path.name, files, raw.names, states, loss)


TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
TABLE = "twists"
_SEE = "see splatctrl help replay, Twists"


@dataclass(frozen=True, kw_only=True)
class LoggedTwists:
    """N twists: stamp_ns (N,) rising, twist (N, 6) [m/s, rad/s], linear first.

    frame: as the log names it, or "". notes: dropped twists and the stamps' clock.
    """

    where: str
    stamp_ns: Stamps
    twist: Float64
    frame: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TwistsTable:
    """Table ``[twists]``: a file and columns as in ``[states]``; frame: world or a link."""

    file: str
    time: str
    linear: list[str]
    angular: list[str]
    frame: str = "world"
    time_unit: str = "s"
    epoch_ns: int = 0


def read_twists(path: Path, topic: str) -> LoggedTwists:
    """Read the twists of a log's topic, or of a TOML file's table (always ``twists``).

    Stamps are those of headers, or log times if no header has one. Non-finite twists are dropped with a note; of
    equal stamps, the last is kept. Raises InputError without twists, or for several frames.
    """
    if path.suffix == ".toml":
        return _read_described(path, topic)
    refuse_if(
        not path.is_file() and not is_bag_folder(path),
        f"{path}: expected a log to take the twists {topic} from",
        remedy="give the log that it was made of",
    )
    return _read_logged(path, topic)


def _read_logged(path: Path, topic: str) -> LoggedTwists:
    log, decoder, damage = open_raw_log(path), MessageDecoder(), Damage()
    kinds: dict[str, str] = {entry.name: entry.type_name for entry in log.topics()}
    stamps, log_times, twists, frames = [], [], [], []
    for message in log.messages(damage, {topic}):
        kind = message.topic.type_name
        kinds[topic] = kind
        if kind not in (TWIST, STAMPED) or not is_ros(message.topic):
            break
        try:
            content = decoder.decode(message)
        except UndecodableMessageError as error:
            damage.add(str(error))
            continue
        twist = content.twist if kind == STAMPED else content
        twists.append([getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"])
        log_times.append(message.log_time_ns)
        stamps.append(stamp_ns(content.header) if kind == STAMPED else 0)
        frames.append(content.header.frame_id.strip("/") if kind == STAMPED else "")
    twist_topics = ", ".join(sorted(name for name, kind in kinds.items() if kind in (TWIST, STAMPED)))
    refuse_if(
        not twists,
        f"{path}: topic {topic}: expected {STAMPED} or {TWIST}, got {kinds.get(topic, 'no message')}",
        remedy=f"topics with twists: {twist_topics or 'none'}",
    )
    notes = [f"{len(damage.notes)} messages do not decode: left out"] if damage.count else []
    if not any(stamps):
        notes.append("stamps are the times of logging")
        stamps = log_times
    return _checked(f"{path}: topic {topic}", np.array(stamps, np.int64), np.array(twists), frames, notes)


def _read_described(path: Path, name: str) -> LoggedTwists:
    refuse_if(
        name != TABLE or not has_table(path, TABLE),
        f"{path}: expected a table [{TABLE}], got {name}",
        remedy=f"{_SEE}, and name it so",
    )
    table = read_table(TwistsTable, path, TABLE, others=("states",))
    refuse_if(
        table.time_unit not in TIME_UNITS_NS or (len(table.linear), len(table.angular)) != (3, 3),
        f"{path}: {TABLE}: expected linear and angular of 3 columns and time_unit of {', '.join(TIME_UNITS_NS)}",
        remedy=_SEE,
    )
    stamps, columns = columns_of(path, TABLE, table.file).read(
        table.time, TIME_UNITS_NS[table.time_unit], {"twist": [*table.linear, *table.angular]}, table.epoch_ns
    )
    twists = columns["twist"][: len(columns["twist"])]
    refuse_if(
        twists.shape != (len(stamps), 6),
        f"{path}: {TABLE}: expected 6 columns of {len(stamps)} rows, got {twists.shape[::-1]}",
    )
    return _checked(f"{path}: {TABLE}", stamps, twists, [table.frame] * len(stamps), [])


def _checked(where: str, stamps: Stamps, twists: Float64, frames: list[str], notes: list[str]) -> LoggedTwists:
    refuse_if(
        len(set(frames)) > 1,
        f"{where}: expected twists in one frame, got {', '.join(sorted(set(frames)))}",
        remedy="record one frame's only",
    )
    is_finite = np.isfinite(twists).all(axis=1)
    if not is_finite.all():
        notes.append(f"{int((~is_finite).sum())} twists with NaN or infinity: left out")
        stamps, twists = stamps[is_finite], twists[is_finite]
    refuse_if(not len(stamps), f"{where}: expected twists, got none that is finite", remedy="check the recording")
    order = np.argsort(stamps, kind="stable")
    stamps, twists = stamps[order], twists[order]
    is_last = np.append(np.diff(stamps) > 0, True)
    return LoggedTwists(
        where=where, stamp_ns=stamps[is_last], twist=twists[is_last], frame=frames[0], notes=tuple(notes)
    )

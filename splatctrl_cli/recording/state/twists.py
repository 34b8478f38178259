"""Commanded twists of a log's topic, or of a TOML file's [twists]."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.log_formats import is_bag_folder, open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage
from splatctrl_cli.recording.folder.folder_description import has_table, read_table
from splatctrl_cli.recording.log.decoder import MessageDecoder, UndecodableMessageError, is_ros, stamp_ns
from splatctrl_cli.recording.state.state_table import TIME_UNITS_NS, columns_of
from splatctrl_cli.records import Float64, Stamps

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
TABLE = "twists"
_SEE = "see splatctrl help replay, Twists"


@dataclass(frozen=True, kw_only=True)
class LoggedTwists:
    """N twists: stamp_ns (N,) rising, twist (N, 6) [m/s, rad/s], linear first, in the axes of `frame`.

    frame: the log's name, or "". notes: dropped twists and the stamps' clock.
    """

    where: str
    stamp_ns: Stamps
    twist: Float64
    frame: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TwistsTable:
    """``[twists]``: a file and its columns, as ``[states]``; frame: world or a link."""

    file: str
    time: str
    linear: list[str]
    angular: list[str]
    frame: str = "world"
    time_unit: str = "s"
    epoch_ns: int = 0


def read_twists(path: Path, topic: str) -> LoggedTwists:
    """Read the twists of a log's topic, or of a TOML file's table (always ``twists``).

    Stamps are headers', or log times if no header has one. Non-finite twists are dropped with a note; of equal stamps
    the last is kept. Raises InputError without twists, or in several frames.
    """
    if path.suffix == ".toml":
        return _of_table(path, topic)
    if not path.is_file() and not is_bag_folder(path):
        raise InputError(
            f"{path}: expected a log to take the twists {topic} from", remedy="give the log that it was made of"
        )
    return _of_log(path, topic)


def _of_log(path: Path, topic: str) -> LoggedTwists:
    log, decoder, damage = open_raw_log(path), MessageDecoder(), Damage()
    kinds: dict[str, str] = {found.name: found.type_name for found in log.topics()}
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
    if not twists:
        there = ", ".join(sorted(name for name, kind in kinds.items() if kind in (TWIST, STAMPED)))
        raise InputError(
            f"{path}: topic {topic}: expected {STAMPED} or {TWIST}, got {kinds.get(topic, 'no message')}",
            remedy=f"topics with twists: {there or 'none'}",
        )
    notes = [f"{len(damage.notes)} messages do not decode: left out"] if damage.count else []
    if not any(stamps):
        notes.append("stamps are the times of logging")
        stamps = log_times
    return _checked(f"{path}: topic {topic}", np.array(stamps, np.int64), np.array(twists), frames, notes)


def _of_table(path: Path, name: str) -> LoggedTwists:
    if name != TABLE or not has_table(path, TABLE):
        raise InputError(f"{path}: expected a table [{TABLE}], got {name}", remedy=f"{_SEE}, and name it so")
    table = read_table(TwistsTable, path, TABLE, beside=("states",))
    if table.time_unit not in TIME_UNITS_NS or (len(table.linear), len(table.angular)) != (3, 3):
        raise InputError(
            f"{path}: {TABLE}: expected linear and angular of 3 columns and time_unit of {', '.join(TIME_UNITS_NS)}",
            remedy=_SEE,
        )
    columns = columns_of(path, TABLE, table.file)
    stamps, found = columns.read(
        table.time, TIME_UNITS_NS[table.time_unit], {"twist": [*table.linear, *table.angular]}, table.epoch_ns
    )
    twists = found["twist"][: len(found["twist"])]
    if twists.shape != (len(stamps), 6):
        raise InputError(f"{path}: {TABLE}: expected 6 columns of {len(stamps)} rows, got {twists.shape[::-1]}")
    return _checked(f"{path}: {TABLE}", stamps, twists, [table.frame] * len(stamps), [])


def _checked(where: str, stamps: Stamps, twists: Float64, frames: list[str], notes: list[str]) -> LoggedTwists:
    if len(set(frames)) > 1:
        raise InputError(
            f"{where}: expected twists in one frame, got {', '.join(sorted(set(frames)))}",
            remedy="record one frame's only",
        )
    is_finite = np.isfinite(twists).all(axis=1)
    if not is_finite.all():
        notes.append(f"{int((~is_finite).sum())} twists with NaN or infinity: left out")
        stamps, twists = stamps[is_finite], twists[is_finite]
    if not len(stamps):
        raise InputError(f"{where}: expected twists, got none that is finite", remedy="check the recording")
    order = np.argsort(stamps, kind="stable")
    stamps, twists = stamps[order], twists[order]
    is_last = np.append(np.diff(stamps) > 0, True)
    return LoggedTwists(
        where=where, stamp_ns=stamps[is_last], twist=twists[is_last], frame=frames[0], notes=tuple(notes)
    )

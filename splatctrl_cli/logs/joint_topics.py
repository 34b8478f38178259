"""The joint states of a log's topics as a capture keeps them: as recorded, so that any joints can be asked for.

joint_topics/K/stamp_ns.npy, log_time_ns.npy (T,) int64; position.npy, and where there are any velocity.npy,
commanded_velocity.npy (T, J), T_base_ee.npy (T, 4, 4) float64; what K is stands in capture.json.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.containers.raw_log import Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.arrays import npy_head, npy_of
from splatctrl_cli.files.spilled_rows import Rows, blocks_of, ranges
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.logs.state_messages import STATE_TYPES, JointLog, JointStream
from splatctrl_cli.logs.state_topics import joint_records
from splatctrl_cli.logs.survey import Survey, TopicSurvey
from splatctrl_cli.records import Float64, LossReport

FOLDER = "joint_topics"
AGAIN = "run `splatctrl ingest` again"


@dataclass(frozen=True, kw_only=True)
class JointTopics:
    """The topics with joint states, what became of them (`loss`, its notes from number `first_note` of the whole
    report on), and the topic that somebody chose.
    """

    topics: Sequence[TopicSurvey]
    loss: LossReport
    first_note: int
    chosen: str | None = None


def topics_of(found: Survey, loss: LossReport, first_note: int, options: SourceOptions) -> JointTopics:
    """Those of a log."""
    topics = found.of_type(*STATE_TYPES)
    return JointTopics(topics=topics, loss=loss, first_note=first_note, chosen=options.joint_topic)


def with_joints(loss: LossReport, joints: LossReport, at: int) -> LossReport:
    """A report with that of the joint states, its notes from number `at` on."""
    return loss.plus(joints, [*loss.notes[:at], *joints.notes, *loss.notes[at:]])


def without_joints(loss: LossReport, joints: LossReport, at: int) -> LossReport:
    """The reverse of `with_joints`."""
    return loss.plus(joints, [*loss.notes[:at], *loss.notes[at + len(joints.notes) :]], sign=-1)


def write_topics(folder: Path, kept: JointTopics, wrote: Callable[[str], None]) -> dict[str, Any]:
    """Write the streams of all topics into a capture; `wrote` gets each file. Returns what capture.json says."""
    described, number = [], 0
    for topic in kept.topics:
        streams = []
        for stream in topic.joints.streams:
            place = f"{FOLDER}/{number}"
            (folder / place).mkdir(parents=True)
            number += 1
            times = {"stamp_ns": stream.stamp_ns, "log_time_ns": stream.log_time_ns}
            for name, values in times.items():
                np.save(folder / place / f"{name}.npy", values, allow_pickle=False)
            columns = stream.columns()
            for name, rows in columns.items():
                _write_rows(folder / place / f"{name}.npy", rows)
            for name in (*times, *columns):
                wrote(f"{place}/{name}.npy")
            streams.append({"folder": place, "joints": list(stream.names), "columns": list(columns)})
        described.append(
            {
                "topic": topic.topic.name,
                "type": topic.topic.type_name,
                "messages": topic.count,
                "has_definition": bool(topic.topic.definition),
                "states": len(topic.joints),
                "streams": streams,
            }
        )
    loss = {"counts": asdict(kept.loss), "first_note": kept.first_note}
    return {"topics": described, "chosen": kept.chosen, "loss": loss}


def read_topics(folder: Path, described: Mapping[str, Any], checked: Callable[[str], Path]) -> JointTopics:
    """What `write_topics` wrote. `checked` gives the path of a file whose checksum is right.

    Raises InputError where a file is not as it was written.
    """
    try:
        topics = [_topic(entry, checked) for entry in described["topics"]]
        loss = LossReport(**described["loss"]["counts"])
        first_note, chosen = int(described["loss"]["first_note"]), described["chosen"]
    except (KeyError, TypeError, ValueError, OSError, EOFError) as error:
        raise InputError(f"{folder / FOLDER}: cannot be read: {error}", remedy=AGAIN) from None
    return JointTopics(topics=topics, loss=loss, first_note=first_note, chosen=chosen)


def joints_again(
    kept: JointTopics, options: SourceOptions, wanted: Sequence[str]
) -> tuple[tuple[str, ...], StateColumns, LossReport]:
    """Names and states of a robot's joints as the log itself would give them, and what became of the others."""
    loss = LossReport()
    found = Survey(topics={topic.topic.name: topic for topic in kept.topics})
    chosen = options if options.joint_topic is not None else replace(options, joint_topic=kept.chosen)
    names, states = joint_records(found, chosen, loss, wanted)
    return names, states, loss


def _topic(entry: Mapping[str, Any], checked: Callable[[str], Path]) -> TopicSurvey:
    streams = []
    for stream in entry["streams"]:
        place = stream["folder"]
        stamps, log_times = (
            np.asarray(npy_of(checked(f"{place}/{name}.npy").read_bytes()), dtype=np.int64)
            for name in ("stamp_ns", "log_time_ns")
        )
        columns = {name: _blocks(checked(f"{place}/{name}.npy")) for name in stream["columns"]}
        streams.append(JointStream.of(tuple(stream["joints"]), stamps, log_times, columns))
    definition = "kept" if entry["has_definition"] else ""
    topic = Topic(name=entry["topic"], type_name=entry["type"], encoding="cdr", definition=definition)
    return TopicSurvey(topic=topic, count=int(entry["messages"]), joints=JointLog.of(int(entry["states"]), streams))


def _write_rows(path: Path, rows: Rows) -> None:
    """A .npy file, a block at a time."""
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": rows.shape})
        for block in blocks_of(rows):
            stream.write(np.ascontiguousarray(block, dtype="<f8").tobytes())


def _blocks(path: Path) -> Iterator[Float64]:
    """Of a .npy file as `_write_rows` writes it. Raises ValueError for another."""
    with path.open("rb") as stream:
        shape, is_by_columns, dtype = npy_head(stream)
        if dtype != np.dtype("<f8") or is_by_columns or not shape:
            raise ValueError(f"{path.name}: expected rows of float64, got {dtype} {shape}")
        if 8 * prod(shape) != path.stat().st_size - stream.tell():
            raise ValueError(f"{path.name}: does not hold the {shape[0]} rows that it announces")
        for first, last in ranges(shape[0]):
            size = (last - first) * prod(shape[1:])
            values = np.frombuffer(stream.read(8 * size), dtype)  # no map: a file that shrinks would kill the program
            if values.size != size:
                raise ValueError(f"{path.name}: ends after {first + values.size} of {shape[0]} rows")
            yield values.reshape(last - first, *shape[1:])

"""What holds for every kind of log: known by its bytes, it gives what was written, and cut anywhere a part of it."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as BagWriter

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.log_formats import CONTAINERS, open_raw_log
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from tests.properties import few
from tests.recording.log.make_log import make_log, rewritten

TOPICS = ("/a", "/b/c", "/d e")
Written = list[tuple[str, int, bytes]]  # topic, time [ns] and bytes of each message
MESSAGES = st.lists(
    st.tuples(st.sampled_from(TOPICS), st.integers(0, 2**32 - 1).map(lambda s: s * 10**9), st.binary(max_size=60)),
    min_size=1,
    max_size=20,
)


def write_mcap(path: Path, messages: Written, **options: Any) -> None:
    with path.open("wb") as stream:
        writer = McapWriter(stream, **{"chunk_size": 100, "enable_data_crcs": True, **options})
        writer.start(profile="", library="tests")
        channels: dict[str, int] = {}
        for topic, stamp, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "x", 0)
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def write_bag(path: Path, messages: Written, compression: BagWriter.CompressionFormat | None = None) -> None:
    path.unlink(missing_ok=True)
    writer = BagWriter(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for topic, stamp, data in messages:
            if topic not in connections:
                kind = "std_msgs/msg/String"
                connections[topic] = writer.add_connection(topic, kind, msgdef="string data", md5sum="0")
            writer.write(connections[topic], stamp, data)


def write_db3(path: Path, messages: Written) -> None:
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
        rows = [(i, name, "std_msgs/msg/String", "cdr") for i, name in enumerate(TOPICS)]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", rows)
        written = [(TOPICS.index(topic), stamp, data) for topic, stamp, data in messages]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", written)


WRITERS: dict[str, Callable[[Path, Written], None]] = {
    **{f"mcap {kind.name}": partial(write_mcap, compression=kind) for kind in CompressionType},
    "mcap without chunks": partial(write_mcap, use_chunking=False),
    "bag": write_bag,
    **{f"bag {kind.name}": partial(write_bag, compression=kind) for kind in BagWriter.CompressionFormat},
    "db3": write_db3,
}


def found_in(path: Path, names: set[str] | None = None) -> tuple[Written, int]:
    """The messages, and how much was damaged."""
    damage = Damage()
    log = open_raw_log(path)
    return [(m.topic.name, m.log_time_ns, bytes(m.data)) for m in log.messages(damage, names)], damage.count


def test_every_kind_of_log_is_written_here() -> None:
    assert {name.partition(" ")[0] for name in WRITERS} == {kind.suffix[1:] for kind in CONTAINERS}


@pytest.mark.parametrize("name", WRITERS)
def test_what_was_written_is_read_and_cut_anywhere_a_part_of_it(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    @few(12)
    @given(MESSAGES, st.floats(0, 1))
    def check(messages: Written, share: float) -> None:
        path = tmp_path_factory.getbasetemp() / f"{name}.log"
        WRITERS[name](path, messages)
        assert found_in(path) == (messages, 0)
        of_topic = [message for message in messages if message[0] == "/a"]
        assert found_in(path, {"/a"}) == (of_topic, 0)
        assert {topic.name for topic in open_raw_log(path).topics()} >= {message[0] for message in messages}
        data = path.read_bytes()
        path.write_bytes(data[: 16 + int(share * (len(data) - 17))])
        try:
            found, damaged = found_in(path)
        except InputError:  # not one whole record, or no tables
            return
        is_ordered = name != "db3"  # of which any page may be gone
        assert found == messages[: len(found)] if is_ordered else all(message in messages for message in found)
        assert damaged or not is_ordered

    check()


@pytest.mark.parametrize("kind", CONTAINERS, ids=lambda kind: kind.suffix)
@pytest.mark.parametrize("suffix", ["", *(kind.suffix for kind in CONTAINERS)])
def test_a_log_is_known_by_its_first_bytes(tmp_path: Path, kind: Any, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    WRITERS[kind.suffix[1:] if kind.open is not McapLog else "mcap ZSTD"](path, [("/a", 5 * 10**9, b"data")])
    assert type(open_raw_log(path)) is kind.open


@pytest.mark.parametrize("content", [b"hello, this is text", b""])
@pytest.mark.parametrize("suffix", [kind.suffix for kind in CONTAINERS])
def test_what_is_no_log_is_refused_by_its_bytes(tmp_path: Path, suffix: str, content: bytes) -> None:
    said = rf"does not begin like a {suffix} file \(first bytes b'hello, t'\)"
    (tmp_path / f"x{suffix}").write_bytes(content)
    with pytest.raises(InputError, match=said if content else r"the file is empty \(0 bytes\)"):
        open_raw_log(tmp_path / f"x{suffix}")


def with_last_time(log: Path, path: Path, topics: tuple[str, ...]) -> Path:
    """The log with the last time that MCAP has for the first message of each topic."""
    left = set(topics)

    def late(message: RawMessage) -> RawMessage:
        if message.topic.name not in left:
            return message
        left.remove(message.topic.name)
        return replace(message, log_time_ns=2**64 - 1)

    return rewritten(log, path, late)


@pytest.mark.parametrize(("stamps", "num_frames"), [("header", 5), ("log", 4)])
def test_a_time_beyond_64_bits_costs_its_message(tmp_path: Path, stamps: str, num_frames: int) -> None:
    topics = ("/joint_states", "/cam0/color/image_raw/compressed")
    log = with_last_time(make_log(tmp_path / "log.mcap"), tmp_path / "x.mcap", topics)
    source = open_source(log, SourceOptions(stamps=stamps))
    records = list(source.records())
    assert sum(isinstance(record, RgbdFrame) for record in records) == num_frames
    assert len(records) == num_frames + 4  # joint states
    notes = [f"{topic}: a time beyond 2^63 ns" for topic in topics[: 6 - num_frames]]
    assert sorted(source.loss.notes) == sorted(notes)

"""Bags of ROS 1 and of ROS 2's sqlite3: whole ones give what rosbags gives, of any distribution; damaged, compressed,
split and hostile ones give what precedes or follows the damage.
"""

import os
import sqlite3
import struct
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import pytest
import yaml
import zstandard
from rosbags.rosbag1 import Reader
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as Bag2Reader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.formats.unpacking import MAX_BLOCK
from splatctrl_cli.recording.container.bag_logs import Bag1Log, Db3Log
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage
from tests.cases.container_cases import kill_recorder
from tests.recording.log.make_log import T, encoded, write_bag
from tests.refused import expect_refusal

STORE1 = get_typestore(Stores.ROS1_NOETIC)

COMPRESSIONS = [None, Bag1Writer.CompressionFormat.BZ2, Bag1Writer.CompressionFormat.LZ4]


def make_bag1(path: Path, compression: Bag1Writer.CompressionFormat | None = None) -> Path:
    """60 texts of 400 bytes on two topics, in chunks of about 2 kB."""
    text = STORE1.types["std_msgs/msg/String"]
    writer = Bag1Writer(path)
    writer.chunk_threshold = 2000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        topics = [writer.add_connection(name, "std_msgs/msg/String", typestore=STORE1) for name in ("/a", "/b")]
        for index in range(60):
            message = text(data=" ".join(str(index * k % 97) for k in range(150))[:400])
            content = STORE1.serialize_ros1(message, "std_msgs/msg/String")
            writer.write(topics[index % 2], 1_000_000_000 + index, content)
    return path


def by_rosbags(path: Path) -> list[tuple[str, str, str, int, bytes]]:
    with Reader(path) as reader:
        return [(c.topic, c.msgtype, c.msgdef.data, stamp, data) for c, stamp, data in reader.messages()]


def plain(messages: list[RawMessage]) -> list[tuple[str, str, str, int, bytes]]:
    return [(m.topic.name, m.topic.type_name, m.topic.definition, m.log_time_ns, m.data) for m in messages]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_whole_bag_gives_what_rosbags_gives(
    tmp_path: Path, compression: Bag1Writer.CompressionFormat | None
) -> None:
    bag = make_bag1(tmp_path / "x.bag", compression)
    found, damage = read(bag)
    assert (plain(found), len(found), damage.notes) == (by_rosbags(bag), 60, [])
    assert {topic.name for topic in open_raw_log(bag).topics()} == {"/a", "/b"}
    assert plain(read(bag, {"/b"})[0]) == plain(found[1::2])


LEFT_OUT = "the chunk at byte {0} was left out: "

LZ4 = Bag1Writer.CompressionFormat.LZ4


def with_size(data: bytes, at: int, _end: int) -> bytes:
    """Announcing gigabytes in the header of the chunk whose body begins at a byte."""
    place = data.rindex(b"size=", 0, at) + 5
    return data[:place] + b"\xff" * 4 + data[place + 4 :]


def still_written(data: bytes, _at: int, _end: int) -> bytes:
    """Without the index, and without its place in the head."""
    place = data.index(b"index_pos=") + len("index_pos=")
    return data[:place] + bytes(8) + data[place + 8 : struct.unpack_from("<Q", data, place)[0]]


@pytest.mark.parametrize(
    ("compression", "change", "num", "note"),
    [
        *(
            (
                kind,
                lambda data, at, _: data[: at + 40] + bytes(40) + data[at + 80 :],
                range(41, 60),
                f"{LEFT_OUT}{said}",
            )
            for kind, said in zip(COMPRESSIONS[1:], ["cannot be decompressed"] * 2, strict=True)
        ),
        (
            LZ4,
            with_size,
            range(41, 60),
            f"{LEFT_OUT}announces {0xFFFFFFFF} bytes unpacked, at most {MAX_BLOCK} are read",
        ),
        (
            None,
            lambda data, at, _: data[: at - 4] + b"\xff" * 4 + data[at:],
            range(41, 60),
            "bytes {0} to {1} are damaged and were left out",
        ),
        (None, lambda data, at, _: data[: at + 1400], range(6, 10), "cut or damaged after byte {0}"),
        (None, still_written, [60], "has no index: cut, or still being written"),
        (None, lambda data, _, end: data[:end], [60], "its index is not whole"),
    ],
)
def test_a_damaged_chunk_costs_itself_alone_and_a_cut_what_follows(
    tmp_path: Path,
    compression: Bag1Writer.CompressionFormat | None,
    change: Callable[[bytes, int, int], bytes],
    num: Sequence[int],
    note: str,
) -> None:
    bag = make_bag1(tmp_path / "x.bag", compression)
    records, data = list(Bag1Log(bag).records(Damage())), bag.read_bytes()
    chunks = [record for record in records if record.opcode == 5]
    bag.write_bytes(change(data, data.index(chunks[1].content), records[-1].offset))
    found, damage = read(bag)
    expected = f"x.bag: {note.format(chunks[1].offset, chunks[2].offset)}"
    assert (len(found) in num, damage.notes[0]) == (True, expected)


def make_bag(
    folder: Path,
    num: int = 400,
    mode: CompressionMode = CompressionMode.NONE,
    plugin: StoragePlugin = StoragePlugin.SQLITE3,
) -> Path:
    """Texts of 700 bytes on one topic, message i at time i + 1."""
    texts = (T["std_msgs/msg/String"](data=f"{index:7d}" * 100) for index in range(num))
    messages = [encoded(index + 1, "/text", text) for index, text in enumerate(texts)]
    return write_bag(folder, messages, plugin=plugin, mode=mode)


def read(path: Path, names: set[str] | None = None) -> tuple[list[RawMessage], Damage]:
    damage = Damage()
    return list(open_raw_log(path).messages(damage, names)), damage


def stamps(path: Path) -> list[int]:
    return [message.log_time_ns for message in read(path)[0]]


def test_every_real_bag_gives_what_rosbags_gives(real_data: Path) -> None:
    for bag in (real_data / "realsense_bag").glob("*.bag"):
        found, damage = read(bag)
        assert sorted(plain(found)) == sorted(by_rosbags(bag)) and damage.notes == []
    bags = sorted((real_data / "rosbag2_testbags").rglob("*.db3"))
    assert len(bags) > 10
    for bag in bags:
        found, damage = read(bag)
        reader = Sqlite3Reader(bag)
        reader.open()
        expected = sorted((c.topic, c.msgtype, t, bytes(d)) for c, t, d in reader.messages(reader.connections))
        definitions = {c.topic: c.msgdef.data for c in reader.connections}
        reader.close()
        assert sorted((m.topic.name, m.topic.type_name, m.log_time_ns, m.data) for m in found) == expected, bag
        assert ({t.name: t.definition for t in Db3Log(bag).topics()}, damage.notes) == (definitions, [])


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compressed_bag_and_its_file_alone_give_what_the_plain_one_gives(
    tmp_path: Path, mode: CompressionMode, plugin: StoragePlugin
) -> None:
    plain = [(m.log_time_ns, m.data) for m in read(make_bag(tmp_path / "plain", num=40))[0]]
    bag = make_bag(tmp_path / "packed", num=40, mode=mode, plugin=plugin)
    for path in (bag, next(file for file in bag.iterdir() if file.suffix != ".yaml")):
        packed, damage = read(path)
        assert ([(m.log_time_ns, m.data) for m in packed], damage.all_notes) == (plain, [])
    with Bag2Reader(bag) as reader:
        assert [(stamp, bytes(data)) for _, stamp, data in reader.messages()] == plain


@pytest.mark.parametrize("version", range(1, 10))
def test_metadata_of_every_version_is_read(tmp_path: Path, version: int) -> None:
    bag = make_bag(tmp_path / "bag", num=3)
    file = bag / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    paths = ["bag/bag.db3" if version < 4 else "bag.db3"]
    content["rosbag2_bagfile_information"] |= {"version": version, "relative_file_paths": paths}
    file.write_text(yaml.safe_dump(content))
    assert stamps(bag) == [1, 2, 3]


def test_split_files_without_metadata_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "split").mkdir()
    for part in (2, 10, 1):
        source = make_bag(tmp_path / f"part{part}", num=part)
        (source / f"part{part}.db3").rename(tmp_path / f"split/rec_{part}.db3")
    assert stamps(tmp_path / "split") == [1, 1, 2, *range(1, 11)]


def test_a_damaged_page_costs_its_rows_and_a_cut_file_those_behind_it(tmp_path: Path) -> None:
    file = make_bag(tmp_path / "bag") / "bag.db3"
    whole = file.read_bytes()
    page = int.from_bytes(whole[16:18], "big")
    at = whole.index(b"    200    200") // page * page
    file.write_bytes(whole[:at] + os.urandom(8) * (page // 8) + whole[at + page :])
    found = stamps(file)
    assert 380 < len(found) < 400 and {1, 190, 215, 400} <= set(found) and sorted(set(found)) == found
    assert "damaged behind message" in read(file)[1].notes[0]
    file.write_bytes(whole[: len(whole) * 2 // 3])
    found = stamps(file)
    assert found == list(range(1, len(found) + 1)) and 150 < len(found) < 400
    assert read(file)[1].count >= 1


def test_a_journal_of_nonsense_is_damage_and_the_bag_is_read_without(tmp_path: Path) -> None:
    file = make_bag(tmp_path / "bag", num=3) / "bag.db3"
    file.with_name("bag.db3-wal").write_bytes(b"rows")
    found, damage = read(file)
    said = "bag.db3-wal: holds no page that can be read; the bag was not closed"
    assert (len(found), damage.notes) == (3, [said])


def make_killed(folder: Path, num: int = 40, closed: int = 0) -> Path:
    """A bag whose recorder was killed: all but the first `closed` messages are in its journal alone."""
    killed = folder / "killed" / "bag.db3"
    kill_recorder(make_bag(folder / "whole", num=num) / "whole.db3", killed, closed)
    return killed


@pytest.mark.parametrize("closed", [0, 13])
def test_what_a_killed_recorder_left_in_its_journal_is_read_and_nothing_is_written(
    tmp_path: Path, closed: int
) -> None:
    file = make_killed(tmp_path, closed=closed)
    before = {path.name: path.read_bytes() for path in file.parent.iterdir()}
    file.parent.chmod(0o500)
    try:
        found, damage = read(file)
    finally:
        file.parent.chmod(0o700)
    assert ([m.log_time_ns for m in found], damage.count) == (list(range(1, 41)), 0)
    assert all(words in damage.all_notes[0] for words in ("was not closed", "pages of bag.db3-wal were read"))
    assert {path.name: path.read_bytes() for path in file.parent.iterdir()} == before


def test_a_journal_that_is_cut_gives_what_was_committed_before_and_a_missing_one_is_named(tmp_path: Path) -> None:
    file = make_killed(tmp_path, closed=13)
    journal = file.with_name("bag.db3-wal")
    journal.write_bytes(journal.read_bytes()[: 32 + 2 * 4120 + 100])
    assert stamps(file) == list(range(1, 14)) and "bag.db3-wal" in read(file)[1].all_notes[0]
    empty = make_killed(tmp_path / "empty")
    empty.with_name("bag.db3-wal").unlink()
    expect_refusal("bag.db3-wal is missing.*; copy bag.db3-wal from where the bag was recorded", read, empty)


def test_values_of_the_wrong_type_are_counted_and_a_view_in_the_place_of_a_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.db3"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.execute("INSERT INTO topics VALUES (1, NULL, 7, x'ff')")
        rows = [(1, 1, "soon", b"x"), (2, 1, 5, "text"), (3, None, 5, b"x"), (4, 1, 5, b"good"), (5, 9, 5, b"x")]
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    found, damage = read(path)
    assert ([m.data for m in found], damage.count) == ([b"good"], 4)
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id FROM n"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("DROP TABLE messages")
        database.execute(f"CREATE VIEW messages AS {endless}")
    expect_refusal("no tables named topics and messages", open_raw_log, path)


def test_a_compressed_file_that_is_cut_gives_what_precedes(tmp_path: Path) -> None:
    packed = tmp_path / "bag.db3.zstd"
    data = zstandard.ZstdCompressor(level=1).compress((make_bag(tmp_path / "bag") / "bag.db3").read_bytes())
    packed.write_bytes(data[: len(data) * 3 // 4])
    found, damage = read(packed)
    assert 0 < len(found) < 400 and damage.count >= 1


def test_a_bomb_stops_on_disk_or_is_counted_and_a_nested_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatctrl_cli.recording.container.log_formats.FREE_BYTES", 1 << 20)
    magic, bomb, twice = b"\x89MCAP0\r\n", tmp_path / "bomb.mcap.zstd", tmp_path / "twice.zstd"
    bomb.write_bytes(zstandard.compress(magic + bytes(1 << 26)))
    found, damage = read(bomb)
    assert (found, damage.notes[0]) == ([], "bomb.mcap.zstd: unpacks to over 100 times its size")
    twice.write_bytes(zstandard.compress(zstandard.compress(magic)))
    expect_refusal("compressed twice", open_raw_log, twice)
    bag = make_bag(tmp_path / "bag", num=3, mode=CompressionMode.MESSAGE)
    with closing(sqlite3.connect(bag / "bag.db3")) as database, database:
        database.execute("UPDATE messages SET data = ? WHERE id = 2", (zstandard.compress(bytes(1 << 28)),))
    assert stamps(bag) == [1, 3] and "announces 268435456 bytes unpacked" in read(bag)[1].notes[0]

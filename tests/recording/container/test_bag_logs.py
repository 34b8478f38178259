"""Bags of ROS 1 and of ROS 2's sqlite3: whole ones give what rosbags gives, of any distribution; damaged, compressed,
split and hostile ones give what precedes or follows the damage.
"""

import os
import sqlite3
import struct
from collections.abc import Callable
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

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.unpacking import MAX_BLOCK
from splatctrl_cli.recording.container.bag_logs import Bag1Log, BagFile, Db3Log
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage
from tests.cases.container_cases import kill_recorder
from tests.recording.log.make_log import T, encoded, write_bag

STORE1 = get_typestore(Stores.ROS1_NOETIC)
COMPRESSIONS = [None, Bag1Writer.CompressionFormat.BZ2, Bag1Writer.CompressionFormat.LZ4]


def make_bag1(path: Path, compression: Bag1Writer.CompressionFormat | None = None, num: int = 60) -> Path:
    """Texts of 400 bytes on two topics, in chunks of about 2 kB."""
    text = STORE1.types["std_msgs/msg/String"]
    writer = Bag1Writer(path)
    writer.chunk_threshold = 2000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        topics = [writer.add_connection(name, "std_msgs/msg/String", typestore=STORE1) for name in ("/a", "/b")]
        for index in range(num):
            message = text(data=" ".join(str(index * k % 97) for k in range(150))[:400])
            content = STORE1.serialize_ros1(message, "std_msgs/msg/String")
            writer.write(topics[index % 2], 1_000_000_000 + index, content)
    return path


def read1(path: Path) -> tuple[list[RawMessage], Damage]:
    damage = Damage()
    return list(Bag1Log(path).messages(damage)), damage


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
    found, damage = read1(bag)
    assert plain(found) == by_rosbags(bag)
    assert len(found) == 60
    assert damage.notes == []
    assert {topic.name for topic in Bag1Log(bag).topics()} == {"/a", "/b"}
    assert [m.log_time_ns for m in Bag1Log(bag).messages(Damage(), {"/b"})] == [m.log_time_ns for m in found[1::2]]


def test_a_real_bag_gives_what_rosbags_gives(real_data: Path) -> None:
    for bag in sorted((real_data / "realsense_bag").glob("*.bag")):
        found, damage = read1(bag)
        assert sorted(plain(found)) == sorted(by_rosbags(bag))
        assert damage.notes == []


def test_an_uncompressed_chunk_gives_what_precedes_the_cut_in_it(tmp_path: Path) -> None:
    bag = make_bag1(tmp_path / "x.bag")
    chunk = [record for record in BagFile(bag).records(Damage()) if record.kind == 5][2]
    before = len(_messages(bag, up_to=chunk.offset))
    bag.write_bytes(bag.read_bytes()[: chunk.offset + 1500])
    found, damage = read1(bag)
    assert len(found) >= before + 2
    assert damage.notes[0] == f"x.bag: cut or damaged after byte {chunk.offset}"


def _messages(bag: Path, up_to: int) -> list[RawMessage]:
    cut = bag.with_name("before.bag")
    cut.write_bytes(bag.read_bytes()[:up_to])
    return read1(cut)[0]


def test_a_bag_that_is_still_written_says_that_it_has_no_index(tmp_path: Path) -> None:
    bag = make_bag1(tmp_path / "x.bag")
    data = bytearray(bag.read_bytes())
    at = data.index(b"index_pos=") + len("index_pos=")
    end = struct.unpack_from("<Q", data, at)[0]
    data[at : at + 8] = bytes(8)
    bag.write_bytes(data[:end])
    found, damage = read1(bag)
    assert len(found) == 60
    assert damage.notes == ["x.bag: has no index: cut, or still being written"]


def test_a_bag_that_ends_between_two_entries_of_its_index_is_not_whole(tmp_path: Path) -> None:
    bag = make_bag1(tmp_path / "x.bag")
    infos = [record for record in BagFile(bag).records(Damage()) if record.kind == 6]
    bag.write_bytes(bag.read_bytes()[: infos[-1].offset])
    found, damage = read1(bag)
    assert len(found) == 60
    assert damage.notes == ["x.bag: its index is not whole"]


def announcing_gigabytes(data: bytes, at: int) -> bytes:
    """With another size in the header of the chunk whose body begins at a byte."""
    place = data.rindex(b"size=", 0, at) + 5
    return data[:place] + b"\xff" * 4 + data[place + 4 :]


LEFT_OUT = "the chunk at byte {} was left out: "


@pytest.mark.parametrize(
    ("compression", "change", "note"),
    [
        *(
            (
                kind,
                lambda data, at: data[: at + 40] + bytes(40) + data[at + 80 :],
                f"{LEFT_OUT}cannot be decompressed",
            )
            for kind in COMPRESSIONS[1:]
        ),
        (
            None,
            lambda data, at: data[: at - 4] + b"\xff" * 4 + data[at:],
            "bytes {} to {} are damaged and were left out",
        ),
        (
            Bag1Writer.CompressionFormat.LZ4,
            announcing_gigabytes,
            f"{LEFT_OUT}announces {0xFFFFFFFF} bytes unpacked, at most {MAX_BLOCK} are read",
        ),
    ],
)
def test_a_damaged_chunk_costs_itself_alone(
    tmp_path: Path,
    compression: Bag1Writer.CompressionFormat | None,
    change: Callable[[bytes, int], bytes],
    note: str,
) -> None:
    bag = make_bag1(tmp_path / "x.bag", compression)
    chunks = [record for record in BagFile(bag).records(Damage()) if record.kind == 5]
    data = bag.read_bytes()
    bag.write_bytes(change(data, data.index(chunks[1].body)))
    found, damage = read1(bag)
    assert 40 < len(found) < 60
    assert damage.notes == [f"x.bag: {note.format(chunks[1].offset, chunks[2].offset)}"]


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


def read(path: Path) -> tuple[list[RawMessage], Damage]:
    damage = Damage()
    return list(open_raw_log(path).messages(damage)), damage


def test_every_real_bag_gives_what_rosbags_gives(real_data: Path) -> None:
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
        assert {t.name: t.definition for t in Db3Log(bag).topics()} == definitions
        assert damage.notes == []


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compressed_bag_and_its_file_alone_give_what_the_plain_one_gives(
    tmp_path: Path, mode: CompressionMode, plugin: StoragePlugin
) -> None:
    plain = [(m.log_time_ns, m.data) for m in read(make_bag(tmp_path / "plain", num=40))[0]]
    bag = make_bag(tmp_path / "packed", num=40, mode=mode, plugin=plugin)
    for path in (bag, next(file for file in bag.iterdir() if file.suffix != ".yaml")):
        packed, damage = read(path)
        assert [(m.log_time_ns, m.data) for m in packed] == plain
        assert damage.all_notes == []
    with Bag2Reader(bag) as reader:
        assert [(stamp, bytes(data)) for _, stamp, data in reader.messages()] == plain


@pytest.mark.parametrize("version", range(1, 10))
def test_metadata_of_every_version_is_read(tmp_path: Path, version: int) -> None:
    bag = make_bag(tmp_path / "bag", num=3)
    file = bag / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    told = content["rosbag2_bagfile_information"]
    told["version"] = version
    if version < 4:
        told["relative_file_paths"] = [f"bag/{name}" for name in told["relative_file_paths"]]
    file.write_text(yaml.safe_dump(content))
    assert len(read(bag)[0]) == 3


def test_split_files_without_metadata_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for part in (2, 10, 1):
        source = make_bag(tmp_path / f"part{part}", num=part)
        (source / f"part{part}.db3").rename(folder / f"rec_{part}.db3")
    assert [m.log_time_ns for m in read(folder)[0]] == [1, 1, 2, *range(1, 11)]


def test_a_damaged_page_costs_its_rows(tmp_path: Path) -> None:
    file = make_bag(tmp_path / "bag") / "bag.db3"
    data = bytearray(file.read_bytes())
    page = int.from_bytes(data[16:18], "big")
    at = data.index(b"    200    200") // page * page
    data[at : at + page] = os.urandom(8) * (page // 8)
    file.write_bytes(data)
    found, damage = read(file)
    stamps = [m.log_time_ns for m in found]
    assert 380 < len(stamps) < 400
    assert {1, 190, 215, 400} <= set(stamps)
    assert sorted(set(stamps)) == stamps
    assert "damaged behind message" in damage.notes[0]


def test_a_cut_file_gives_the_rows_before_the_cut(tmp_path: Path) -> None:
    file = make_bag(tmp_path / "bag") / "bag.db3"
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    found, damage = read(file)
    assert [m.log_time_ns for m in found] == list(range(1, len(found) + 1))
    assert 150 < len(found) < 400
    assert damage.count >= 1


def test_a_journal_of_nonsense_is_damage_and_the_bag_is_read_without(tmp_path: Path) -> None:
    file = make_bag(tmp_path / "bag", num=3) / "bag.db3"
    file.with_name("bag.db3-wal").write_bytes(b"rows")
    found, damage = read(file)
    assert len(found) == 3
    assert damage.notes == ["bag.db3-wal: holds no page that can be read; the bag was not closed"]


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
    assert [m.log_time_ns for m in found] == list(range(1, 41))
    assert damage.count == 0
    assert "was not closed" in damage.all_notes[0]
    assert "pages of bag.db3-wal were read" in damage.all_notes[0]
    assert {path.name: path.read_bytes() for path in file.parent.iterdir()} == before


def test_a_journal_that_ends_inside_a_page_gives_what_was_committed_before(tmp_path: Path) -> None:
    file = make_killed(tmp_path, closed=13)
    journal = file.with_name("bag.db3-wal")
    journal.write_bytes(journal.read_bytes()[: 32 + 2 * 4120 + 100])
    found, damage = read(file)
    assert [m.log_time_ns for m in found] == list(range(1, 14))
    assert "bag.db3-wal" in damage.all_notes[0]


def test_a_missing_journal_is_named_where_the_bag_is_empty_without_it(tmp_path: Path) -> None:
    file = make_killed(tmp_path)
    file.with_name("bag.db3-wal").unlink()
    with pytest.raises(InputError, match=r"bag\.db3-wal is not beside it") as caught:
        read(file)
    assert caught.value.remedy.startswith("copy bag.db3-wal from where the bag was recorded")


def test_a_view_in_the_place_of_a_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "endless.db3"
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id FROM n"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        database.execute(f"CREATE VIEW messages AS {endless}")
    with pytest.raises(InputError, match="no tables named topics and messages"):
        open_raw_log(path)


def test_values_of_the_wrong_type_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "odd.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.execute("INSERT INTO topics VALUES (1, NULL, 7, x'ff')")
        rows = [(1, 1, "soon", b"x"), (2, 1, 5, "text"), (3, None, 5, b"x"), (4, 1, 5, b"good"), (5, 9, 5, b"x")]
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    found, damage = read(path)
    assert [m.data for m in found] == [b"good"]
    assert damage.count == 4


def test_a_compressed_file_that_is_cut_gives_what_precedes(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "bag", mode=CompressionMode.FILE)
    packed = next(bag.glob("*.zstd"))
    data = zstandard.ZstdCompressor(level=1).compress(_unpacked(packed))
    packed.write_bytes(data[: len(data) * 3 // 4])
    damage = Damage()
    found = list(open_raw_log(packed).messages(damage))
    assert 0 < len(found) < 400
    assert damage.count >= 1


def _unpacked(path: Path) -> bytes:
    with path.open("rb") as stream:
        return zstandard.ZstdDecompressor().stream_reader(stream).read()


def test_a_bomb_stops_on_disk_and_a_nested_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.recording.container.log_formats.FREE_BYTES", 1 << 20)
    magic = b"\x89MCAP0\r\n"
    (tmp_path / "bomb.mcap.zstd").write_bytes(zstandard.compress(magic + bytes(1 << 26)))
    damage = Damage()
    assert list(open_raw_log(tmp_path / "bomb.mcap.zstd").messages(damage)) == []
    assert damage.notes[0] == "bomb.mcap.zstd: unpacks to over 100 times its size"
    (tmp_path / "twice.zstd").write_bytes(zstandard.compress(zstandard.compress(magic)))
    with pytest.raises(InputError, match="compressed twice"):
        open_raw_log(tmp_path / "twice.zstd")


def test_a_bomb_in_a_message_is_counted(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "bag", num=3, mode=CompressionMode.MESSAGE)
    with sqlite3.connect(bag / "bag.db3") as database:
        database.execute("UPDATE messages SET data = ? WHERE id = 2", (zstandard.compress(bytes(1 << 28)),))
    found, damage = read(bag)
    assert [m.log_time_ns for m in found] == [1, 3]
    assert "announces 268435456 bytes unpacked" in damage.notes[0]

"""ROS 1 bags without rosbags: whole ones give what rosbags gives, broken ones what precedes or follows the damage."""

import struct
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.formats.unpacking import MAX_BLOCK
from splatctrl_cli.recording.container.bag_logs import Bag1Log, BagFile
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage

STORE = get_typestore(Stores.ROS1_NOETIC)
COMPRESSIONS = [None, Bag1Writer.CompressionFormat.BZ2, Bag1Writer.CompressionFormat.LZ4]


def make_bag(path: Path, compression: Bag1Writer.CompressionFormat | None = None, num: int = 60) -> Path:
    """Texts of 400 bytes on two topics, in chunks of about 2 kB."""
    text = STORE.types["std_msgs/msg/String"]
    writer = Bag1Writer(path)
    writer.chunk_threshold = 2000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        topics = [writer.add_connection(name, "std_msgs/msg/String", typestore=STORE) for name in ("/a", "/b")]
        for index in range(num):
            message = text(data=" ".join(str(index * k % 97) for k in range(150))[:400])
            content = STORE.serialize_ros1(message, "std_msgs/msg/String")
            writer.write(topics[index % 2], 1_000_000_000 + index, content)
    return path


def read(path: Path) -> tuple[list[RawMessage], Damage]:
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
    bag = make_bag(tmp_path / "x.bag", compression)
    found, damage = read(bag)
    assert plain(found) == by_rosbags(bag)
    assert len(found) == 60
    assert damage.notes == []
    assert {topic.name for topic in Bag1Log(bag).topics()} == {"/a", "/b"}
    assert [m.log_time_ns for m in Bag1Log(bag).messages(Damage(), {"/b"})] == [m.log_time_ns for m in found[1::2]]


def test_a_real_bag_gives_what_rosbags_gives(real_data: Path) -> None:
    for bag in sorted((real_data / "realsense_bag").glob("*.bag")):
        found, damage = read(bag)
        assert sorted(plain(found)) == sorted(by_rosbags(bag))
        assert damage.notes == []


def test_an_uncompressed_chunk_gives_what_precedes_the_cut_in_it(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "x.bag")
    chunk = [record for record in BagFile(bag).records(Damage()) if record.kind == 5][2]
    before = len(_messages(bag, up_to=chunk.offset))
    bag.write_bytes(bag.read_bytes()[: chunk.offset + 1500])
    found, damage = read(bag)
    assert len(found) >= before + 2
    assert damage.notes[0] == f"x.bag: cut or damaged after byte {chunk.offset}"


def _messages(bag: Path, up_to: int) -> list[RawMessage]:
    cut = bag.with_name("before.bag")
    cut.write_bytes(bag.read_bytes()[:up_to])
    return read(cut)[0]


def test_a_bag_that_is_still_written_says_that_it_has_no_index(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "x.bag")
    data = bytearray(bag.read_bytes())
    at = data.index(b"index_pos=") + len("index_pos=")
    end = struct.unpack_from("<Q", data, at)[0]
    data[at : at + 8] = bytes(8)
    bag.write_bytes(data[:end])
    found, damage = read(bag)
    assert len(found) == 60
    assert damage.notes == ["x.bag: has no index: cut, or still being written"]


def test_a_bag_that_ends_between_two_entries_of_its_index_is_not_whole(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "x.bag")
    infos = [record for record in BagFile(bag).records(Damage()) if record.kind == 6]
    bag.write_bytes(bag.read_bytes()[: infos[-1].offset])
    found, damage = read(bag)
    assert len(found) == 60
    assert damage.notes == ["x.bag: its index is not whole"]


@pytest.mark.parametrize("compression", COMPRESSIONS[1:])
def test_a_damaged_chunk_costs_itself_alone(tmp_path: Path, compression: Bag1Writer.CompressionFormat) -> None:
    bag = make_bag(tmp_path / "x.bag", compression)
    chunks = [record for record in BagFile(bag).records(Damage()) if record.kind == 5]
    data = bytearray(bag.read_bytes())
    at = data.index(chunks[1].body)
    data[at + 40 : at + 80] = bytes(40)
    bag.write_bytes(data)
    found, damage = read(bag)
    assert 40 < len(found) < 60
    assert damage.notes == [f"x.bag: the chunk at byte {chunks[1].offset} was left out: cannot be decompressed"]


def test_a_chunk_whose_length_is_wrong_is_passed(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "x.bag")
    chunks = [record for record in BagFile(bag).records(Damage()) if record.kind == 5]
    data = bytearray(bag.read_bytes())
    at = data.index(chunks[1].body)
    data[at - 4 : at] = struct.pack("<I", 0xFFFFFFFF)
    bag.write_bytes(data)
    found, damage = read(bag)
    assert 40 < len(found) < 60
    assert damage.notes == [f"x.bag: bytes {chunks[1].offset} to {chunks[2].offset} are damaged and were left out"]


def test_a_chunk_that_announces_gigabytes_is_left_out(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "x.bag", Bag1Writer.CompressionFormat.LZ4)
    data = bytearray(bag.read_bytes())
    at = data.index(b"size=") + 5
    data[at : at + 4] = struct.pack("<I", 0xFFFFFFFF)
    bag.write_bytes(data)
    found, damage = read(bag)
    assert 40 < len(found) < 60
    assert f"announces {0xFFFFFFFF} bytes unpacked, at most {MAX_BLOCK} are read" in damage.notes[0]

"""The same recording in every container gives the same records; every kind of log is known by its bytes, and gives a
part where it is cut; and recordings of other tools are named, with what to do.
"""

import sqlite3
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.writer import CompressionType
from rosbags.convert.converter import convert
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.log_formats import (
    CONTAINERS,
    FOREIGN,
    SUFFIXES,
    Foreign,
    open_raw_log,
    refuse_foreign,
)
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.recording.source import SourceOptions, describe, open_source
from splatctrl_cli.records import JointState, Record, RgbdFrame
from tests.properties import few
from tests.recording.log.make_log import STORE, LogRecipe, make_log, messages_of, rewritten, write_bag, write_raw
from tests.refused import expect_refusal


def as_ros2_folder(log: Path, folder: Path, plugin: StoragePlugin) -> Path:
    """The messages of an MCAP as a ROS 2 bag folder."""
    return write_bag(folder, messages_of(log), plugin=plugin)


def as_ros1_bag(log: Path, path: Path) -> Path:
    """The messages of an MCAP as a ROS 1 bag, with ROS 1's message types."""
    folder = as_ros2_folder(log, path.with_suffix(".ros2"), StoragePlugin.SQLITE3)
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    convert([folder], path, "rosbag1", 0, None, "none", STORE, ros1, [], [], [], [])
    return path


def assert_same(before: list[Record], after: list[Record]) -> None:
    assert len(before) == len(after) > 0
    for a, b in zip(before, after, strict=True):
        assert (type(a), a.stamp_ns) == (type(b), b.stamp_ns)
        is_frame = isinstance(a, RgbdFrame)
        for name in ("color", "depth", "human", "valid") if is_frame else ("position", "velocity"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
        if is_frame:
            assert (a.camera, a.intrinsics) == (b.camera, b.intrinsics)
            assert b.T_world_camera == pytest.approx(a.T_world_camera, abs=1e-12)


FORMS: dict[str, Callable[[Path, Path], Path]] = {
    "ROS 2, sqlite3": partial(as_ros2_folder, plugin=StoragePlugin.SQLITE3),
    "ROS 2, MCAP": partial(as_ros2_folder, plugin=StoragePlugin.MCAP),
    "ROS 1": lambda log, path: as_ros1_bag(log, path.with_suffix(".bag")),
    "ROS 1 in MCAP": lambda log, path: write_raw(path, messages_of(as_ros1_bag(log, path.with_suffix(".bag")))),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("recipe", [LogRecipe(color_format="rgb8"), LogRecipe(cameras=("cam0", "cam1"))])
def test_a_recording_gives_the_same_records_in_every_container(tmp_path: Path, form: str, recipe: LogRecipe) -> None:
    log = make_log(tmp_path / "log.mcap", recipe)
    other = FORMS[form](log, tmp_path / "other")
    assert_same(list(open_source(log).records()), list(open_source(other).records()))
    assert describe(other).missing == ()


@pytest.mark.parametrize("text", ["a: [", "just words", "rosbag2_bagfile_information: 3", "\0", "[" * 1500, "split"])
def test_a_damaged_metadata_yaml_costs_a_note_and_the_files_go_by_their_numbers(tmp_path: Path, text: str) -> None:
    log = make_log(tmp_path / "log.mcap")
    bag = as_ros2_folder(log, tmp_path / "bag", StoragePlugin.SQLITE3)
    if text == "split":
        with_other_files(bag, "- 7")
    else:
        (bag / "metadata.yaml").write_text(text)
    source = open_source(bag)
    assert_same(list(source.records()), list(open_source(log).records()))
    said = "metadata.yaml: is not the metadata of a ROS 2 bag; read without it, files by their numbers"
    assert (source.loss.damaged, source.loss.notes) == (1, [said])


TOPICS = ("/a", "/b/c", "/d e")

Written = list[tuple[str, int, bytes]]  # topic, time [ns] and bytes of each message

TEXT = "std_msgs/msg/String"


def raw(messages: Written) -> list[RawMessage]:
    topics = {name: Topic(name=name, type_name=TEXT, encoding="cdr", definition="string data") for name in TOPICS}
    return [RawMessage(topic=topics[name], log_time_ns=stamp, data=data) for name, stamp, data in messages]


def write_mcap(path: Path, messages: Written, **options: Any) -> None:
    write_raw(path, raw(messages), **{"chunk_size": 100, "enable_data_crcs": True, **options})


def write_bag1(path: Path, messages: Written, mode: Any = CompressionMode.NONE) -> None:
    path.unlink(missing_ok=True)
    write_bag(path, raw(messages), get_typestore(Stores.ROS1_NOETIC), mode=mode)


MESSAGES = st.lists(
    st.tuples(st.sampled_from(TOPICS), st.integers(0, 2**32 - 1).map(lambda s: s * 10**9), st.binary(max_size=60)),
    min_size=1,
    max_size=20,
)


def write_db3(path: Path, messages: Written) -> None:
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
        rows = [(i, name, TEXT, "cdr") for i, name in enumerate(TOPICS)]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", rows)
        written = [(TOPICS.index(topic), stamp, data) for topic, stamp, data in messages]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", written)


WRITERS: dict[str, Callable[[Path, Written], None]] = {
    **{f"mcap {kind.name}": partial(write_mcap, compression=kind) for kind in CompressionType},
    "mcap without chunks": partial(write_mcap, use_chunking=False),
    "bag": write_bag1,
    **{f"bag {kind.name}": partial(write_bag1, mode=kind) for kind in BagWriter.CompressionFormat},
    "db3": write_db3,
}


def found_in(path: Path, names: set[str] | None = None) -> tuple[Written, int]:
    """The messages, and how much was damaged."""
    damage = Damage()
    messages = open_raw_log(path).messages(damage, names)
    return [(m.topic.name, m.log_time_ns, bytes(m.data)) for m in messages], damage.count


@pytest.mark.parametrize("name", WRITERS)
def test_what_was_written_is_read_and_cut_anywhere_a_part_of_it(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    @few(12)
    @example([("/a", 10**9, b"")], 0.99994)  # the last two bytes of a database are those of the time
    @given(MESSAGES, st.floats(0, 1))
    def check(messages: Written, share: float) -> None:
        path = tmp_path_factory.getbasetemp() / f"{name}.log"
        WRITERS[name](path, messages)
        assert found_in(path) == (messages, 0)
        assert found_in(path, {"/a"}) == ([message for message in messages if message[0] == "/a"], 0)
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


@pytest.mark.parametrize("kind", SUFFIXES)
@pytest.mark.parametrize("suffix", ["", *SUFFIXES])
def test_a_log_is_known_by_its_first_bytes(tmp_path: Path, kind: str, suffix: str) -> None:
    path, (_, opener) = tmp_path / f"x{suffix}", CONTAINERS[kind]
    WRITERS[kind[1:] if opener is not McapLog else "mcap ZSTD"](path, [("/a", 5 * 10**9, b"data")])
    assert type(open_raw_log(path)) is opener


@pytest.mark.parametrize("content", [b"hello, this is text", b""])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_log_is_refused_by_its_bytes(tmp_path: Path, suffix: str, content: bytes) -> None:
    known = f"does not begin like a {suffix} file (first bytes b'hello, t')"
    (tmp_path / f"x{suffix}").write_bytes(content)
    expect_refusal(known if content else "the file is empty (0 bytes)", open_raw_log, tmp_path / f"x{suffix}")


@pytest.mark.parametrize(("stamps", "num_frames"), [("header", 5), ("log", 4)])
def test_a_time_beyond_64_bits_costs_its_message(tmp_path: Path, stamps: str, num_frames: int) -> None:
    left = ["/joint_states", "/cam0/color/image_raw/compressed"]  # topics whose first message has MCAP's last time

    def late(message: RawMessage) -> RawMessage:
        if message.topic.name not in left:
            return message
        left.remove(message.topic.name)
        return replace(message, log_time_ns=2**64 - 1)

    notes = [f"{topic}: a time beyond 2^63 ns" for topic in left[: 6 - num_frames]]
    log = rewritten(make_log(tmp_path / "log.mcap"), tmp_path / "x.mcap", late)
    source = open_source(log, SourceOptions(stamps=stamps))
    kinds = [type(record) for record in source.records()]
    assert (kinds.count(RgbdFrame), kinds.count(JointState)) == (num_frames, 4)
    assert sorted(source.loss.notes) == sorted(notes)


@pytest.mark.parametrize(("suffix", "kind"), [(suffix, kind) for kind in FOREIGN for suffix in kind.suffixes])
def test_an_ending_names_its_format_in_either_case(tmp_path: Path, kind: Foreign, suffix: str) -> None:
    for name in (f"run{suffix}", f"run{suffix.upper()}"):
        (tmp_path / name).write_bytes(b"any content")
        assert expect_refusal(kind.what, open_source, tmp_path / name).endswith(f"; {kind.remedy}")


@pytest.mark.parametrize("kind", [kind for kind in FOREIGN if kind.magic], ids=lambda kind: kind.what)
def test_first_bytes_name_a_format_under_another_ending(tmp_path: Path, kind: Foreign) -> None:
    (tmp_path / "run.dat").write_bytes(kind.magic + bytes(5000) + kind.mark)
    for read in (open_source, describe):
        expect_refusal(kind.what, read, tmp_path / "run.dat")


@pytest.mark.parametrize("kind", [kind for kind in FOREIGN if kind.entry], ids=lambda kind: kind.what)
def test_an_entry_names_a_folder_or_a_zip_file(tmp_path: Path, kind: Foreign) -> None:
    (tmp_path / "run" / kind.entry).mkdir(parents=True)
    with zipfile.ZipFile(tmp_path / "run.bin", "w") as archive:
        archive.writestr(f"{kind.entry}0.jpg" if kind.entry.endswith("/") else kind.entry, b"x")
    for path in (tmp_path / "run", tmp_path / "run.bin"):
        expect_refusal(kind.what, describe, path)


def test_marks_inside_a_log_that_is_read_name_nothing(tmp_path: Path) -> None:
    path = make_log(tmp_path / "run.mcap")
    path.write_bytes(path.read_bytes() + b"K4A_DEPTH_DELAY_NS rgbd/")
    refuse_foreign(path)


def with_other_files(bag: Path, files: str) -> Path:
    """The bag of one file with others in its metadata."""
    file = bag / "metadata.yaml"
    file.write_text(file.read_text().replace("- bag.db3", files))
    return bag


def test_a_bag_folder_that_lacks_a_file_is_refused_and_one_named_twice_is_read_once(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap")
    bag = with_other_files(as_ros2_folder(log, tmp_path / "bag", StoragePlugin.SQLITE3), "- bag.db3\n  - bag.db3")
    assert_same(list(open_source(bag).records()), list(open_source(log).records()))
    (bag / "bag.db3").unlink()
    expect_refusal("metadata.yaml names bag.db3, which is not there", open_source, bag)

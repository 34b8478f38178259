"""The same recording in every container gives the same records."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rosbags.convert.converter import convert
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.records import JointState, Record, RgbdFrame
from tests.recording.log.make_log import STORE, LogRecipe, make_log, messages_of, write_bag, write_raw


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
        assert a.stamp_ns == b.stamp_ns
        if isinstance(a, RgbdFrame):
            assert isinstance(b, RgbdFrame)
            assert np.array_equal(a.color, b.color)
            assert np.array_equal(a.depth, b.depth)
            assert b.T_world_camera == pytest.approx(a.T_world_camera, abs=1e-12)
            assert (a.camera, a.intrinsics) == (b.camera, b.intrinsics)
            assert np.array_equal(a.human, b.human) and np.array_equal(a.valid, b.valid)
        else:
            assert isinstance(b, JointState)
            assert np.array_equal(a.position, b.position)
            assert np.array_equal(a.velocity, b.velocity)


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


def test_a_bag_folder_that_lacks_a_file_is_refused(tmp_path: Path) -> None:
    bag = as_ros2_folder(make_log(tmp_path / "log.mcap"), tmp_path / "bag", StoragePlugin.SQLITE3)
    (bag / "bag.db3").unlink()
    with pytest.raises(InputError, match=r"metadata.yaml names bag.db3, which is not there"):
        open_source(bag)


@pytest.mark.parametrize("text", ["a: [", "just words", "rosbag2_bagfile_information: 3", "\0", "[" * 9000, "split"])
def test_a_damaged_metadata_yaml_costs_a_note_and_the_files_go_by_their_numbers(tmp_path: Path, text: str) -> None:
    log = make_log(tmp_path / "log.mcap")
    whole = list(open_source(log).records())
    bag = as_ros2_folder(log, tmp_path / "bag", StoragePlugin.SQLITE3)
    file = bag / "metadata.yaml"
    file.write_text(file.read_text().replace("- bag.db3", "- 7") if text == "split" else text)
    source = open_source(bag)
    assert_same(list(source.records()), whole)
    assert source.loss.damaged == 1
    assert source.loss.notes == [
        "metadata.yaml: is not the metadata of a ROS 2 bag; read without it, files by their numbers"
    ]


def test_a_bag_that_names_a_file_twice_is_read_once(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap")
    bag = as_ros2_folder(log, tmp_path / "bag", StoragePlugin.SQLITE3)
    file = bag / "metadata.yaml"
    file.write_text(file.read_text().replace("- bag.db3", "- bag.db3\n  - bag.db3"))
    assert_same(list(open_source(bag).records()), list(open_source(log).records()))

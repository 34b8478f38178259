"""A file that shrinks while it is read costs what is gone, and that is told."""

import os
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from splatctrl_cli.captures.capture_writer import write_capture
from splatctrl_cli.errors import InputError
from splatctrl_cli.sources.source import open_source
from tests.containers.test_log_formats import as_ros2_folder
from tests.logs.make_log import LogRecipe, make_log

RECIPE = LogRecipe(num_frames=30, color_format="rgb8", has_joints=False)


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_frames_that_are_gone_from_a_log_are_counted(tmp_path: Path, kind: str) -> None:
    path = file = make_log(tmp_path / "log.mcap", RECIPE)
    if kind == "db3":
        path = as_ros2_folder(path, tmp_path / "bag", StoragePlugin.SQLITE3)
        file = path / "bag.db3"
    source = open_source(path)
    whole = sum(1 for _ in source.records())
    assert source.loss.damaged == 0
    records = source.records()
    next(records)
    os.truncate(file, file.stat().st_size // 3)
    found = 1 + sum(1 for _ in records)
    assert found < whole
    assert source.loss.damaged == 1
    assert f"{whole - found} frames that were there are gone: it changed while it was read" in source.loss.notes[-1]


@pytest.mark.parametrize("share", [0.9, 0.5, 0.0])
def test_a_frames_csv_that_shrinks_is_refused(tmp_path: Path, share: float) -> None:
    folder = tmp_path / "x.capture"
    folder.mkdir()
    write_capture(folder, open_source(make_log(tmp_path / "log.mcap", RECIPE)))
    records = open_source(folder).records()
    next(records)
    file = folder / "frames.csv"
    os.truncate(file, int(share * file.stat().st_size))
    with pytest.raises(InputError, match=r"frames.csv: changed while it was read"):
        list(records)

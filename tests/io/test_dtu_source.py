"""A DTU scan as records: which views train, which are held out."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.io.dtu import DtuView, write_dtu
from splatctrl_cli.io.dtu_source import DtuSource, view_numbers
from splatctrl_cli.records import Intrinsics, RgbdFrame


def view(number: int) -> DtuView:
    return DtuView(
        name=f"{number:08d}",
        color=np.full((48, 64, 3), number, np.uint8),
        depth=np.ones((48, 64), np.float32),
        intrinsics=Intrinsics(fx=60.0, fy=60.0, cx=32.5, cy=23.0, width=64, height=48),
        T_world_camera=np.eye(4),
    )


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dtu(tmp_path / "dtu", "scan1", [view(number) for number in range(4)])
    return tmp_path / "dtu"


def test_held_out_views_are_a_camera_of_their_own_and_stamps_are_view_numbers(root: Path) -> None:
    source = DtuSource(root, None, [1, 3])
    frames = [record for record in source.records() if isinstance(record, RgbdFrame)]
    assert [(f.camera, f.stamp_ns) for f in frames] == [("camera", 0), ("holdout", 1), ("camera", 2), ("holdout", 3)]
    assert [int(f.color[0, 0, 0]) for f in frames] == [0, 1, 2, 3]
    assert source.cameras == ("camera", "holdout")
    assert not source.has_clock
    assert source.joint_names == ()
    assert source.name == "dtu/scan1"
    assert len(source.digests()) == 16, "an image, a camera, a depth and its mask per view"


def test_without_held_out_views_there_is_one_camera(root: Path) -> None:
    assert DtuSource(root).cameras == ("camera",)


def test_a_view_that_is_not_there_and_a_split_without_training_views_are_refused(root: Path) -> None:
    with pytest.raises(UsageError, match=r"--holdout 4: .* has no such view; views: 0 to 3"):
        DtuSource(root, None, [0, 4])
    with pytest.raises(UsageError, match=r"all 4 views of .* are held out"):
        DtuSource(root, None, range(4))


def test_a_view_without_depth_is_left_out_and_counted(root: Path) -> None:
    (root / "Depths_raw" / "scan1" / "depth_map_0001.pfm").unlink()
    source = DtuSource(root, "scan1")
    assert len(list(source.records())) == 3
    assert source.loss.unpaired_color == 1
    assert source.loss.notes == ["rect_002_3_r5000.png: without depth, left out"]


def test_view_numbers_are_whole_numbers() -> None:
    assert view_numbers(["2", "5"]) == [2, 5]
    with pytest.raises(UsageError, match="expected view numbers such as 2,5, got 'two'"):
        view_numbers(["2", "two"])

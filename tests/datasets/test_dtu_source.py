"""A DTU scan as records: which views train, which are held out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.datasets.dtu import DtuView, write_dtu
from splatctrl_cli.datasets.dtu_source import DtuSource, shrunk, view_numbers
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.protocols import score_protocol
from splatctrl_cli.geometry import project
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


def test_a_view_made_smaller_sees_the_same_points_at_the_same_places() -> None:
    full = view(0)
    color = np.zeros((48, 64, 3), np.uint8)
    color[8:12, 20:24] = 200
    mask = color[:, :, 0] > 0
    small = shrunk(replace(full, color=color, mask=mask), 4)
    assert small.color.shape == (12, 16, 3)
    assert small.color[2, 5, 0] == 200
    assert small.color.sum() == 3 * 200
    assert small.mask is not None
    assert np.argwhere(small.mask).tolist() == [[2, 5]]
    center_of_patch = np.array([[21.5, 9.5]])
    point = np.column_stack([(center_of_patch - [32.5, 23.0]) / 60.0, [1.0]])
    np.testing.assert_allclose(project(full.intrinsics, point), center_of_patch)
    np.testing.assert_allclose(project(small.intrinsics, point), [[5.0, 2.0]])
    with pytest.raises(UsageError, match="--downscale 5: expected a whole factor of 64x48"):
        shrunk(full, 5)


def test_a_protocol_makes_images_as_small_as_its_published_figures_are_of(tmp_path: Path) -> None:
    big = replace(view(0), intrinsics=Intrinsics(fx=700.0, fy=700.0, cx=400.0, cy=300.0, width=800, height=600))
    big = replace(big, color=np.zeros((600, 800, 3), np.uint8), depth=np.ones((600, 800), np.float32))
    write_dtu(tmp_path, "scan1", [big] * 3)
    protocol = replace(score_protocol("holdout:1"), size=(400, 300))
    sizes = [
        {frame.color.shape for frame in source.records() if isinstance(frame, RgbdFrame)}
        for source in (
            DtuSource(tmp_path, protocol=protocol),
            DtuSource(tmp_path, protocol=protocol, downscale=1),
            DtuSource(tmp_path, protocol=replace(protocol, size=(640, 512))),
        )
    ]
    assert sizes == [{(300, 400, 3)}, {(600, 800, 3)}, {(600, 800, 3)}]


def test_a_protocol_leaves_out_what_neither_trains_nor_scores(root: Path) -> None:
    protocol = replace(score_protocol("holdout:1"), training=(3, 0))
    frames = [r for r in DtuSource(root, protocol=protocol).records() if isinstance(r, RgbdFrame)]
    assert [(f.camera, f.stamp_ns) for f in frames] == [("camera", 0), ("holdout", 1), ("camera", 3)]


def test_numbers_stay_those_of_the_files_where_a_view_lacks_depth(root: Path) -> None:
    (root / "Depths_raw" / "scan1" / "depth_map_0001.pfm").unlink()
    frames = [r for r in DtuSource(root, None, [2]).records() if isinstance(r, RgbdFrame)]
    assert [(f.camera, f.stamp_ns) for f in frames] == [("camera", 0), ("holdout", 2), ("camera", 3)]
    with pytest.raises(UsageError, match=r"--holdout 1: .* has no such view; views: 0, 2, 3"):
        DtuSource(root, None, [1])

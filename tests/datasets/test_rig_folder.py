"""Descriptions of image folders with several cameras."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.captures.capture import CaptureSource
from splatctrl_cli.captures.capture_writer import write_capture
from splatctrl_cli.datasets.image_folder import open_image_folder
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from tests.cli.test_reconstruct import write_folder
from tests.scene.wall import frame


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """Two cameras, two views each, at 5 Hz."""
    views = [frame(x=x, camera=camera) for camera, xs in (("a", (0.0, 0.1)), ("b", (0.2, 0.3))) for x in xs]
    return write_folder(tmp_path / "in", views)


def frames(path: Path, options: SourceOptions | None = None) -> list[RgbdFrame]:
    records = open_image_folder(path, options or SourceOptions()).records()
    return [record for record in records if isinstance(record, RgbdFrame)]


def test_each_camera_has_its_own_files_and_poses_by_stamp(rig: Path) -> None:
    found = frames(rig)
    assert [(f.camera, f.stamp_ns) for f in found] == [("a", 0), ("b", 0), ("a", 200_000_000), ("b", 200_000_000)]
    assert [f.T_world_camera[0, 3] for f in found] == [0.0, 0.2, 0.1, 0.3]
    source = open_image_folder(rig, SourceOptions())
    assert [pose[:2] for pose in source.poses()] == [(f.stamp_ns, f.camera) for f in found]
    assert source.has_clock
    assert len(source.digests()) == 1 + 3 * len(found)


def test_one_camera_of_several_may_be_chosen(rig: Path) -> None:
    assert {f.camera for f in frames(rig, SourceOptions(cameras=("b",)))} == {"b"}
    with pytest.raises(InputError, match="no camera 'c'; use one of: a, b"):
        frames(rig, SourceOptions(cameras=("c",)))


def test_a_pose_file_without_a_star_is_that_of_every_view(rig: Path) -> None:
    rig.write_text(rig.read_text().replace('poses = "a-*.txt"', 'poses = "a-1.txt"'))
    assert [f.T_world_camera[0, 3] for f in frames(rig) if f.camera == "a"] == [0.1, 0.1]


def test_a_capture_keeps_the_cameras_apart(rig: Path, tmp_path: Path) -> None:
    (tmp_path / "x.capture").mkdir()
    write_capture(tmp_path / "x.capture", open_image_folder(rig, SourceOptions()))
    again = [r for r in CaptureSource(tmp_path / "x.capture", SourceOptions()).records() if isinstance(r, RgbdFrame)]
    assert [(f.camera, f.stamp_ns) for f in again] == [(f.camera, f.stamp_ns) for f in frames(rig)]
    assert np.allclose([f.T_world_camera for f in again], [f.T_world_camera for f in frames(rig)])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "b"', 'name = "a"', "a name for each of its own"),
        ('name = "b"\n', "", "a name for each of its own"),
        ('color = "b-*.png"\n', "", "color is missing"),
        ("[stamps]", '[frames]\ncolor = "*"\ndepth = "*"\n[stamps]', "leave the single tables out"),
        ("[[cameras]]", "[cameras]", "expected tables|TOML|Cannot"),
        ("height = 60\n", "heigth = 60\n", "did you mean camera.height"),
    ],
)
def test_what_is_wrong_with_a_description_is_named(rig: Path, old: str, new: str, said: str) -> None:
    rig.write_text(rig.read_text().replace(old, new))
    with pytest.raises(InputError, match=said):
        frames(rig)

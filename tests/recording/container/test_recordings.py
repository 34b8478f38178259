"""Every recording of the real data is read, or refused for the reason that its SOURCE.txt gives."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from splatctrl_cli.recording.container.log_formats import is_bag_folder
from splatctrl_cli.recording.log.stored_frame import StoredFrame
from splatctrl_cli.recording.source import SourceOptions, describe, open_source
from tests.conftest import ROOT
from tests.refused import expect_refusal

EXAMPLES = ROOT / "docs" / "examples"
STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A way in: the example that describes a folder, or the path itself, and what its first frame must be."""

    path: str
    options: SourceOptions = field(default_factory=SourceOptions)
    example: str = ""
    cameras: tuple[str, ...] = ("camera",)
    size: tuple[int, int] = (640, 480)
    depth_share: tuple[float, float] = (0.2, 1.0)


HELD = ("camera", "holdout")
RECORDINGS = [
    Recording(path="apc_shelf/scene-0000", example="apc_shelf", cameras=HELD),
    Recording(path="apc_shelf/scene-0000", example="apc_shelf_raw", cameras=HELD),
    Recording(path="arc_bin_2cam", example="arc_bin_2cam", cameras=("camera-0", "camera-1")),
    Recording(path="open3d_rgbd/RGBD", example="open3d_rgbd", cameras=HELD),
    Recording(path="open3d_rgbd/RGBD"),
    Recording(path="open3d_rgbd/livingroom1", example="livingroom1", cameras=HELD),
    Recording(path="open3d_rgbd/livingroom1"),
    Recording(path="office_sun3d/fragment-1"),
    Recording(path="office_sun3d/fragment-2"),
    Recording(
        path="realsense_bag/single_depth_color_640x480.bag",
        options=SourceOptions(pairing_tolerance_s=0.11, camera_poses={"device_0": STILL}),
        cameras=("device_0",),
        depth_share=(0.9, 1.0),
    ),
    Recording(path="tabletop_views", example="tabletop_views", cameras=HELD, size=(320, 240)),
    Recording(path="tabletop_views", options=SourceOptions(depth_scale=1e-4), size=(320, 240)),
]
REFUSED = {
    "rosbag2_mcap_sensor_msgs/rosbag2_2025_09_10-13_03_56_0.mcap": "no depth topic; colour topics there: /compressed",
    "rosbag2_mcap_sensor_msgs/simple-protobuf.mcap": r"no image topics; .*MouseEvent \(json\), foxglove.PoseInFrame",
    "realsense_bag/single_depth_color_640x480.bag": "no tf for frame '0'.*give --camera-pose device_0=",
    "tabletop_d435_single": "depth is missing: images alone .* a .toml",
}


def first_stored(path: Path, options: SourceOptions) -> tuple[tuple[str, ...], StoredFrame]:
    source = open_source(path, options)
    return source.cameras, next(item for item in source.stored() if isinstance(item, StoredFrame))


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda r: r.path + " by its example" * bool(r.example))
def test_a_recording_is_read(real_data: Path, recording: Recording) -> None:
    path, options = real_data / recording.path, recording.options
    if recording.example:
        path, options = EXAMPLES / f"{recording.example}.toml", SourceOptions(root=path)
    cameras, stored = first_stored(path, options)
    frame, (low, high) = stored.frame, recording.depth_share
    assert (cameras, (frame.intrinsics.width, frame.intrinsics.height)) == (recording.cameras, recording.size)
    assert frame.color.shape[:2] == frame.depth.shape == recording.size[::-1]
    assert low < (frame.depth > 0).mean() <= high


@pytest.mark.parametrize("path", REFUSED)
def test_a_recording_that_lacks_something_says_what(real_data: Path, path: str) -> None:
    expect_refusal(REFUSED[path], open_source, real_data / path)


def test_single_views_without_poses_are_read_as_a_camera_that_stands_still(real_data: Path, tmp_path: Path) -> None:
    """Ten scenes of one view, each with its own lens: described without [poses]."""
    folder = real_data / "tabletop_d435_single"
    lenses = json.loads((folder / "intrinsics.json").read_text())
    for name, K in lenses.items():
        description = tmp_path / f"{name}.toml"
        lens = f"width = 640\nheight = 480\nfx = {K[0][0]}\nfy = {K[1][1]}\ncx = {K[0][2]}\ncy = {K[1][2]}\n"
        frames = f'[frames]\ncolor = "{name}.color.png"\ndepth = "{name}.depth.png"\n'
        description.write_text(f'root = "{folder}"\n[camera]\n{lens}{frames}')
        expect_refusal(r"\[poses\] is missing; .*--camera-pose NAME=identity", open_source, description)
        _, stored = first_stored(description, SourceOptions(camera_poses={"camera": STILL}))
        assert (stored.frame.depth > 0).mean() > 0.01  # the background was cut away
        assert stored.frame.T_world_camera[2, 2] == 1.0
    assert len(lenses) == 10


def says_wrong(path: Path) -> bool:
    return "wrong_rmw_test" in path.as_posix() and path.suffix != ".db3"


def test_every_bag_without_images_is_described_and_refused_for_that(real_data: Path) -> None:
    """Those in a format that ROS does not have say so; of the sqlite3 one only metadata.yaml does, not its file."""
    folder, num = real_data / "rosbag2_testbags", 0
    for path in sorted(folder.rglob("*")):
        is_bag = is_bag_folder(path) if path.is_dir() else path.suffix in {".db3", ".mcap"}
        if is_bag:
            reason = "got wrong_format" if says_wrong(path) else "no image topics"
            expect_refusal("holds no messages" if "empty_bag" in str(path) else reason, open_source, path)
            assert describe(path).kind.startswith("ROS 2 bag" if path.is_dir() or path.suffix == ".db3" else "MCAP")
            num += 1
    assert num >= 60


def test_every_conformance_file_is_refused_for_its_missing_images(real_data: Path) -> None:
    for path in sorted((real_data / "mcap_conformance").rglob("*.mcap")):
        reason = "expected messages in cdr, .*, got a" if "Message" in path.parent.name else "holds no messages"
        expect_refusal(reason, open_source, path)

"""`info` describes every file of the real recordings without a fault, and says what a log lacks."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.scene.voxel_file import write_occupancy
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.source import SourceOptions, describe, open_source
from splatctrl_cli.records import Label
from splatctrl_cli.voxels import SWEPT
from tests.conftest import ROOT
from tests.plain import known, plain_grid, plain_splats
from tests.recording.log.make_log import LogRecipe, make_log
from tests.refused import expect_refusal


@pytest.mark.parametrize(
    ("recipe", "said", "num"),
    [
        (LogRecipe(has_depth=False), "no depth topic", 1),
        (LogRecipe(has_tf=False), "no tf for frame 'cam0_optical'", 1),
        (LogRecipe(has_tf=False, has_info=False), "no tf for frame 'cam0_optical'", 2),
        (LogRecipe(num_frames=1, depth_delay_ns=35_000_000), "never closer than 35 ms", 1),
        (LogRecipe(num_frames=0, has_tf=False), "the log holds no messages", 1),
    ],
)
def test_all_that_a_log_lacks_is_said_and_is_no_error(tmp_path: Path, recipe: LogRecipe, said: str, num: int) -> None:
    log = make_log(tmp_path / "log.mcap", recipe)
    missing = describe(log).missing
    assert any(said in item for item in missing) and len(missing) == num, missing
    if recipe.num_frames:
        assert all("; " in item for item in missing), "each with its remedy"
        remedy = expect_refusal("", lambda: list(open_source(log).records()), has_remedy=True).partition("; ")[2]
        assert remedy in "\n".join(missing), "the one that ingest gives"


def test_a_truncated_log_is_described_up_to_the_cut(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=20))
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    summary = describe(log)
    assert summary.damaged == 1 and 0 < summary.facts["messages"] < 20 * 4 + 21


def test_a_capture_and_its_index_files_are_described(tmp_path: Path) -> None:
    folder = tmp_path / "x.capture"
    write_capture(folder, open_source(make_log(tmp_path / "log.mcap")))
    names = (".", "frames.csv", "joints.npz", "depth/cam0/000000.png")
    whole, frames, joints, depth = (describe(folder / name) for name in names)
    assert (whole.kind, whole.grids[0].rows) == ("capture", [["cam0", 5, "32x24", 30.0, 0.001]])
    assert (frames.facts["rows"], depth.facts["dtype"]) == (5, "uint16")
    assert joints.grids[0].rows[0] == ["stamp_ns", "5", "int64"]


def test_a_splat_file_is_described_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "splats.ply"
    header = "ply\nformat binary_little_endian 1.0\ncomment frame world\nelement vertex 7\n"
    properties = "".join(f"property float {name}\n" for name in ("x", "opacity", "scale_0"))
    path.write_text(f"{header}{properties}end_header\n")
    found = describe(path)
    assert (found.kind, found.facts["vertex"], found.facts["comments"]) == ("splats", 7, ["frame world"])
    assert describe(tmp_path).kind == "scene folder"


def test_a_field_folder_is_described_by_what_its_grid_covers(tmp_path: Path) -> None:
    write_ply(tmp_path / "splats.ply", plain_splats([0, 0, 0], 0.01), {})
    options = ["--box=-0.1,-0.1,-0.1,0.1,0.1,0.3", "--voxel", "0.1", "-q", "--set", "field.max_loss=1", "--no-report"]
    assert main(["sdf-bake", str(tmp_path / "splats.ply"), *options, "-o", str(tmp_path / "field")]) == 0
    summary = describe(tmp_path / "field")
    expected = {
        "shape": [3, 3, 5],
        "extent_m": [0.2, 0.2, 0.4],
        "first_cell": [-0.1, -0.1, -0.1],
        "last_cell": [0.1, 0.1, 0.3],
        "voxel": 0.1,
        "length_scale": 0.02,
        "sign": "positive outside",
        "frame": "world",
        "labels": ["human", "object"],
        "splats_used": {"object": 1, "robot": 0, "human": 0},
        "observed": "no occupancy grid: all never seen",
    }
    assert summary.kind == "field folder" and expected.items() <= summary.facts.items()


def test_what_is_no_recording_is_described_by_its_head_and_what_is_not_there_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "odd.npz", trap=np.array([{"a": 1}], dtype=object))
    assert describe(tmp_path / "odd.npz").grids[0].rows == [["trap", "1", "object"]], "named, not run"
    text = '<VTKFile type="ImageData"><ImageData WholeExtent="0 4 0 4 0 4" Spacing="0.02 0.02 0.02">'
    text += '<DataArray type="Float32" Name="sdf"/></ImageData>'
    (tmp_path / "grid.vti").write_bytes(text.encode() + b"\x00\xff_raw")
    grid = describe(tmp_path / "grid.vti")
    assert (grid.facts["Spacing"], grid.grids[0].rows) == ("0.02 0.02 0.02", [["sdf", "Float32", "1"]])
    (tmp_path / "arm.urdf").write_text('<robot name="arm"><link name="base"/></robot>')
    assert "unexpanded xacro" in describe(tmp_path / "arm.urdf").notes[0]
    (tmp_path / "arm.urdf").write_text('<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>')
    expect_refusal("not readable XML", describe, tmp_path / "arm.urdf")
    (tmp_path / "field.json").write_text('{"shape": 3}')
    (tmp_path / "run.json").write_text('{"command": "replay", "config": {"scene": {"noise": 1}}, "seed": 0}')
    run = describe(tmp_path)
    assert (run.kind, run.facts["run"]) == ("run folder", {"command": "replay", "seed": 0}), "settings are left out"
    for name in ("nothing.mcap", "none/"):
        expect_refusal("no such file or folder", describe, tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", b"hello"),
        ("a.ply", b"ply\nformat ascii 1.0\n"),
        ("a.npz", b"PK\x03\x04garbage"),
        ("a.npy", b"\x93NUMPYgarbage"),
        ("a.json", b"{"),
        ("a.urdf", b"<robot"),
        ("a.vti", b"<nothing/>"),
        ("a.vdb", b" BDV\0\0\0\0\xe0\0\0\0"),
        ("a.png", b"\x89PNG\r\n\x1a\n"),
        ("a.mcap", b"hello"),
        ("a.db3", b"SQLite format 3\x00garbage"),
        ("a.bag", b"#ROSBAG V2.0\ngarbage"),
        ("a.toml", b"[camera"),
        ("a.jsonl", b"nonsense\n"),
        ("a.yaml", b"a: [b"),
        ("a.json", b""),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name) as caught:  # of YAML in several: its parser's own words
        describe(tmp_path / name)
    assert caught.value.remedy


def test_real_recordings_are_described_and_other_encodings_listed(real_data: Path) -> None:
    folder = real_data / "rosbag2_mcap_sensor_msgs"
    ros = describe(folder / "rosbag2_2025_09_10-13_03_56_0.mcap")
    assert ros.facts["messages"] == 194 and any("no depth topic" in item for item in ros.missing)
    assert "no tf (/tf, /tf_static); record it, or give --camera-pose" in ros.missing
    web = describe(folder / "simple-protobuf.mcap")
    assert ({row[2] for row in web.grids[0].rows}, web.damaged) == ({"json", "protobuf"}, 0)
    images = describe(ROOT / "docs/examples/apc_shelf.toml", SourceOptions(root=real_data / "apc_shelf/scene-0000"))
    assert (images.kind, images.grids[0].rows) == ("image folder", [["camera", 10], ["holdout", 2]])
    robot = describe(real_data / "vamp_panda/resources/panda/panda.urdf")
    assert (robot.kind, robot.facts["movable_joints"]) == ("URDF", 7)


def test_a_scene_says_how_much_of_its_space_is_known_by_its_own_thresholds(tmp_path: Path) -> None:
    odds = np.reshape([-2.0, -2.0, -0.9, 2.0, 0.0, 0.0, 0.0, 0.0], (2, 2, 2))
    updates = np.reshape([1, 1, 1, 1, 1, 0, 0, 0], (2, 2, 2))
    entity = np.reshape([0, 0, 0, Label.HUMAN, Label.ROBOT | SWEPT, SWEPT, 0, 0], (2, 2, 2))
    grid = plain_grid((2, 2, 2), 0.1, 0.0, log_odds=odds, num_updates=updates, entity=entity)
    write_occupancy(tmp_path / "occupancy.npz", known(grid))
    (tmp_path / "splats.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nend_header\n")
    expected = {"never_seen": 0.25, "free": 0.375, "occupied": 0.125, "uncertain": 0.125, "swept_by_robot": 0.125}
    space: Any = describe(tmp_path).facts["space"]
    found = [space[name] for name in ("share", "extent_m", "robot_voxels", "human_voxels")]
    assert found == [expected, [0.2, 0.2, 0.2], 1, 1]
    (tmp_path / "run.json").write_text(json.dumps({"config": {"occupancy": {"free_below": 0.2}}}))
    assert describe(tmp_path).facts["space"]["share"] == expected | {"free": 0.25, "uncertain": 0.25}


def test_a_good_log_lacks_nothing_and_its_topics_come_with_count_rate_size_and_encoding(tmp_path: Path) -> None:
    summary = describe(make_log(tmp_path / "log.mcap"))
    assert (summary.kind, summary.missing) == ("MCAP", ())
    assert (summary.facts["tf_roots"], summary.facts["joints"]) == (["world"], ["joint_a", "joint_b"])
    topics, cameras = summary.grids[:2]
    rows = {str(row[0]): list(row[1:]) for row in topics.rows}
    color, depth = (f"32x24 {form} in frame 'cam0_optical'" for form in ("rgb8 compressed", "16UC1"))
    assert rows["/cam0/depth/image_raw"] == ["sensor_msgs/msg/Image", "cdr", 5, "10.00", depth]
    assert (cameras.rows[0][0], rows["/cam0/color/image_raw/compressed"][4]) == ("cam0", color)

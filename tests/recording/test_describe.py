"""`info` describes every file of the real recordings without a fault, and says what a log lacks."""

import json
from pathlib import Path

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
from tests.plain import known, plain_grid, plain_splats
from tests.recording.log.make_log import LogRecipe, make_log
from tests.refused import refused

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def topics_of(path: Path) -> dict[str, list[object]]:
    grid = describe(path).grids[0]
    return {str(row[0]): list(row[1:]) for row in grid.rows}


def test_a_good_log_lacks_nothing(tmp_path: Path) -> None:
    summary = describe(make_log(tmp_path / "log.mcap"))
    assert summary.kind == "MCAP"
    assert summary.missing == ()
    assert summary.facts["tf_roots"] == ["world"]
    assert summary.facts["joints"] == ["joint_a", "joint_b"]
    assert summary.grids[1].rows[0][0] == "cam0"


def test_topics_come_with_count_rate_size_and_encoding(tmp_path: Path) -> None:
    topics = topics_of(make_log(tmp_path / "log.mcap"))
    assert topics["/cam0/depth/image_raw"] == [
        "sensor_msgs/msg/Image",
        "cdr",
        5,
        "10.00",
        "32x24 16UC1 in frame 'cam0_optical'",
    ]
    assert topics["/cam0/color/image_raw/compressed"][4] == "32x24 rgb8 compressed in frame 'cam0_optical'"


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
        with pytest.raises(InputError) as refused:
            list(open_source(log).records())
        assert refused.value.remedy in "\n".join(missing), "the one that ingest gives"


def test_a_truncated_log_is_described_up_to_the_cut(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=20))
    whole = describe(log).facts["messages"]
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    summary = describe(log)
    assert summary.damaged == 1
    assert isinstance(summary.facts["messages"], int)
    assert isinstance(whole, int)
    assert 0 < summary.facts["messages"] < whole


def test_a_capture_and_its_index_files_are_described(tmp_path: Path) -> None:
    folder = tmp_path / "x.capture"
    folder.mkdir()
    write_capture(folder, open_source(make_log(tmp_path / "log.mcap")))
    summary = describe(folder)
    assert summary.kind == "capture"
    assert summary.grids[0].rows == [["cam0", 5, "32x24", 30.0, 0.001]]
    assert describe(folder / "frames.csv").facts["rows"] == 5
    assert describe(folder / "joints.npz").grids[0].rows[0] == ["stamp_ns", "5", "int64"]
    assert describe(folder / "depth/cam0/000000.png").facts["dtype"] == "uint16"


def test_a_splat_file_is_described_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "splats.ply"
    header = "ply\nformat binary_little_endian 1.0\ncomment frame world\nelement vertex 7\n"
    path.write_bytes(
        (header + "property float x\nproperty float opacity\nproperty float scale_0\nend_header\n").encode()
    )
    summary = describe(path)
    assert summary.kind == "splats"
    assert summary.facts["vertex"] == 7
    assert summary.facts["comments"] == ["frame world"]
    (tmp_path / "scene").mkdir()
    path.rename(tmp_path / "scene/splats.ply")
    assert describe(tmp_path / "scene").kind == "scene folder"


def test_a_field_folder_is_described_by_what_its_grid_covers(tmp_path: Path) -> None:
    write_ply(tmp_path / "splats.ply", plain_splats([0, 0, 0], 0.01), {})
    baked = ["--box=-0.1,-0.1,-0.1,0.1,0.1,0.3", "--voxel", "0.1", "-q", "-o", str(tmp_path / "field")]
    baked += ["--set", "field.max_loss=1"]
    assert main(["sdf-bake", str(tmp_path / "splats.ply"), *baked]) == 0
    summary = describe(tmp_path / "field")
    assert summary.kind == "field folder"
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
    assert {key: summary.facts[key] for key in expected} == expected


def test_a_folder_with_anothers_field_json_is_a_run_folder(tmp_path: Path) -> None:
    (tmp_path / "field.json").write_text('{"shape": 3}')
    (tmp_path / "run.json").write_text('{"command": "replay", "config": {"scene": {"noise": 1}}, "seed": 0}')
    summary = describe(tmp_path)
    assert summary.kind == "run folder"
    assert summary.facts["run"] == {"command": "replay", "seed": 0}, "its settings are left to info run.json"


def test_pickled_arrays_are_named_not_run(tmp_path: Path) -> None:
    path = tmp_path / "odd.npz"
    np.savez(path, trap=np.array([{"a": 1}], dtype=object))
    assert describe(path).grids[0].rows == [["trap", "1", "object"]]


def test_an_image_data_file_is_described_by_its_head(tmp_path: Path) -> None:
    path = tmp_path / "grid.vti"
    text = '<VTKFile type="ImageData"><ImageData WholeExtent="0 4 0 4 0 4" Spacing="0.02 0.02 0.02">'
    path.write_bytes((text + '<DataArray type="Float32" Name="sdf"/></ImageData>').encode() + b"\x00\xff_raw")
    summary = describe(path)
    assert summary.facts["Spacing"] == "0.02 0.02 0.02"
    assert summary.grids[0].rows == [["sdf", "Float32", "1"]]


def test_a_robot_without_joints_is_said_to_look_like_a_xacro(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text('<robot name="arm"><link name="base"/></robot>')
    assert "unexpanded xacro" in describe(path).notes[0]


def test_a_urdf_that_declares_entities_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text('<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>')
    refused("not readable XML", describe, path)


@pytest.mark.parametrize("name", ["nothing.mcap", "none/"])
def test_what_is_not_there_is_refused(tmp_path: Path, name: str) -> None:
    refused("no such file or folder", describe, tmp_path / name)


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
    with pytest.raises(InputError) as caught:
        describe(tmp_path / name)
    assert name in str(caught.value)
    assert caught.value.remedy


def test_the_sensor_message_logs_are_described_and_other_encodings_listed(real_data: Path) -> None:
    folder = real_data / "rosbag2_mcap_sensor_msgs"
    ros = describe(folder / "rosbag2_2025_09_10-13_03_56_0.mcap")
    assert ros.facts["messages"] == 194
    assert any("no depth topic" in item for item in ros.missing)
    assert "no tf (/tf, /tf_static); record it, or give --camera-pose" in ros.missing
    web = describe(folder / "simple-protobuf.mcap")
    assert {row[2] for row in web.grids[0].rows} == {"json", "protobuf"}
    assert web.damaged == 0


def test_a_real_image_folder_is_described(real_data: Path) -> None:
    options = SourceOptions(root=real_data / "apc_shelf/scene-0000")
    summary = describe(EXAMPLES / "apc_shelf.toml", options)
    assert summary.kind == "image folder"
    assert summary.grids[0].rows == [["camera", 10], ["holdout", 2]]


def test_a_scene_says_how_much_of_its_space_is_known_by_its_own_thresholds(tmp_path: Path) -> None:
    shape = (2, 2, 2)
    odds = np.reshape([-2.0, -2.0, -0.9, 2.0, 0.0, 0.0, 0.0, 0.0], shape)
    updates = np.reshape([1, 1, 1, 1, 1, 0, 0, 0], shape)
    entity = np.reshape([0, 0, 0, Label.HUMAN, Label.ROBOT | SWEPT, SWEPT, 0, 0], shape)
    grid = plain_grid(shape, 0.1, 0.0, log_odds=odds, num_updates=updates, entity=entity)
    write_occupancy(tmp_path / "occupancy.npz", known(grid))
    (tmp_path / "splats.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nend_header\n")
    expected = {"never_seen": 0.25, "free": 0.375, "occupied": 0.125, "uncertain": 0.125, "swept_by_robot": 0.125}
    space = describe(tmp_path).facts["space"]
    assert isinstance(space, dict)
    assert space["share"] == expected
    assert (space["extent_m"], space["robot_voxels"], space["human_voxels"]) == ([0.2, 0.2, 0.2], 1, 1)
    (tmp_path / "run.json").write_text(json.dumps({"config": {"occupancy": {"free_below": 0.2}}}))
    space = describe(tmp_path).facts["space"]
    assert isinstance(space, dict)
    assert space["share"] == expected | {"free": 0.25, "uncertain": 0.25}


def test_a_real_robot_is_described(real_data: Path) -> None:
    summary = describe(real_data / "vamp_panda/resources/panda/panda.urdf")
    assert summary.kind == "URDF"
    assert summary.facts["movable_joints"] == 7

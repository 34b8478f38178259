"""``splatctrl simulate``: the files it writes, the same bytes twice, and how it fails."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from splatctrl_cli.geometry import transform_from
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import SLIM, arm_urdf
from splatctrl_cli.simulate.truth import load_truth
from tests.cli.here import splatctrl

TINY = ("--duration", "0.6", "--fps", "5", "--width", "64", "--height", "48")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulate") / "run"
    result = splatctrl("simulate", "-o", out, *TINY, "--dtu", "--json")
    assert (result.returncode, result.stderr) == (0, "")
    printed = json.loads(result.stdout)
    assert printed["frames"] == {"cam0": 3, "cam1": 3, "cam2": 3, "cam3": 3}
    assert printed["bytes"]["log.mcap"] == (out / "log.mcap").stat().st_size
    return out


def test_it_writes_log_truth_robot_run_and_scan(recorded: Path) -> None:
    names = {
        ".": ["dtu", "idr", "log.mcap", "robot.urdf", "robot_spheres.yaml", "run.json", "truth.json"],
        "dtu": ["Cameras", "Depths_raw", "Rectified"],
        "idr/scan1": ["cameras_sphere.npz", "depth", "image", "mask"],
    }
    assert {place: sorted(path.name for path in (recorded / place).iterdir()) for place in names} == names
    run = json.loads((recorded / "run.json").read_text())
    assert (run["command"], run["config"]["fps"], run["metrics"]["joint_states"]) == ("simulate", 5.0, 31)


def test_the_same_command_writes_the_same_bytes(recorded: Path, tmp_path: Path) -> None:
    assert splatctrl("simulate", "-o", tmp_path / "again", *TINY, "--dtu", "-q").returncode == 0
    files = [path.relative_to(recorded) for path in recorded.rglob("*") if path.is_file() and path.name != "run.json"]
    assert len(files) > 30
    for name in files:
        assert (tmp_path / "again" / name).read_bytes() == (recorded / name).read_bytes(), name


def test_any_ros_2_reader_finds_standard_messages(recorded: Path) -> None:
    with AnyReader([recorded / "log.mcap"]) as reader:
        found = {connection.topic: (connection.msgtype, connection.msgcount) for connection in reader.connections}
    expected = {
        "/joint_states": ("sensor_msgs/msg/JointState", 31),
        "/tf": ("tf2_msgs/msg/TFMessage", 31),
        "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
    }
    for camera in ("cam0", "cam1", "cam2", "cam3"):
        expected |= {
            f"/{camera}/color/image_raw/compressed": ("sensor_msgs/msg/CompressedImage", 3),
            f"/{camera}/depth/image_raw": ("sensor_msgs/msg/Image", 3),
            f"/{camera}/color/camera_info": ("sensor_msgs/msg/CameraInfo", 3),
        }
    assert found == expected


def test_the_container_is_a_ros_2_profile_with_checksums_and_full_schemas(recorded: Path) -> None:
    with (recorded / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert all(chunk.compression == "zstd" for chunk in summary.chunk_indexes)
        assert all(schema.encoding == "ros2msg" for schema in summary.schemas.values())
        schema = next(s for s in summary.schemas.values() if s.name == "sensor_msgs/msg/CameraInfo")
        assert b"MSG: sensor_msgs/RegionOfInterest" in schema.data
        times = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_tf_places_cameras_and_links_where_the_truth_has_them(recorded: Path) -> None:
    truth = load_truth(recorded / "truth.json")
    robot = RobotModel.from_urdf(recorded / "robot.urdf", recorded / "robot_spheres.yaml")
    poses, q = {"world": np.eye(4)}, np.zeros(7)
    with AnyReader([recorded / "log.mcap"]) as reader:
        for connection, _, data in reader.messages():
            if connection.topic == "/joint_states":
                q = reader.deserialize(data, connection.msgtype).position
            if connection.msgtype != "tf2_msgs/msg/TFMessage":
                continue
            for stamped in reader.deserialize(data, connection.msgtype).transforms:
                t, r = stamped.transform.translation, stamped.transform.rotation
                parent = poses[stamped.header.frame_id]
                poses[stamped.child_frame_id] = parent @ transform_from([t.x, t.y, t.z], [r.x, r.y, r.z, r.w])
    for camera in truth.cameras:
        np.testing.assert_allclose(poses[f"{camera.name}_optical_frame"], camera.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(poses["hand"], robot.frame_pose(q, "hand"), atol=1e-9)


def test_depth_is_in_millimetres_and_camera_info_is_that_of_the_truth(recorded: Path) -> None:
    truth = load_truth(recorded / "truth.json")
    with AnyReader([recorded / "log.mcap"]) as reader:
        chosen = [c for c in reader.connections if c.topic in ("/cam1/depth/image_raw", "/cam1/color/camera_info")]
        messages = {c.topic: reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen)}
    depth, k = messages["/cam1/depth/image_raw"], truth.cameras[1].intrinsics
    found = depth.encoding, depth.width, depth.height, depth.step, depth.header.frame_id
    assert found == ("16UC1", 64, 48, 128, "cam1_optical_frame")
    millimetres = depth.data.view("<u2")
    assert 600 < np.median(millimetres[millimetres > 0]) < 2000
    np.testing.assert_array_equal(messages["/cam1/color/camera_info"].k, [k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1])


def test_a_slim_arm_with_a_tool_has_its_collision_shapes_in_the_urdf_and_the_tool_in_the_truth_alone(
    recorded: Path, tmp_path: Path
) -> None:
    out = tmp_path / "slim"
    parts = ("--slim", "--unmodelled", "tool,cable", "--noise", "stereo")
    result = splatctrl("simulate", "-o", out, *TINY, *parts, "-q")
    assert (result.returncode, result.stderr, (out / "robot.urdf").read_text()) == (0, "", arm_urdf(SLIM))
    assert (out / "robot_spheres.yaml").read_bytes() == (recorded / "robot_spheres.yaml").read_bytes()
    document = json.loads((out / "truth.json").read_text())
    assert document["clearance"]["of"] == "moving collision spheres, tool, cable to everything present but the robot"
    parts = [load_truth(folder / "truth.json").unmodelled for folder in (out, recorded)]
    assert parts == [("tool", "cable"), ()]
    config, plain = (json.loads((folder / "run.json").read_text())["config"] for folder in (out, recorded))
    assert (config["is_slim"], config["unmodelled"], config["noise"]) == (True, ["tool", "cable"], "stereo")
    assert "is_slim" not in plain


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--unmodelled", "arm"), "--unmodelled arm: expected some of: tool, cable, bracket"),
        (("--slim", "--urdf", "robot.urdf"), "--slim, --unmodelled: expected the simulated arm, got --urdf"),
    ],
)
def test_parts_of_another_arm_are_refused(tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    result = splatctrl("simulate", "-o", tmp_path / "out", *TINY, *options)
    assert result.returncode == 2 and message in result.stderr
    assert not (tmp_path / "out").exists()

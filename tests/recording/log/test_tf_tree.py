"""The tf tree: chains, time, and what it does not know; and poses as messages of their own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import quat_from_rotation, rotation_from_quat, transform_from
from splatctrl_cli.recording.log.registration import TfTree
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.recording.source_options import PoseTopic, SourceOptions
from splatctrl_cli.records import Float64, RgbdFrame
from tests.recording.log.make_log import (
    FRAME_NS,
    START_NS,
    STORE,
    LogRecipe,
    camera_x,
    encoded,
    make_log,
    messages_of,
    write_raw,
)

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
QUARTER_TURN = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])  # about z


def moving_tree() -> TfTree:
    """base moves along world x at 1 m/s for one second and turns a quarter; the camera sits 0.5 m above it."""
    tree = TfTree()
    tree.add("world", "base", 0, np.zeros(3), IDENTITY, static=False)
    tree.add("world", "base", 1_000_000_000, np.array([1.0, 0, 0]), QUARTER_TURN, static=False)
    tree.add("base", "camera", 0, np.array([0, 0, 0.5]), IDENTITY, static=True)
    return tree


def test_static_transforms_that_differ_hold_each_from_its_stamp_on() -> None:
    """A camera that was moved between two takes, in whatever order the log has them."""
    for stamps in ((10, 20, 20), (20, 20, 10)):
        tree = TfTree()
        for stamp, x in zip(stamps, (0.1, 0.3, 0.2) if stamps[0] == 10 else (0.3, 0.2, 0.1), strict=True):
            tree.add("world", "camera", stamp, np.array([x, 0, 0]), IDENTITY, static=True)
        found = [tree.lookup("world", "camera", stamp) for stamp in (0, 10, 19, 20, 99)]
        assert [None if T is None else T[0, 3] for T in found] == [0.1, 0.1, 0.1, 0.2, 0.2]
        assert tree.notes == ["tf: world -> camera is static and changes; each holds from its stamp on"]


def test_a_moving_frame_is_interpolated_and_a_static_one_holds_always() -> None:
    T = moving_tree().lookup("world", "camera", 500_000_000)
    assert T is not None
    angle = np.pi / 4
    assert T[:3, 3] == pytest.approx([0.5, 0, 0.5])
    assert T[:2, :2] == pytest.approx(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]))
    early = moving_tree().lookup("world", "camera", 200_000_000)
    assert early is not None
    assert early[:3, 3] == pytest.approx([0.2, 0, 0.5])
    assert early[1, 0] == pytest.approx(np.sin(0.2 * np.pi / 2))


def test_siblings_are_joined_through_their_common_ancestor() -> None:
    tree = moving_tree()
    tree.add("base", "lamp", 0, np.array([0.2, 0, 0]), IDENTITY, static=True)
    tree.add("base", "arm", 0, np.array([0, 0.3, 0.1]), QUARTER_TURN, static=True)
    T = tree.lookup("arm", "lamp", 777_000_000)
    assert T is not None
    assert pytest.approx(transform_from([-0.3, -0.2, -0.1], -QUARTER_TURN * [1, 1, 1, -1]), abs=1e-12) == T


def test_outside_the_recorded_time_nothing_is_known_beyond_the_tolerance() -> None:
    tree = moving_tree()
    assert tree.lookup("world", "camera", 1_030_000_000, tolerance_ns=20_000_000) is None
    assert tree.lookup("world", "camera", -30_000_000, tolerance_ns=20_000_000) is None
    late = tree.lookup("world", "camera", 1_010_000_000, tolerance_ns=20_000_000)
    assert late is not None
    assert late[:3, 3] == pytest.approx([1.0, 0, 0.5])


def test_a_long_gap_is_bridged_only_where_nothing_moved() -> None:
    tree = TfTree()
    for stamp_s, x in ((0, 0.0), (5, 0.0), (10, 1.0)):
        tree.add("world", "base", stamp_s * 1_000_000_000, np.array([x, 0, 0]), IDENTITY, static=False)
    assert tree.lookup("world", "base", 2_000_000_000) is not None
    assert tree.lookup("world", "base", 7_000_000_000) is None


def test_unconnected_frames_have_no_transform() -> None:
    tree = moving_tree()
    tree.add("map", "other", 0, np.zeros(3), IDENTITY, static=True)
    assert tree.lookup("world", "other", 0) is None
    assert tree.roots == ("map", "world")
    assert tree.root_of("camera") == "world"


def test_a_second_parent_is_noted_and_the_first_kept() -> None:
    tree = moving_tree()
    tree.add("elsewhere", "camera", 0, np.array([9.0, 9, 9]), IDENTITY, static=True)
    T = tree.lookup("world", "camera", 0)
    assert T is not None
    assert T[:3, 3] == pytest.approx([0, 0, 0.5])
    assert "camera has parents base and elsewhere" in tree.notes[0]


@pytest.mark.parametrize("bottom", ["world", "base", "camera"])
def test_a_transform_that_would_close_a_loop_is_left_out_and_noted(bottom: str) -> None:
    tree = moving_tree()
    tree.add(bottom, "world", 0, np.array([9.0, 9, 9]), IDENTITY, static=True)
    T = tree.lookup("world", "camera", 0)
    assert T is not None
    assert T[:3, 3] == pytest.approx([0, 0, 0.5])
    assert tree.roots == ("world",) and tree.connects("world", "camera")
    assert f"tf: {bottom} -> world would close a loop" in tree.notes[0]


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rigid transform"):
        TfTree().add("a", "b", 0, np.zeros(3), np.zeros(4), static=True)


def test_slerp_passes_through_the_shorter_arc() -> None:
    tree = TfTree()
    tree.add("world", "base", 0, np.zeros(3), QUARTER_TURN, static=False)
    tree.add("world", "base", 100, np.zeros(3), -QUARTER_TURN, static=False)
    T = tree.lookup("world", "base", 50)
    assert T is not None
    assert quat_from_rotation(T[:3, :3]) == pytest.approx(QUARTER_TURN)
    assert T[:3, :3] == pytest.approx(rotation_from_quat(QUARTER_TURN))


T = STORE.types
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
TRANSFORM, COVARIANCE = "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
OPTICAL = "cam0_optical"


def stamped(kind: str, index: int, parent: str, child: str) -> Any:
    """The camera of the rail at a frame, as a message."""
    stamp = START_NS + index * FRAME_NS
    time = T["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = T["std_msgs/msg/Header"](stamp=time, frame_id=parent)
    turn = T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    if kind == TRANSFORM:
        move = T["geometry_msgs/msg/Vector3"](x=camera_x(index), y=0.5, z=0.0)
        transform = T["geometry_msgs/msg/Transform"](translation=move, rotation=turn)
        return T[TRANSFORM](header=header, child_frame_id=child, transform=transform)
    position = T["geometry_msgs/msg/Point"](x=camera_x(index), y=0.5, z=0.0)
    pose = T["geometry_msgs/msg/Pose"](position=position, orientation=turn)
    if kind == POSE:
        return T[POSE](header=header, pose=pose)
    covered = T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    if kind == COVARIANCE:
        return T[COVARIANCE](header=header, pose=covered)
    zero = T["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = T["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    speed = T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    return T[ODOMETRY](header=header, child_frame_id=child, pose=covered, twist=speed)


def with_poses(tmp_path: Path, *topics: tuple[str, str, str, str], static: tuple[str, str] | None = None) -> Path:
    """A log without tf, and topics (name, type, parent, child) of the camera's poses behind its images.

    static: an edge of /tf_static, 0.2 m along y.
    """
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_tf=False, has_joints=False))
    messages = list(messages_of(log))
    for name, kind, parent, child in topics:
        poses = (stamped(kind, index, parent, child) for index in range(5))
        messages += [encoded(START_NS + index * FRAME_NS, name, pose) for index, pose in enumerate(poses)]
    if static is not None:
        edge = stamped(TRANSFORM, 0, *static)
        edge.transform.translation.x, edge.transform.translation.y = 0.0, 0.2
        messages.append(encoded(START_NS, "/tf_static", T["tf2_msgs/msg/TFMessage"](transforms=[edge])))
    return write_raw(tmp_path / "poses.mcap", messages)


def positions(path: Path, options: SourceOptions | None = None) -> Float64:
    frames = [r for r in open_source(path, options).records() if isinstance(r, RgbdFrame)]
    return np.array([frame.T_world_camera[:3, 3] for frame in frames])


RAIL = np.array([[camera_x(index), 0.5, 0.0] for index in range(5)])
ABOVE = np.array([0.0, 0.2, 0.0])


@pytest.mark.parametrize("kind", [ODOMETRY, TRANSFORM])
def test_a_topic_that_names_the_cameras_frame_places_it(tmp_path: Path, kind: str) -> None:
    path = with_poses(tmp_path, ("/vio/pose", kind, "odom", OPTICAL))
    options = SourceOptions(camera_pose_topics={"cam0": PoseTopic(topic="/vio/pose")})
    assert positions(path, options) == pytest.approx(RAIL)


@pytest.mark.parametrize("kind", [POSE, COVARIANCE])
def test_a_pose_without_a_frame_is_the_cameras_own_unless_a_person_says_otherwise(tmp_path: Path, kind: str) -> None:
    path = with_poses(tmp_path, ("/pose", kind, "map", ""), static=("rig", OPTICAL))
    rig = SourceOptions(camera_pose_topics={"cam0": PoseTopic(topic="/pose", frame="rig")})
    assert positions(path, rig) == pytest.approx(RAIL + ABOVE)
    own = SourceOptions(camera_pose_topics={"cam0": PoseTopic(topic="/pose")})
    with pytest.raises(InputError, match=f"tf has frame '{OPTICAL}' in 'rig' already; leave the option out"):
        open_source(path, own)
    (tmp_path / "free").mkdir()
    free = with_poses(tmp_path / "free", ("/pose", kind, "map", ""))
    assert positions(free, own) == pytest.approx(RAIL)


def test_an_odometry_of_a_camera_that_tf_does_not_know_is_taken_and_noted(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/vio/odom", ODOMETRY, "odom", OPTICAL))
    source = open_source(path)
    assert positions(path) == pytest.approx(RAIL)
    assert source.loss.notes == [f"poses of frame '{OPTICAL}' are those of /vio/odom: tf does not say where it is"]
    assert describe(path).missing == ()


def test_an_odometry_of_the_base_is_taken_where_its_world_is_asked_for(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/odom", ODOMETRY, "odom", "base"), static=("base", OPTICAL))
    still = open_source(path)
    assert positions(path) == pytest.approx(np.tile(ABOVE, (5, 1)))  # in the base, as tf says
    assert still.loss.notes == ["/odom says where 'base' is in 'odom'; to use it give --world-frame odom"]
    moved = positions(path, SourceOptions(world_frame="odom"))
    assert moved == pytest.approx(RAIL + ABOVE)


def test_two_odometries_of_one_frame_are_not_chosen_between(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/a", ODOMETRY, "odom", OPTICAL), ("/b", ODOMETRY, "odom", OPTICAL))
    with pytest.raises(
        InputError, match=f"2 odometries place frame '{OPTICAL}': /a, /b; choose one with --camera-pose"
    ):
        open_source(path)
    assert any("2 odometries place frame" in lack for lack in describe(path).missing)
    chosen = SourceOptions(camera_pose_topics={"cam0": PoseTopic(topic="/b")})
    assert positions(path, chosen) == pytest.approx(RAIL)


def test_topics_that_cannot_place_the_camera_are_refused_with_those_that_may(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/pose", POSE, "map", ""), ("/odom", ODOMETRY, "odom", "base"))
    with pytest.raises(
        InputError, match=r"no tf for frame .*or NAME=TOPIC\[@FRAME\] of a pose topic \(/odom, /pose\)"
    ):
        open_source(path)
    nothing = SourceOptions(camera_pose_topics={"cam0": PoseTopic(topic="/none")})
    with pytest.raises(
        InputError, match=r"no poses on that topic; expected Odometry, .*pose topics there: /odom, /pose"
    ):
        open_source(path, nothing)
    base = SourceOptions(camera_pose_topics={"cam0": PoseTopic(topic="/odom")})
    with pytest.raises(
        InputError, match=f"poses frame 'base', which tf does not join to the camera's frame '{OPTICAL}'"
    ):
        open_source(path, base)
    with pytest.raises(InputError, match="no camera 'cam9'; use one of: cam0"):
        open_source(path, SourceOptions(camera_pose_topics={"cam9": PoseTopic(topic="/pose")}))


@pytest.mark.parametrize("text", ["cam0=/pose@", "=/pose", "cam0=/pose@@"])
def test_a_pose_topic_on_the_command_line_has_a_name_and_a_topic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    path = with_poses(tmp_path, ("/pose", POSE, "map", ""))
    assert main(["ingest", str(path), "-o", str(tmp_path / "x.capture"), "--camera-pose", text]) in {2, 4}
    assert "Traceback" not in capsys.readouterr().err


def test_the_command_line_takes_a_pose_topic(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/pose", POSE, "map", ""))
    out = tmp_path / "x.capture"
    assert main(["ingest", str(path), "-o", str(out), "-q", "--camera-pose", "cam0=/pose"]) == 0
    assert positions(out) == pytest.approx(RAIL)

"""The tf tree: chains, time, and what it does not know; and poses as messages of their own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.geometry import quat_from_rotation, rotation_from_quat, transform_from
from splatctrl_cli.recording.log.registration import TfTree
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64
from tests.recording.log.make_log import (
    FRAME_NS,
    START_NS,
    LogRecipe,
    built,
    by_axis,
    camera_x,
    encoded,
    frames_of,
    header,
    make_log,
    messages_of,
    transform,
    write_raw,
)
from tests.refused import expect_refusal

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
    for share in (0.2, 0.5):
        T, angle = moving_tree().lookup("world", "camera", int(share * 1e9)), share * np.pi / 2
        assert T[:3, 3] == pytest.approx([share, 0, 0.5])
        turned = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        assert T[:2, :2] == pytest.approx(np.array(turned))


def test_siblings_are_joined_through_their_common_ancestor() -> None:
    tree = moving_tree()
    tree.add("base", "lamp", 0, np.array([0.2, 0, 0]), IDENTITY, static=True)
    tree.add("base", "arm", 0, np.array([0, 0.3, 0.1]), QUARTER_TURN, static=True)
    T = tree.lookup("arm", "lamp", 777_000_000)
    assert T is not None
    assert pytest.approx(transform_from([-0.3, -0.2, -0.1], -QUARTER_TURN * [1, 1, 1, -1]), abs=1e-12) == T
    tree.add("map", "other", 0, np.zeros(3), IDENTITY, static=True)
    assert tree.lookup("world", "other", 0) is None, "not connected"
    assert (tree.roots, tree.root_of("camera")) == (("map", "world"), "world")


def test_outside_the_recorded_time_nothing_is_known_beyond_the_tolerance() -> None:
    tree, near = moving_tree(), {"tolerance_ns": 20_000_000}
    assert tree.lookup("world", "camera", 1_030_000_000, **near) is None
    assert tree.lookup("world", "camera", -30_000_000, **near) is None
    assert tree.lookup("world", "camera", 1_010_000_000, **near)[:3, 3] == pytest.approx([1.0, 0, 0.5])


def test_a_long_gap_is_bridged_only_where_nothing_moved() -> None:
    tree = TfTree()
    for stamp_s, x in ((0, 0.0), (5, 0.0), (10, 1.0)):
        tree.add("world", "base", stamp_s * 1_000_000_000, np.array([x, 0, 0]), IDENTITY, static=False)
    assert tree.lookup("world", "base", 2_000_000_000) is not None
    assert tree.lookup("world", "base", 7_000_000_000) is None


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rigid transform"):
        TfTree().add("a", "b", 0, np.zeros(3), np.zeros(4), static=True)


def test_slerp_passes_through_the_shorter_arc() -> None:
    tree = TfTree()
    tree.add("world", "base", 0, np.zeros(3), QUARTER_TURN, static=False)
    tree.add("world", "base", 100, np.zeros(3), -QUARTER_TURN, static=False)
    T = tree.lookup("world", "base", 50)
    assert quat_from_rotation(T[:3, :3]) == pytest.approx(QUARTER_TURN)
    assert T[:3, :3] == pytest.approx(rotation_from_quat(QUARTER_TURN))


ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"

TRANSFORM, COVARIANCE = "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"

OPTICAL = "cam0_optical"


def stamped(kind: str, index: int, parent: str, child: str) -> Any:
    """The camera of the rail at a frame, as a message."""
    where, turn, head = by_axis((camera_x(index), 0.5, 0.0)), {"w": 1.0}, header(START_NS + index * FRAME_NS, parent)
    pose = {"position": where, "orientation": turn}
    fields: dict[str, Any] = {
        TRANSFORM: {"child_frame_id": child, "transform": {"translation": where, "rotation": turn}},
        POSE: {"pose": pose},
        COVARIANCE: {"pose": {"pose": pose}},
        ODOMETRY: {"pose": {"pose": pose}, "child_frame_id": child},
    }
    return built(kind, header=head, **fields[kind])


def with_poses(tmp_path: Path, *topics: tuple[str, str, str, str], static: tuple[str, str] | None = None) -> Path:
    """A log without tf, and topics (name, type, parent, child) of the camera's poses behind its images.

    static: an edge of /tf_static, 0.2 m along y.
    """
    messages = list(messages_of(make_log(tmp_path / "log.mcap", LogRecipe(has_tf=False, has_joints=False))))
    for name, kind, parent, child in topics:
        poses = (stamped(kind, index, parent, child) for index in range(5))
        messages += [encoded(START_NS + index * FRAME_NS, name, pose) for index, pose in enumerate(poses)]
    if static is not None:
        edge = transform(START_NS, *static, (0, 0.2, 0))
        messages.append(encoded(START_NS, "/tf_static", built("tf2_msgs/msg/TFMessage", transforms=[edge])))
    return write_raw(tmp_path / "poses.mcap", messages)


def positions(path: Path, options: SourceOptions | None = None) -> Float64:
    return np.array([frame.T_world_camera[:3, 3] for frame in frames_of(path, options)])


def by_topic(topic: str, frame: str = "", camera: str = "cam0") -> SourceOptions:
    return SourceOptions(camera_pose_topics={camera: (topic, frame)})


@pytest.mark.parametrize(
    ("parent", "child", "said"),
    [
        *((bottom, "world", f"tf: {bottom} -> world would close a loop") for bottom in ("world", "base", "camera")),
        ("elsewhere", "camera", "camera has parents base and elsewhere"),
    ],
)
def test_a_transform_that_would_close_a_loop_or_is_a_second_parent_is_left_out_and_noted(
    parent: str, child: str, said: str
) -> None:
    tree = moving_tree()
    tree.add(parent, child, 0, np.array([9.0, 9, 9]), IDENTITY, static=True)
    assert tree.lookup("world", "camera", 0)[:3, 3] == pytest.approx([0, 0, 0.5])
    assert "world" in tree.roots and tree.connects("world", "camera") and said in tree.notes[0]


RAIL = np.array([[camera_x(index), 0.5, 0.0] for index in range(5)])

ABOVE = np.array([0.0, 0.2, 0.0])


@pytest.mark.parametrize("kind", [ODOMETRY, TRANSFORM])
def test_a_topic_that_names_the_cameras_frame_places_it(tmp_path: Path, kind: str) -> None:
    path = with_poses(tmp_path, ("/vio/pose", kind, "odom", OPTICAL))
    assert positions(path, by_topic("/vio/pose")) == pytest.approx(RAIL)


@pytest.mark.parametrize("kind", [POSE, COVARIANCE])
def test_a_pose_without_a_frame_is_the_cameras_own_unless_a_person_says_otherwise(tmp_path: Path, kind: str) -> None:
    path = with_poses(tmp_path, ("/pose", kind, "map", ""), static=("rig", OPTICAL))
    assert positions(path, by_topic("/pose", "rig")) == pytest.approx(RAIL + ABOVE)
    said = f"tf has frame '{OPTICAL}' in 'rig' already; leave the option out"
    expect_refusal(said, open_source, path, by_topic("/pose"))
    free = with_poses(tmp_path, ("/pose", kind, "map", ""))
    assert positions(free, by_topic("/pose")) == pytest.approx(RAIL)
    out = tmp_path / "x.capture"
    assert main(["ingest", str(free), "-o", str(out), "-q", "--camera-pose", "cam0=/pose"]) == 0
    assert positions(out) == pytest.approx(RAIL)


def test_an_odometry_of_a_camera_that_tf_does_not_know_is_taken_and_noted(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/vio/odom", ODOMETRY, "odom", OPTICAL))
    assert positions(path) == pytest.approx(RAIL)
    said = f"poses of frame '{OPTICAL}' are those of /vio/odom: tf does not say where it is"
    assert open_source(path).loss.notes == [said] and describe(path).missing == ()


def test_an_odometry_of_the_base_is_taken_where_its_world_is_asked_for(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/odom", ODOMETRY, "odom", "base"), static=("base", OPTICAL))
    assert positions(path) == pytest.approx(np.tile(ABOVE, (5, 1)))  # in the base, as tf says
    said = "/odom says where 'base' is in 'odom'; to use it give --world-frame odom"
    assert open_source(path).loss.notes == [said]
    assert positions(path, SourceOptions(world_frame="odom")) == pytest.approx(RAIL + ABOVE)


def test_two_odometries_of_one_frame_are_not_chosen_between(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/a", ODOMETRY, "odom", OPTICAL), ("/b", ODOMETRY, "odom", OPTICAL))
    expect_refusal(f"2 odometries place frame '{OPTICAL}': /a, /b; choose one with --camera-pose", open_source, path)
    assert any("2 odometries place frame" in lack for lack in describe(path).missing)
    assert positions(path, by_topic("/b")) == pytest.approx(RAIL)


def test_topics_that_cannot_place_the_camera_are_refused_with_those_that_may(tmp_path: Path) -> None:
    path = with_poses(tmp_path, ("/pose", POSE, "map", ""), ("/odom", ODOMETRY, "odom", "base"))
    for options, said in (
        (None, "no tf for frame .*or NAME=TOPIC.@FRAME. of a pose topic ./odom, /pose."),
        (by_topic("/none"), "no poses on that topic; expected Odometry, .*pose topics there: /odom, /pose"),
        (by_topic("/odom"), f"poses frame 'base', which tf does not join to the camera's frame '{OPTICAL}'"),
        (by_topic("/pose", camera="cam9"), "no camera 'cam9'; use one of: cam0"),
    ):
        expect_refusal(said, open_source, path, options)


@pytest.mark.parametrize("text", ["cam0=/pose@", "=/pose", "cam0=/pose@@"])
def test_a_pose_topic_on_the_command_line_has_a_name_and_a_topic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    path = with_poses(tmp_path, ("/pose", POSE, "map", ""))
    assert main(["ingest", str(path), "-o", str(tmp_path / "x.capture"), "--camera-pose", text]) in {2, 4}
    assert "Traceback" not in capsys.readouterr().err

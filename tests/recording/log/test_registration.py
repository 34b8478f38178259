"""Depth warped into the colour camera, and lens distortion removed; the tf tree: chains, time, and what it does not
know; and poses as messages of their own.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pinocchio.rpy import rpyToMatrix

from splatctrl_cli.cli.main import main
from splatctrl_cli.geometry import invert_transform, pose_at, rotation_from_quat, transform_from
from splatctrl_cli.recording.log.registration import Lens, TfTree, undistort_lens, warp_depth
from splatctrl_cli.recording.source import SourceOptions, describe, open_source
from splatctrl_cli.records import Float64, Intrinsics
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

SMALL = Intrinsics(fx=40, fy=40, cx=19.5, cy=14.5, width=40, height=30)

LARGE = Intrinsics(fx=64, fy=64, cx=31.5, cy=23.5, width=64, height=48)


def test_the_same_camera_gives_the_same_depth() -> None:
    depth = np.random.default_rng(0).uniform(0.5, 2.0, (30, 40)).astype(np.float32)
    depth[5, 5] = 0
    assert warped(depth) == pytest.approx(depth, abs=1e-6)


def test_a_wall_fills_a_finer_color_camera_without_holes_and_is_left_out_behind_it() -> None:
    wall = np.full((30, 40), 1.5, dtype=np.float32)
    assert warped(wall, LARGE, z=0.1)[4:-4, 4:-4] == pytest.approx(1.6, abs=1e-6)
    assert not warped(wall, z=-1.7).any()


def test_a_baseline_moves_a_column_by_its_disparity() -> None:
    depth = np.zeros((30, 40), dtype=np.float32)
    depth[:, 10] = 0.8
    assert np.flatnonzero(warped(depth, x=0.1)[15]).tolist() == [10 + round(40 * 0.1 / 0.8)]


def test_the_nearest_of_two_surfaces_on_a_pixel_counts() -> None:
    depth = np.zeros((30, 40), dtype=np.float32)
    depth[15, [20, 24, 26]] = 0.5, 2.0, 2.0  # with x = 0.1: disparities of 8 and 2 px
    assert warped(depth, x=0.1)[15, [28, 26]] == pytest.approx([0.5, 2.0])


@pytest.mark.parametrize(
    ("model", "coefficients", "said"),
    [
        ("plumb_bob", [-500.0, 0, 0, 0, 0], "the camera saw 0% of the pinhole's image, expected at least 25%"),
        ("plumb_bob", [0.01, 0, 0], "plumb_bob: expected 4, 5, 8, 12, 14 coefficients, got 3; calibrate again"),
        ("equidistant", [0.01, 0, 0], "equidistant: expected 4 coefficients, got 3; calibrate again"),
    ],
)
def test_coefficients_that_no_model_has_or_that_show_hardly_anything_are_refused(
    model: str, coefficients: list[float], said: str
) -> None:
    expect_refusal(said, undistort_lens, SMALL, model, np.array(coefficients))
    image = np.random.default_rng(1).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    assert np.array_equal(undistort_lens(SMALL, "plumb_bob", np.zeros(5)).remap(image, cv2.INTER_LINEAR), image), (
        "none changes nothing"
    )
    barrel = np.array([-0.3, 0.1, 0, 0, 0])
    assert undistort_lens(SMALL, "plumb_bob", barrel).valid is None, "shows every pixel of its own pinhole"


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_distorted_point_lands_where_the_pinhole_puts_it(model: str) -> None:
    k1 = -0.3
    x, y = 0.35, 0.2  # normalised pinhole coordinates
    r = np.hypot(x, y)
    theta = np.arctan(r)
    factor = 1 + k1 * r * r if model == "plumb_bob" else theta * (1 + k1 * theta**2) / r
    big = Intrinsics(fx=400, fy=400, cx=199.5, cy=149.5, width=400, height=300)
    u, v = 400 * x * factor + 199.5, 400 * y * factor + 149.5
    columns, rows = np.meshgrid(np.arange(400), np.arange(300))
    spot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18.0)
    image = np.repeat((255 * spot).astype(np.uint8)[..., None], 3, axis=2)
    flat = undistort_lens(big, model, np.array([k1, 0, 0, 0])).remap(image, cv2.INTER_LINEAR)[..., 0].astype(float)
    found = np.array([(flat * columns).sum(), (flat * rows).sum()]) / flat.sum()
    assert found == pytest.approx([400 * x + 199.5, 400 * y + 149.5], abs=0.5)


def test_a_turned_and_zoomed_result_shows_what_the_lens_saw_there() -> None:
    """As a stereo pair is rectified: the result's axes are turned from the lens's, its focal length is shorter."""
    R = rpyToMatrix(0.02, -0.1, 0.05)
    result = replace(LARGE, fx=0.8 * LARGE.fx, fy=0.8 * LARGE.fy)
    seen = undistort_lens(result, "plumb_bob", np.array([0.1, 0, 0, 0, 0]), recorded=LARGE, R=R).valid
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    rays = np.stack([(u - result.cx) / result.fx, (v - result.cy) / result.fy, np.ones(u.shape)], axis=2)
    x, y, z = np.moveaxis(rays @ R, 2, 0)  # R leads from the lens's axes to the result's
    x, y = x / z, y / z
    bent = 1 + 0.1 * (x * x + y * y)
    column, row = LARGE.fx * x * bent + LARGE.cx, LARGE.fy * y * bent + LARGE.cy
    assert np.array_equal(seen, (column >= 0) & (column <= 63) & (row >= 0) & (row <= 47))


@pytest.mark.parametrize(
    ("model", "coefficients", "turns_at"),
    [
        ("plumb_bob", [-0.3, 0, 0, 0, 0], np.sqrt(1 / 0.9)),  # d(r - 0.3 r^3)/dr = 0
        ("equidistant", [-0.3, 0, 0, 0], np.tan(np.sqrt(1 / 0.9))),
        ("rational_polynomial", [0, 0, 0, 0, 0, 1.0, 0, 0], 1.0),  # r / (1 + r^2)
    ],
)
def test_where_a_polynomial_turns_back_nothing_is_shown_twice(
    model: str, coefficients: list[float], turns_at: float
) -> None:
    wide = Intrinsics(fx=16, fy=16, cx=31.5, cy=23.5, width=64, height=48)
    valid = undistort_lens(wide, model, np.array(coefficients, dtype=float)).valid
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    assert np.array_equal(valid, np.hypot((u - wide.cx) / wide.fx, (v - wide.cy) / wide.fy) < turns_at)


def test_the_depth_cameras_own_lens_is_undone_before_its_depth_is_registered() -> None:
    """A distorted column of depth becomes straight."""
    k1 = 0.3
    own = undistort_lens(LARGE, "plumb_bob", np.array([k1, 0, 0, 0, 0]))
    x = 0.25
    y = np.linspace(-0.3, 0.3, 400)
    factor = 1 + k1 * (x * x + y * y)
    bent = np.zeros((48, 64), np.float32)
    row, column = np.rint(LARGE.fy * y * factor + LARGE.cy), np.rint(LARGE.fx * x * factor + LARGE.cx)
    bent[row.astype(int), column.astype(int)] = 1.0
    warp = Lens(intrinsics=LARGE, depth_lens=own, T_color_depth=np.eye(4))
    assert np.abs(np.nonzero(warp.depth(bent))[1] - (LARGE.fx * x + LARGE.cx)).max() <= 1.0


def warped(depth: np.ndarray[Any, Any], color: Intrinsics = SMALL, **shift: float) -> np.ndarray[Any, Any]:
    """Depth of the small camera in a colour camera that is moved along x and z [m]."""
    return warp_depth(depth, SMALL, color, pose_at([shift.get("x", 0.0), 0, shift.get("z", 0.0)]))


IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])

QUARTER_TURN = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])  # about z


def moving_tree() -> TfTree:
    """base moves along world x at 1 m/s for one second and turns a quarter; the camera sits 0.5 m above it."""
    tree = TfTree()
    tree.add("world", "base", 0, np.zeros(3), IDENTITY, static=False)
    tree.add("world", "base", 1_000_000_000, np.array([1.0, 0, 0]), QUARTER_TURN, static=False)
    tree.add("base", "camera", 0, np.array([0, 0, 0.5]), IDENTITY, static=True)
    return tree


@pytest.mark.parametrize("samples", [((10, 0.1), (20, 0.3), (20, 0.2)), ((20, 0.3), (20, 0.2), (10, 0.1))])
def test_static_transforms_that_differ_hold_each_from_its_stamp_on(samples: tuple[tuple[int, float], ...]) -> None:
    """A camera that was moved between two takes, in whatever order the log has them."""
    tree = TfTree()
    for stamp, x in samples:
        tree.add("world", "camera", stamp, np.array([x, 0, 0]), IDENTITY, static=True)
    found = [tree.lookup("world", "camera", stamp)[0, 3] for stamp in (0, 10, 19, 20, 99)]
    said = "tf: world -> camera is static and changes; each holds from its stamp on"
    assert (found, tree.notes) == ([0.1, 0.1, 0.1, 0.2, 0.2], [said])


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
    expected = transform_from([-0.3, -0.2, -0.1], -QUARTER_TURN * [1, 1, 1, -1])
    assert tree.lookup("arm", "lamp", 777_000_000) == pytest.approx(expected, abs=1e-12)
    tree.add("map", "other", 0, np.zeros(3), IDENTITY, static=True)
    assert tree.lookup("world", "other", 0) is None, "not connected"
    assert (tree.roots, tree.root_of("camera")) == (("map", "world"), "world")


def test_still_frames_have_one_pose_for_the_whole_log() -> None:
    """The lamp hangs on a mount that a driver publishes again and again; the camera moves with the base."""
    tree = moving_tree()
    for stamp in (0, 500_000_000, 9_000_000_000):
        tree.add("world", "mount", stamp, np.array([0, 0, 2.0]), QUARTER_TURN, static=False)
    tree.add("mount", "lamp", 0, np.array([0.1, 0, 0]), IDENTITY, static=True)
    tree.add("elsewhere", "other", 0, np.zeros(3), IDENTITY, static=True)
    frames = tree.still_frames("world")
    assert (frames["base"], frames["camera"], frames.keys() & {"other", "elsewhere"}) == (None, None, set())
    assert frames["lamp"] == pytest.approx(transform_from([0, 0.1, 2.0], QUARTER_TURN), abs=1e-12)
    assert frames["world"] == pytest.approx(np.eye(4))
    assert tree.still_frames("lamp")["world"] == pytest.approx(invert_transform(frames["lamp"]), abs=1e-12)


def test_outside_the_recorded_time_nothing_is_known_beyond_the_tolerance() -> None:
    tree, near = moving_tree(), {"tolerance_ns": 20_000_000}
    assert [tree.lookup("world", "camera", stamp, **near) for stamp in (1_030_000_000, -30_000_000)] == [None, None]
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
    assert tree.lookup("world", "base", 50)[:3, :3] == pytest.approx(rotation_from_quat(QUARTER_TURN))


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
    said = f"poses of frame '{OPTICAL}' are those of /vio/odom: tf does not say where it is"
    assert positions(path) == pytest.approx(RAIL)
    assert (open_source(path).loss.notes, describe(path).missing) == ([said], ())


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

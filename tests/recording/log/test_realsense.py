"""Bags of the RealSense SDK: depth unit and extrinsics from their topics, depth registered to colour."""

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform, quat_from_rotation, transform_from
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from tests.recording.log.make_log import encoded, write_bag

STORE = get_typestore(Stores.ROS1_NOETIC)
T = STORE.types
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
T_COLOR_REFERENCE = transform_from([0.02, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
T_DEPTH_REFERENCE = transform_from([-0.03, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
DEPTH_M, UNIT = 1.2, 0.0005
COLOR, DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
STILL = SourceOptions(camera_poses={"device_0": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)})


def header(stamp_ns: int = 0, frame: str = "") -> Any:
    time = T["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return T["std_msgs/msg/Header"](seq=0, stamp=time, frame_id=frame)


def image(encoding: str, pixels: np.ndarray[Any, Any], stamp_ns: int) -> Any:
    data = np.frombuffer(pixels.tobytes() + bytes(10), np.uint8)  # the SDK leaves bytes behind the last row
    return T["sensor_msgs/msg/Image"](
        header=header(stamp_ns, "0"),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=data,
    )


def info() -> Any:
    roi = T["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return T["sensor_msgs/msg/CameraInfo"](
        header=header(),
        height=HEIGHT,
        width=WIDTH,
        distortion_model="Brown Conrady",
        D=np.zeros(5),
        K=np.array([FOCAL, 0, 31.5, 0, FOCAL, 23.5, 0, 0, 1]),
        R=np.zeros(9),
        P=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def transform(matrix: np.ndarray[Any, Any]) -> Any:
    x, y, z = (float(v) for v in matrix[:3, 3])
    qx, qy, qz, qw = (float(v) for v in quat_from_rotation(matrix[:3, :3]))
    return T["geometry_msgs/msg/Transform"](
        translation=T["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
        rotation=T["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
    )


def make_bag(path: Path, *, with_extrinsics: bool = True, units: tuple[float, ...] = ()) -> Path:
    """A wall at DEPTH_M with a pole before it, seen by a depth sensor 5 cm left of the colour sensor.

    units: what the depth images say of themselves, as newer SDKs write it.
    """
    counts = np.full((HEIGHT, WIDTH), round(DEPTH_M / UNIT), "<u2")
    counts[:, 30:34] = round(0.6 / UNIT)
    messages: list[tuple[int, str, Any]] = [
        (0, f"{DEPTH}/info/camera_info", info()),
        (0, f"{COLOR}/info/camera_info", info()),
        (0, "/device_0/sensor_0/option/Depth Units/value", T["std_msgs/msg/Float32"](data=float(np.float32(UNIT)))),
        (0, "/device_0/sensor_0/option/Exposure/value", T["std_msgs/msg/Float32"](data=8500.0)),
    ]
    if with_extrinsics:
        messages.append((0, f"{DEPTH}/tf/0", transform(T_DEPTH_REFERENCE)))
        messages.append((0, f"{COLOR}/tf/0", transform(T_COLOR_REFERENCE)))
    for index in range(2):
        stamp = 5_000_000_000 + index * 100_000_000
        messages.append((stamp, f"{DEPTH}/image/data", image("mono16", counts, stamp)))
        grey = np.zeros((HEIGHT, WIDTH), np.uint8)
        messages.append((stamp, "/device_0/sensor_0/Infrared_1/image/data", image("mono8", grey, stamp)))
        rgb = np.full((HEIGHT, WIDTH, 3), 40 + index, np.uint8)
        messages.append((stamp, f"{COLOR}/image/data", image("rgb8", rgb, stamp)))
    written = [encoded(max(time, 1), topic, m, STORE, ros=1) for time, topic, m in messages]
    if units:
        of_depth = iter(units)
        written = [
            message if message.topic.type_name != "sensor_msgs/msg/Image" else with_unit(message, of_depth)
            for message in written
        ]
    return write_bag(path, written, STORE)


def with_unit(message: RawMessage, units: Iterator[float]) -> RawMessage:
    """As newer SDKs write it: the frame "1", and behind the message the unit of depth, 0 of other images."""
    unit = next(units) if "Depth_0" in message.topic.name else 0.0
    assert message.data[12:17] == b"\x01\x00\x00\x000"
    return replace(message, data=message.data[:16] + b"1" + message.data[17:] + struct.pack("<f", unit))


def test_depth_is_registered_by_the_extrinsics_and_counted_in_its_own_unit(tmp_path: Path) -> None:
    source = open_source(make_bag(tmp_path / "rs.bag"), STILL)
    frames = [record for record in source.records() if isinstance(record, RgbdFrame)]
    assert [int(frame.color[0, 0, 0]) for frame in frames] == [40, 41]  # colour, not the infrared beside the depth
    depth = frames[0].depth
    shift = FOCAL * 0.05  # [px m]: colour lies 5 cm from depth along x
    assert np.unique(depth[depth > 0]) == pytest.approx([0.6, DEPTH_M], rel=1e-6)
    near = np.flatnonzero(depth[24] == depth[depth > 0].min())
    assert (near[0], near[-1]) == (30 + shift / 0.6, 33 + shift / 0.6)
    assert frames[0].T_world_camera.tolist() == np.eye(4).tolist()
    assert source.loss.damaged == 0
    assert source.loss.notes == [
        "camera device_0: stands still where --camera-pose puts it, not where the recording may say"
    ]


def test_without_a_pose_the_camera_that_stands_still_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no tf for frame '0'.*give --camera-pose device_0="):
        open_source(make_bag(tmp_path / "rs.bag"))


def test_without_extrinsics_equal_lenses_count_as_registered(tmp_path: Path) -> None:
    source = open_source(make_bag(tmp_path / "rs.bag", with_extrinsics=False), STILL)
    frame = next(record for record in source.records() if isinstance(record, RgbdFrame))
    assert frame.depth[24, 31] == np.float32(0.6)


def test_a_depth_scale_that_a_person_gives_comes_first(tmp_path: Path) -> None:
    options = SourceOptions(camera_poses=STILL.camera_poses, depth_scale=1e-3)
    frame = next(r for r in open_source(make_bag(tmp_path / "rs.bag"), options).records() if isinstance(r, RgbdFrame))
    assert frame.depth.max() == pytest.approx(2 * DEPTH_M)


def test_images_of_newer_bags_say_their_depth_unit_which_comes_before_the_options(tmp_path: Path) -> None:
    old = open_source(make_bag(tmp_path / "old.bag"), STILL)
    path = make_bag(tmp_path / "new.bag", units=(2 * UNIT, 2 * UNIT))
    new = open_source(path, STILL)
    pairs = list(zip(old.records(), new.records(), strict=True))
    assert len(pairs) == 2
    for before, after in pairs:
        assert isinstance(before, RgbdFrame) and isinstance(after, RgbdFrame)
        assert np.array_equal(before.color, after.color)
        assert after.depth.max() == pytest.approx(2 * before.depth.max())
    assert new.loss.damaged == 0
    checked = check_log(open_raw_log(path), STILL)
    assert max(frame.depth.max() for frame in checked.frames) == pytest.approx(2 * DEPTH_M)


def test_a_depth_unit_that_changes_in_one_bag_is_refused(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "rs.bag", units=(UNIT, 0.001))
    with pytest.raises(InputError, match=r"the depth unit changes, from 0.0005 to 0.001 m; cut the bag there"):
        open_source(path, STILL)
    options = SourceOptions(camera_poses=STILL.camera_poses, depth_scale=UNIT)
    assert len(list(open_source(path, options).records())) == 2


@pytest.mark.parametrize("unit", [float("nan"), -0.001, 7.0])
def test_a_depth_unit_that_is_none_is_damage(tmp_path: Path, unit: float) -> None:
    found = survey(open_raw_log(make_bag(tmp_path / "rs.bag", units=(unit, unit))))
    assert "expected metres per count" in found.damage.notes[0]


def test_the_edges_of_a_real_recording_meet_only_this_way_round(real_data: Path) -> None:
    """Measured: mean gradient of colour along the edges of depth is 2.4 of the image's, 0.4 in other readings."""
    path = real_data / "realsense_bag/single_depth_color_640x480.bag"
    found = survey(open_raw_log(path))
    between = found.realsense.T_between(f"{COLOR}/image/data", f"{DEPTH}/image/data")
    assert between is not None
    assert found.realsense.depth_unit(f"{DEPTH}/image/data") == 0.001
    with pytest.raises(InputError, match=r"no colour and depth image within 20 ms.*--pairing-tolerance 0.103"):
        open_source(path, STILL)
    options = SourceOptions(camera_poses=STILL.camera_poses, pairing_tolerance_s=0.103)
    frame = next(record for record in open_source(path, options).records() if isinstance(record, RgbdFrame))
    assert (frame.depth > 0).mean() > 0.9
    scores = {
        name: edge_score(frame, matrix) for name, matrix in (("as read", np.eye(4)), ("inverse", _twice(between)))
    }
    assert scores["as read"] > 1.5
    assert scores["inverse"] < 0.75


def _twice(between: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """From depth registered by `between` to depth registered by its inverse."""
    inverse = invert_transform(between)
    return inverse @ inverse


def edge_score(frame: RgbdFrame, T_new_old: np.ndarray[Any, Any]) -> float:
    from splatctrl_cli.recording.log.registration import DepthToColor

    warp = DepthToColor(depth_intrinsics=frame.intrinsics, color_intrinsics=frame.intrinsics, T_color_depth=T_new_old)
    depth = warp.warp(frame.depth)
    window = np.ones((9, 9), np.uint8)
    edge = cv2.dilate(depth, window) - cv2.erode(np.where(depth > 0, depth, np.float32(99)), window) > 0.2
    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    gradient = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    gradient = cv2.GaussianBlur(gradient, (0, 0), 1.5)
    return float(gradient[edge].mean() / gradient.mean())

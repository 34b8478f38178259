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
from splatctrl_cli.geometry import invert_transform, quat_from_rotation, transform_from
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import RawMessage
from splatctrl_cli.recording.log.registration import warp_depth
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.source import SourceOptions, open_source
from splatctrl_cli.records import RgbdFrame
from tests.recording.log.make_log import built, by_axis, camera_info, encoded, frames_of, image, write_bag
from tests.refused import expect_refusal

STORE = get_typestore(Stores.ROS1_NOETIC)

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0

T_COLOR_REFERENCE = transform_from([0.02, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])

T_DEPTH_REFERENCE = transform_from([-0.03, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])

DEPTH_M, UNIT = 1.2, 0.0005

COLOR, DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"

STILL = SourceOptions(camera_poses={"device_0": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)})


def make_bag(path: Path, *, with_extrinsics: bool = True, units: tuple[float, ...] = ()) -> Path:
    """A wall at DEPTH_M with a pole before it, seen by a depth sensor 5 cm left of the colour sensor.

    units: what the depth images say of themselves, as newer SDKs write it.
    """
    counts = np.full((HEIGHT, WIDTH), round(DEPTH_M / UNIT), np.uint16)
    counts[:, 30:34] = round(0.6 / UNIT)
    lens = (FOCAL, FOCAL, 31.5, 23.5)
    info = camera_info(
        0, "", (WIDTH, HEIGHT), lens, store=STORE, d=np.zeros(5), r=None, distortion_model="Brown Conrady"
    )
    messages: list[tuple[int, str, Any]] = [
        (0, f"{DEPTH}/info/camera_info", info),
        (0, f"{COLOR}/info/camera_info", info),
        (0, "/device_0/sensor_0/option/Depth Units/value", built("std_msgs/msg/Float32", STORE, data=UNIT)),
        (0, "/device_0/sensor_0/option/Exposure/value", built("std_msgs/msg/Float32", STORE, data=8500.0)),
    ]
    for topic, T in ((DEPTH, T_DEPTH_REFERENCE), (COLOR, T_COLOR_REFERENCE)) if with_extrinsics else ():
        moved = {"translation": by_axis(T[:3, 3]), "rotation": by_axis(quat_from_rotation(T[:3, :3]))}
        messages.append((0, f"{topic}/tf/0", built("geometry_msgs/msg/Transform", STORE, **moved)))
    for index in range(2):
        stamp = 5_000_000_000 + index * 100_000_000
        grey, rgb = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH, 3), 40 + index, np.uint8)
        infrared = DEPTH.replace("Depth_0", "Infrared_1")
        for topic, form, pixels in ((DEPTH, "mono16", counts), (infrared, "mono8", grey), (COLOR, "rgb8", rgb)):
            seen = image(stamp, "0", form, pixels, store=STORE)
            seen.data = np.append(seen.data, np.zeros(10, np.uint8))  # the SDK leaves bytes behind the last row
            messages.append((stamp, f"{topic}/image/data", seen))
    written = [encoded(max(time, 1), topic, m, STORE, ros=1) for time, topic, m in messages]
    if units:
        of_depth = iter(units)
        written = [with_unit(m, of_depth) if m.topic.name.endswith("image/data") else m for m in written]
    return write_bag(path, written, STORE)


def with_unit(message: RawMessage, units: Iterator[float]) -> RawMessage:
    """As newer SDKs write it: the frame "1", and behind the message the unit of depth, 0 of other images."""
    unit = next(units) if "Depth_0" in message.topic.name else 0.0
    assert message.data[12:17] == b"\x01\x00\x00\x000"
    return replace(message, data=message.data[:16] + b"1" + message.data[17:] + struct.pack("<f", unit))


def test_depth_is_registered_by_the_extrinsics_and_counted_in_its_own_unit(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "rs.bag")
    expect_refusal("no tf for frame '0'.*give --camera-pose device_0=", open_source, path)
    source = open_source(path, STILL)
    frames = frames_of(source)
    assert [int(frame.color[0, 0, 0]) for frame in frames] == [40, 41]  # colour, not the infrared beside the depth
    depth, shift = frames[0].depth, FOCAL * 0.05  # [px m]: colour lies 5 cm from depth along x
    assert np.unique(depth[depth > 0]) == pytest.approx([0.6, DEPTH_M], rel=1e-6)
    near = np.flatnonzero(depth[24] == depth[depth > 0].min())
    assert (near[0], near[-1]) == (30 + shift / 0.6, 33 + shift / 0.6)
    said = "camera device_0: is fixed where --camera-pose puts it, not where the recording may say"
    pose = frames[0].T_world_camera.tolist()
    assert (source.loss.damaged, source.loss.notes, pose) == (0, [said], np.eye(4).tolist())
    scaled = frames_of(path, replace(STILL, depth_scale=1e-3))
    assert scaled[0].depth.max() == pytest.approx(2 * DEPTH_M), "what a person gives comes first"
    alone = frames_of(make_bag(tmp_path / "alone.bag", with_extrinsics=False), STILL)
    assert alone[0].depth[24, 31] == np.float32(0.6), "equal lenses without extrinsics count as registered"


def test_images_of_newer_bags_say_their_depth_unit_which_comes_before_the_options(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "new.bag", units=(2 * UNIT, 2 * UNIT))
    new = open_source(path, STILL)
    for before, after in zip(frames_of(make_bag(tmp_path / "old.bag"), STILL), frames_of(new), strict=True):
        assert np.array_equal(before.color, after.color)
        assert after.depth.max() == pytest.approx(2 * before.depth.max())
    assert new.loss.damaged == 0
    checked = check_log(open_raw_log(path), STILL)
    assert max(frame.depth.max() for frame in checked.frames) == pytest.approx(2 * DEPTH_M)


def test_a_depth_unit_that_changes_in_one_bag_is_refused_and_one_that_is_none_is_damage(tmp_path: Path) -> None:
    path = make_bag(tmp_path / "rs.bag", units=(UNIT, 0.001))
    expect_refusal("the depth unit changes, from 0.0005 to 0.001 m; cut the bag there", open_source, path, STILL)
    assert len(frames_of(path, replace(STILL, depth_scale=UNIT))) == 2
    for unit in (float("nan"), -0.001, 7.0):
        found = survey(open_raw_log(make_bag(tmp_path / "none.bag", units=(unit, unit))))
        assert "expected metres per count" in found.damage.notes[0]
        (tmp_path / "none.bag").unlink()


def test_the_edges_of_a_real_recording_meet_only_this_way_round(real_data: Path) -> None:
    """Measured: mean gradient of colour along the edges of depth is 2.4 of the image's, 0.4 in other readings."""
    path = real_data / "realsense_bag/single_depth_color_640x480.bag"
    found = survey(open_raw_log(path)).realsense
    inverse = invert_transform(found.T_between(f"{COLOR}/image/data", f"{DEPTH}/image/data"))
    assert found.depth_unit(f"{DEPTH}/image/data") == 0.001
    expect_refusal("no colour and depth image within 20 ms.*--pairing-tolerance 0.103", open_source, path, STILL)
    frame = frames_of(path, replace(STILL, pairing_tolerance_s=0.103))[0]
    assert (frame.depth > 0).mean() > 0.9
    assert edge_score(frame, np.eye(4)) > 1.5
    assert edge_score(frame, inverse @ inverse) < 0.75, "as registered by the inverse"


def edge_score(frame: RgbdFrame, T_new_old: np.ndarray[Any, Any]) -> float:
    depth = warp_depth(frame.depth, frame.intrinsics, frame.intrinsics, T_new_old)
    window = np.ones((9, 9), np.uint8)
    edge = cv2.dilate(depth, window) - cv2.erode(np.where(depth > 0, depth, np.float32(99)), window) > 0.2
    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    gradient = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    gradient = cv2.GaussianBlur(gradient, (0, 0), 1.5)
    return float(gradient[edge].mean() / gradient.mean())

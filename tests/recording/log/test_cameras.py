"""Cameras found in the topic names that real drivers use, and what names of topics say of their images."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log.cameras import find_cameras
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from splatctrl_cli.recording.log.image_names import DEPTH, is_other, word_of
from splatctrl_cli.recording.log.messages import ImageMessage
from splatctrl_cli.recording.log.survey import Calibration, Survey, TopicSurvey
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions
from tests.recording.log.make_log import LogRecipe, Message, T, broken_log, make_log, messages_of, write_raw


@dataclass(frozen=True, kw_only=True)
class Has:
    """A topic of the pretended log; a focal length makes it a CameraInfo."""

    name: str
    encoding: str = "rgb8"
    size: tuple[int, int] = (640, 480)
    frame: str = "optical"
    focal: float = 0.0


def log_with(*topics: Has) -> Survey:
    survey = Survey()
    for has in topics:
        compressed = b"" if has.name.endswith("compressed") else None
        kind = CAMERA_INFO if has.focal else IMAGE if compressed is None else COMPRESSED_IMAGE
        entry = TopicSurvey(topic=Topic(name=has.name, type_name=kind, encoding="cdr"), count=1)
        if has.focal:
            K = np.array([[has.focal, 0, 320], [0, has.focal, 240], [0, 0, 1.0]])
            entry.calibration = Calibration(
                width=has.size[0],
                height=has.size[1],
                K=K,
                projection=np.zeros((3, 3)),
                rotation=np.zeros((3, 3)),
                distortion_model="plumb_bob",
                distortion=np.zeros(5),
                frame_id=has.frame,
            )
        else:
            width, height = has.size
            entry.first_image = ImageMessage(
                stamp_ns=0,
                frame_id=has.frame,
                encoding=has.encoding,
                width=width,
                height=height,
                decode=partial(np.zeros, (height, width), np.uint8),
                compressed=compressed,
            )
        survey.topics[has.name] = entry
    return survey


def test_a_realsense_prefers_depth_aligned_to_colour_and_colour_to_infrared() -> None:
    (camera,) = find_cameras(
        log_with(
            Has(name="/camera/camera/color/image_raw"),
            Has(name="/camera/camera/color/image_raw/compressed"),
            Has(name="/camera/camera/color/camera_info", focal=615),
            Has(name="/camera/camera/depth/image_rect_raw", encoding="16UC1", frame="depth"),
            Has(name="/camera/camera/depth/camera_info", focal=390, frame="depth"),
            Has(name="/camera/camera/aligned_depth_to_color/image_raw", encoding="16UC1"),
            Has(name="/camera/camera/aligned_depth_to_color/camera_info", focal=615),
            Has(name="/camera/camera/infra1/image_rect_raw", encoding="mono8", frame="infra"),
        )
    )
    assert camera.name == "camera"
    assert camera.color == "/camera/camera/color/image_raw"
    assert camera.depth == "/camera/camera/aligned_depth_to_color/image_raw"
    assert camera.info == "/camera/camera/color/camera_info"


def test_a_kinect_prefers_depth_in_the_colour_camera() -> None:
    (camera,) = find_cameras(
        log_with(
            Has(name="/k4a/rgb/image_raw", encoding="bgra8"),
            Has(name="/k4a/rgb/camera_info", focal=600),
            Has(name="/k4a/depth/image_raw", encoding="16UC1", frame="depth", size=(320, 288)),
            Has(name="/k4a/depth/camera_info", focal=250, frame="depth", size=(320, 288)),
            Has(name="/k4a/depth_to_rgb/image_raw", encoding="16UC1"),
            Has(name="/k4a/depth_to_rgb/camera_info", focal=600),
        )
    )
    assert (camera.name, camera.depth) == ("k4a", "/k4a/depth_to_rgb/image_raw")


def test_the_freiburg_recordings_are_one_camera() -> None:
    (camera,) = find_cameras(
        log_with(
            Has(name="/camera/rgb/image_color"),
            Has(name="/camera/rgb/camera_info", focal=525),
            Has(name="/camera/depth/image", encoding="32FC1"),
            Has(name="/camera/depth/camera_info", focal=525),
        )
    )
    assert camera.info == "/camera/rgb/camera_info"
    assert camera.depth_info == "/camera/depth/camera_info"


def test_two_cameras_below_one_namespace_keep_apart() -> None:
    cameras = find_cameras(
        log_with(
            *(
                Has(name=f"/robot/{side}/{kind}/image_raw", encoding=encoding)
                for side in ("left", "right")
                for kind, encoding in (("color", "rgb8"), ("depth", "16UC1"))
            )
        )
    )
    assert [(c.name, c.color, c.depth) for c in cameras] == [
        ("left", "/robot/left/color/image_raw", "/robot/left/depth/image_raw"),
        ("right", "/robot/right/color/image_raw", "/robot/right/depth/image_raw"),
    ]


def test_cameras_of_the_same_last_name_are_told_apart_by_all_of_it() -> None:
    names = [
        camera.name
        for camera in find_cameras(
            log_with(
                *(
                    Has(name=f"/{arm}/cam/{kind}/image_raw", encoding=encoding)
                    for arm in ("arm_a", "arm_b")
                    for kind, encoding in (("color", "rgb8"), ("depth", "16UC1"))
                )
            )
        )
    ]
    assert names == ["arm_a_cam", "arm_b_cam"]


@pytest.mark.parametrize("info", ["/cam/camera_info", "/cam/rgb/camera_info"])
def test_a_calibration_beside_or_above_the_image_is_found(info: str) -> None:
    (camera,) = find_cameras(
        log_with(
            Has(name="/cam/rgb/image"), Has(name="/cam/depth/image", encoding="32FC1"), Has(name=info, focal=500)
        )
    )
    assert camera.info == info


def test_the_depth_cameras_calibration_is_not_taken_for_the_colours() -> None:
    (camera,) = find_cameras(
        log_with(
            Has(name="/cam/rgb/image"),
            Has(name="/cam/depth/image", encoding="32FC1", frame="depth"),
            Has(name="/cam/depth/camera_info", focal=390, frame="depth"),
        )
    )
    assert camera.info == ""


def test_topics_without_a_namespace_are_one_camera() -> None:
    (camera,) = find_cameras(log_with(Has(name="/rgb"), Has(name="/depth", encoding="16UC1")))
    assert (camera.name, camera.color, camera.depth) == ("camera", "/rgb", "/depth")


def test_a_lone_colour_camera_takes_no_other_cameras_depth() -> None:
    cameras = find_cameras(
        log_with(
            Has(name="/robot/wrist/color/image_raw"),
            Has(name="/robot/wrist/depth/image_raw", encoding="16UC1"),
            Has(name="/robot/webcam/image_raw"),
        )
    )
    assert [camera.color for camera in cameras] == ["/robot/wrist/color/image_raw"]


DEPTHS = (
    "camera/aligned_depth_to_infra1/image_raw",
    "camera/depth/image_rect_raw",
    "k4a/depth_to_rgb/image_raw",
    "kinect2/sd/image_depth_rect",
    "camera/depth_registered/hw_registered/image_rect",
    "device_0/sensor_0/Depth_0/image/data",
    "ir_camera/depth/image",
    "aux/depthmap",
)
OTHERS = (
    "camera/infra1/image_rect_raw",
    "ir/image_raw",
    "kinect2/sd/image_ir_rect",
    "multisense/aux/image_mono",
    "camera/confidence/image_raw",
    "zed/depth/confidence_map",
    "device_0/sensor_0/Infrared_1/image/data",
    "depth_camera/amplitude",
    "ouster/nearir_image",
    "stereo/disparity",
)
SILENT = (
    "camera/image_raw",
    "left/image_rect",
    "sensor/range_image",
    "mirror/image",
    "iris/image",
    "camera/color/image",
)


@pytest.mark.parametrize("name", (*DEPTHS, *OTHERS, *SILENT))
def test_a_topic_says_depth_or_something_else_or_nothing(name: str) -> None:
    word = word_of(tuple(name.split("/")))
    assert (word == DEPTH, is_other(word)) == (name in DEPTHS, name in OTHERS)


def test_a_depth_camera_may_give_colour() -> None:
    assert word_of(("depth_camera", "image_raw")) == DEPTH
    assert word_of(("depth_camera", "image_raw"), is_device=False) == ""
    assert word_of(("depth", "image_raw"), is_device=False) == DEPTH


def _as_jpeg(log_ns: int, topic: str, kind: str, message: Any) -> list[Message]:
    if topic != "/cam0/depth/image_raw":
        return [(log_ns, topic, kind, message)]
    counts = np.frombuffer(message.data.tobytes(), "<u2").reshape(message.height, message.width)
    data = cv2.imencode(".jpg", (counts >> 4).astype(np.uint8))[1].ravel()
    packed = T["sensor_msgs/msg/CompressedImage"](header=message.header, format="jpeg", data=data)
    return [(log_ns, f"{topic}/compressed", packed.__msgtype__, packed)]


@pytest.mark.parametrize("has_color", [True, False])
def test_a_jpeg_on_a_depth_topic_is_neither_depth_nor_colour(tmp_path: Path, *, has_color: bool) -> None:
    path = broken_log(tmp_path / "log.mcap", _as_jpeg, LogRecipe(num_frames=6))
    messages = [m for m in messages_of(path) if has_color or "color/image" not in m.topic.name]
    write_raw(tmp_path / "log.mcap", messages)
    with pytest.raises(InputError, match=r"/cam0/depth/image_raw/compressed \(.*JPEG loses depth: record PNG\)"):
        open_source(path)
    if has_color:
        given = CameraTopics(
            name="c", color="/cam0/color/image_raw/compressed", depth="/cam0/depth/image_raw/compressed"
        )
        with pytest.raises(InputError, match="expected depth images, got mono8"):
            open_source(path, SourceOptions(camera_topics=(given,)))


def test_colour_and_depth_in_one_message_are_named_with_what_to_record_instead(tmp_path: Path) -> None:
    messages = [m for m in messages_of(make_log(tmp_path / "whole.mcap")) if "image_raw" not in m.topic.name]
    kind = "realsense2_camera_msgs/msg/RGBD"
    both = Topic(name="/camera/rgbd", type_name=kind, encoding="cdr", definition="std_msgs/Header header\n")
    messages.append(RawMessage(topic=both, log_time_ns=messages[-1].log_time_ns, data=bytes(64)))
    with pytest.raises(InputError, match=f"in one message, which is not read: {kind} on /camera/rgbd") as caught:
        open_source(write_raw(tmp_path / "log.mcap", messages))
    assert "record the camera's own topics instead" in caught.value.remedy

"""Cameras found in the topic names that real drivers use, and what names of topics say of their images."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log.cameras import find_cameras
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from splatctrl_cli.recording.log.messages import DEPTH, ImageMessage, word_of
from splatctrl_cli.recording.log.messages import OTHERS as OTHER_WORDS
from splatctrl_cli.recording.log.survey import Calibration, Survey, TopicSurvey
from splatctrl_cli.recording.source import CameraTopics, SourceOptions, open_source
from tests.cases.container_cases import jpeg_of
from tests.recording.log.make_log import LogRecipe, Message, broken_log, built, make_log, messages_of, write_raw
from tests.refused import expect_refusal


def log_with(topics: Mapping[str, str]) -> Survey:
    """Topics of the pretended log: encoding or, of a CameraInfo, focal length [px]; frame; width, height."""
    survey = Survey()
    for name, said in topics.items():
        what, frame, width, height = (said.split() + ["optical", "640", "480"][len(said.split()) - 1 :])[:4]
        size = {"width": int(width), "height": int(height)}
        compressed = b"" if name.endswith("compressed") else None
        kind = CAMERA_INFO if what.isdigit() else IMAGE if compressed is None else COMPRESSED_IMAGE
        entry = TopicSurvey(topic=Topic(name=name, type_name=kind, encoding="cdr"), count=1)
        if what.isdigit():
            K, none = np.array([[int(what), 0, 320], [0, int(what), 240], [0, 0, 1.0]]), np.zeros((3, 3))
            lens: dict[str, Any] = {"K": K, "distortion_model": "plumb_bob", "distortion": np.zeros(5)}
            entry.calibration = Calibration(projection=none, rotation=none, frame_id=frame, **size, **lens)
        else:
            decode = partial(np.zeros, (int(height), int(width)), np.uint8)
            entry.first_image = ImageMessage(
                stamp_ns=0, frame_id=frame, encoding=what, decode=decode, compressed=compressed, **size
            )
        survey.topics[name] = entry
    return survey


SIDES = [f"/robot/{side}/{kind}/image_raw" for side in ("left", "right") for kind in ("color", "depth")]

ARMS = [f"/{arm}/cam/{kind}/image_raw" for arm in ("arm_a", "arm_b") for kind in ("color", "depth")]

NO_NAMES = {"/cam/rgb/image": "rgb8", "/cam/depth/image": "32FC1 depth"}


@pytest.mark.parametrize(
    ("topics", "cameras"),
    [
        (
            {
                "/camera/camera/color/image_raw": "rgb8",
                "/camera/camera/color/image_raw/compressed": "rgb8",
                "/camera/camera/color/camera_info": "615",
                "/camera/camera/depth/image_rect_raw": "16UC1 depth",
                "/camera/camera/depth/camera_info": "390 depth",
                "/camera/camera/aligned_depth_to_color/image_raw": "16UC1",
                "/camera/camera/aligned_depth_to_color/camera_info": "615",
                "/camera/camera/infra1/image_rect_raw": "mono8 infra",
            },
            [
                {
                    "name": "camera",
                    "color": "/camera/camera/color/image_raw",
                    "depth": "/camera/camera/aligned_depth_to_color/image_raw",
                    "info": "/camera/camera/color/camera_info",
                }
            ],
        ),
        (
            {
                "/k4a/rgb/image_raw": "bgra8",
                "/k4a/rgb/camera_info": "600",
                "/k4a/depth/image_raw": "16UC1 depth 320 288",
                "/k4a/depth/camera_info": "250 depth 320 288",
                "/k4a/depth_to_rgb/image_raw": "16UC1",
                "/k4a/depth_to_rgb/camera_info": "600",
            },
            [{"name": "k4a", "depth": "/k4a/depth_to_rgb/image_raw"}],
        ),
        (
            {
                "/camera/rgb/image_color": "rgb8",
                "/camera/rgb/camera_info": "525",
                "/camera/depth/image": "32FC1",
                "/camera/depth/camera_info": "525",
            },
            [{"info": "/camera/rgb/camera_info", "depth_info": "/camera/depth/camera_info"}],
        ),
        (
            dict(zip(SIDES, ["rgb8", "16UC1"] * 2, strict=True)),
            [
                {"name": "left", "color": SIDES[0], "depth": SIDES[1]},
                {"name": "right", "color": SIDES[2], "depth": SIDES[3]},
            ],
        ),
        (dict(zip(ARMS, ["rgb8", "16UC1"] * 2, strict=True)), [{"name": "arm_a_cam"}, {"name": "arm_b_cam"}]),
        *(
            ({"/cam/rgb/image": "rgb8", "/cam/depth/image": "32FC1", info: "500"}, [{"info": info}])
            for info in ("/cam/camera_info", "/cam/rgb/camera_info")
        ),
        (NO_NAMES | {"/cam/depth/camera_info": "390 depth"}, [{"info": ""}]),
        ({"/rgb": "rgb8", "/depth": "16UC1"}, [{"name": "camera", "color": "/rgb", "depth": "/depth"}]),
        (
            {
                "/robot/wrist/color/image_raw": "rgb8",
                "/robot/wrist/depth/image_raw": "16UC1",
                "/robot/webcam/image_raw": "rgb8",
            },
            [{"color": "/robot/wrist/color/image_raw"}],
        ),
    ],
    ids=[
        *("RealSense: aligned depth, no infrared", "Kinect: depth in the colour camera", "Freiburg"),
        *("two below one namespace", "the same last name", "CameraInfo above", "CameraInfo beside"),
        *("the depth camera's is not the colour's", "no namespace", "a lone colour camera takes no other's depth"),
    ],
)
def test_cameras_are_found_in_the_topics_of_drivers(topics: dict[str, str], cameras: list[dict[str, str]]) -> None:
    found = find_cameras(log_with(topics))
    assert [{key: getattr(c, key) for key in want} for c, want in zip(found, cameras, strict=True)] == cameras


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
    assert (word == DEPTH, word in OTHER_WORDS) == (name in DEPTHS, name in OTHERS)
    assert word_of(("depth_camera", "image_raw"), is_device=False) == "", "a depth camera may give colour"
    assert word_of(("depth_camera", "image_raw")) == word_of(("depth", "image_raw"), is_device=False) == DEPTH


def _as_jpeg(log_ns: int, topic: str, kind: str, message: Any) -> list[Message]:
    if topic != "/cam0/depth/image_raw":
        return [(log_ns, topic, kind, message)]
    packed = built(COMPRESSED_IMAGE, header=message.header, format="jpeg", data=jpeg_of(message))
    return [(log_ns, f"{topic}/compressed", packed.__msgtype__, packed)]


@pytest.mark.parametrize("has_color", [True, False])
def test_a_jpeg_on_a_depth_topic_is_neither_depth_nor_colour(tmp_path: Path, *, has_color: bool) -> None:
    path = broken_log(tmp_path / "log.mcap", _as_jpeg, LogRecipe(num_frames=6))
    messages = [m for m in messages_of(path) if has_color or "color/image" not in m.topic.name]
    write_raw(tmp_path / "log.mcap", messages)
    expect_refusal(r"/cam0/depth/image_raw/compressed \(.*JPEG loses depth: record PNG\)", open_source, path)
    if has_color:
        given = CameraTopics(
            name="c", color="/cam0/color/image_raw/compressed", depth="/cam0/depth/image_raw/compressed"
        )
        expect_refusal("expected depth images, got mono8", open_source, path, SourceOptions(camera_topics=(given,)))


def test_colour_and_depth_in_one_message_are_named_with_what_to_record_instead(tmp_path: Path) -> None:
    messages = [m for m in messages_of(make_log(tmp_path / "whole.mcap")) if "image_raw" not in m.topic.name]
    kind = "realsense2_camera_msgs/msg/RGBD"
    both = Topic(name="/camera/rgbd", type_name=kind, encoding="cdr", definition="std_msgs/Header header\n")
    messages.append(RawMessage(topic=both, log_time_ns=messages[-1].log_time_ns, data=bytes(64)))
    said = f"in one message, which is not read: {kind} on /camera/rgbd; record the camera's own topics instead"
    expect_refusal(said, open_source, write_raw(tmp_path / "log.mcap", messages))

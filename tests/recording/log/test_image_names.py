"""What names of topics say of their images, as drivers write them."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log.image_names import DEPTH, is_other, word_of
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions
from tests.recording.log.make_log import LogRecipe, Message, T, broken_log, make_log, messages_of, write_raw

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

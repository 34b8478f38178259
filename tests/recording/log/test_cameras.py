"""Cameras found in the topic names that real drivers use."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from splatctrl_cli.recording.container.raw_log import Topic
from splatctrl_cli.recording.log.cameras import find_cameras
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from splatctrl_cli.recording.log.messages import ImageMessage
from splatctrl_cli.recording.log.survey import Calibration, Survey, TopicSurvey


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

"""The cameras of a log made ready: intrinsics, world frame, lens and depth registration, or why they cannot be."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.io.cameras import find_cameras, find_info, image_topics, is_registered
from splatctrl_cli.io.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from splatctrl_cli.io.options import CameraTopics, SourceOptions
from splatctrl_cli.io.raw_log import RawLog
from splatctrl_cli.io.registration import DISTORTION_MODELS, DepthToColor, Undistortion
from splatctrl_cli.io.survey import Calibration, Survey
from splatctrl_cli.io.tf_tree import TfTree
from splatctrl_cli.records import Float64, Intrinsics


@dataclass(frozen=True, kw_only=True)
class Camera:
    """One RGB-D camera of a log; fixed_pose is T_world_camera where a person gave it."""

    name: str
    color_topic: str
    depth_topic: str
    frame_id: str
    world_frame: str
    intrinsics: Intrinsics
    undistortion: Undistortion | None = None
    depth_to_color: DepthToColor | None = None
    fixed_pose: Float64 | None = None

    def pose_at(self, tf: TfTree, stamp_ns: int, tolerance_ns: int) -> Float64 | None:
        """T_world_camera at a time; None where tf does not know it."""
        if self.fixed_pose is not None:
            return self.fixed_pose
        return tf.lookup(self.world_frame, self.frame_id, stamp_ns, tolerance_ns)


def build_cameras(log: RawLog, survey: Survey, options: SourceOptions) -> tuple[Camera, ...]:
    """Every camera to be read, complete. Raises InputError naming the camera, the topic and what it lacks."""
    found = _given_topics(log, survey, options) or find_cameras(survey)
    if not found:
        raise _no_camera(log, survey)
    known = {camera.name: camera for camera in found}
    names = tuple(known) if options.cameras is None else options.cameras
    for name in (*names, *options.camera_poses):
        if name not in known:
            raise InputError(f"{log.path}: no camera {name!r}", remedy=f"use one of: {', '.join(known)}")
    others = [name for name in known if name not in names]
    try:
        cameras = tuple(_Builder(log, survey, options, known[name]).build() for name in names)
    except InputError as error:
        if len(names) < 2 or others:
            raise
        raise InputError(
            error.message, remedy=f"{error.remedy}; or choose with --cameras {','.join(names)}"
        ) from None
    worlds = {camera.world_frame for camera in cameras if camera.fixed_pose is None}
    if len(worlds) > 1:
        raise InputError(
            f"{log.path}: the cameras hang in separate tf trees, with roots {', '.join(sorted(worlds))}",
            remedy="record the transform that joins them, or choose with --cameras",
        )
    return cameras


def nearest_gap_ns(color_ns: Sequence[int], depth_ns: Sequence[int]) -> int:
    """The smallest difference between a colour and a depth stamp [ns]."""
    color, depth = np.sort(np.array(color_ns)), np.sort(np.array(depth_ns))
    after = np.clip(np.searchsorted(depth, color), 0, len(depth) - 1)
    before = np.clip(after - 1, 0, None)
    return int(np.minimum(np.abs(depth[after] - color), np.abs(depth[before] - color)).min())


def intrinsics_of(calibration: Calibration) -> Intrinsics:
    """The pinhole part of a CameraInfo (its pixel convention is ours)."""
    K = calibration.K
    return Intrinsics(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=calibration.width,
        height=calibration.height,
    )


class _Builder:
    """Makes one camera ready."""

    def __init__(self, log: RawLog, survey: Survey, options: SourceOptions, topics: CameraTopics) -> None:
        self._where = f"{log.path}: camera {topics.name}"
        self._survey = survey
        self._options = options
        self._topics = topics

    def build(self) -> Camera:
        topics, survey = self._topics, self._survey
        calibration = self._calibration(topics.info, topics.color)
        image = survey.topics[topics.color].first_image
        assert image is not None
        fixed = self._options.camera_poses.get(topics.name)
        is_fixed = fixed is not None
        world = self._options.world_frame or ("world" if is_fixed else survey.tf.root_of(image.frame_id))
        if not is_fixed:
            self._check_tf(image.frame_id, world)
        intrinsics = intrinsics_of(calibration)
        is_aligned = is_registered(survey, topics.color, topics.depth, topics.info, topics.depth_info)
        return Camera(
            name=topics.name,
            color_topic=topics.color,
            depth_topic=topics.depth,
            frame_id=image.frame_id,
            world_frame=world,
            intrinsics=intrinsics,
            undistortion=self._undistortion(calibration, intrinsics),
            depth_to_color=None if is_aligned else self._registration(intrinsics, image.frame_id),
            fixed_pose=None if fixed is None else transform_from(fixed[:3], fixed[3:]),
        )

    def _calibration(self, info: str, image_topic: str) -> Calibration:
        calibration = self._survey.topics[info].calibration if info else None
        if calibration is None:
            there = [t.topic.name for t in self._survey.of_type(CAMERA_INFO)]
            raise InputError(
                f"{self._where}: topic {image_topic} has no usable CameraInfo",
                remedy=f"record its camera_info, or name it with --camera; CameraInfo topics there: {_listed(there)}",
            )
        image = self._survey.topics[image_topic].first_image
        assert image is not None
        size, expected = (image.width, image.height), (calibration.width, calibration.height)
        if expected == (0, 0):
            expected = size
        if size != expected:
            raise InputError(
                f"{self._where}: topic {image_topic}: expected {expected[0]}x{expected[1]} images as {info} says,"
                f" got {size[0]}x{size[1]}",
                remedy="name the right CameraInfo with --camera",
            )
        return Calibration(
            width=size[0],
            height=size[1],
            K=calibration.K,
            distortion_model=calibration.distortion_model,
            distortion=calibration.distortion,
            frame_id=calibration.frame_id,
        )

    def _check_tf(self, frame_id: str, world: str) -> None:
        tf, topic = self._survey.tf, self._topics.color
        if world not in tf.frames and tf.frames and self._options.world_frame:
            raise InputError(
                f"{self._where}: tf has no frame {world!r}", remedy=f"--world-frame: use one of {_listed(tf.frames)}"
            )
        if frame_id not in tf.frames or not tf.connects(world, frame_id):
            raise InputError(
                f"{self._where}: no tf for frame {frame_id!r} of topic {topic} in {world!r};"
                f" frames tf knows: {_listed(tf.frames)}",
                remedy=f"record /tf and /tf_static, or give --camera-pose {self._topics.name}=x,y,z,qx,qy,qz,qw",
            )

    def _undistortion(self, calibration: Calibration, intrinsics: Intrinsics) -> Undistortion | None:
        if not np.any(np.abs(calibration.distortion) > 1e-9) or "rect" in self._topics.color.rsplit("/", 2)[-1]:
            return None
        if calibration.distortion_model not in DISTORTION_MODELS:
            raise InputError(
                f"{self._where}: {self._topics.info}: distortion model {calibration.distortion_model!r} is unknown",
                remedy=f"rectify the images first; known models: {', '.join(DISTORTION_MODELS)}",
            )
        return Undistortion(intrinsics, calibration.distortion_model, calibration.distortion)

    def _registration(self, color: Intrinsics, color_frame: str) -> DepthToColor:
        """How raw depth reaches the colour camera. Raises InputError where K or the transform is not known."""
        topics, tf = self._topics, self._survey.tf
        depth_image = self._survey.topics[topics.depth].first_image
        assert depth_image is not None
        what = f"{self._where}: depth of {topics.depth} is not registered to colour of {topics.color}"
        remedy = "record depth aligned to colour"
        if not topics.depth_info:
            raise InputError(f"{what}, and {topics.depth} has no CameraInfo", remedy=f"record it, or {remedy}")
        calibration = self._calibration(topics.depth_info, topics.depth)
        frame = depth_image.frame_id
        if frame == color_frame:
            raise InputError(
                f"{what}: their CameraInfo differ but both say frame {frame!r}",
                remedy=f"{remedy}, or correct the frames",
            )
        span = tf.span_ns(frame) or tf.span_ns(color_frame) or (0, 0)
        T_color_depth = tf.lookup(color_frame, frame, span[0])
        if T_color_depth is None:
            raise InputError(
                f"{what}, and tf does not join their frames {frame!r} and {color_frame!r};"
                f" frames tf knows: {_listed(tf.frames)}",
                remedy=f"record /tf_static, or {remedy}",
            )
        return DepthToColor(
            depth_intrinsics=intrinsics_of(calibration), color_intrinsics=color, T_color_depth=T_color_depth
        )


def _given_topics(log: RawLog, survey: Survey, options: SourceOptions) -> tuple[CameraTopics, ...]:
    """The topics that --camera names, their CameraInfo looked up where it names none."""
    cameras = []
    for given in options.camera_topics:
        for topic, kind in ((given.color, "colour"), (given.depth, "depth")):
            images = [t.topic.name for t in survey.of_type(IMAGE, COMPRESSED_IMAGE) if t.first_image is not None]
            if topic not in images:
                raise InputError(
                    f"{log.path}: --camera {given.name}: no {kind} images on topic {topic}",
                    remedy=f"image topics there: {_listed(images)}",
                )
        if given.info and given.info not in [t.topic.name for t in survey.of_type(CAMERA_INFO)]:
            raise InputError(f"{log.path}: --camera {given.name}: no CameraInfo on topic {given.info}")
        color, depth = survey.topics[given.color], survey.topics[given.depth]
        cameras.append(
            CameraTopics(
                name=given.name,
                color=given.color,
                depth=given.depth,
                info=given.info or find_info(survey, color),
                depth_info=given.depth_info or find_info(survey, depth),
            )
        )
    return tuple(cameras)


def _no_camera(log: RawLog, survey: Survey) -> InputError:
    colors = [t.topic.name for t in image_topics(survey, "color")]
    depths = [t.topic.name for t in image_topics(survey, "depth")]
    if colors and not depths:
        return InputError(
            f"{log.path}: no depth topic; colour topics there: {_listed(colors)}",
            remedy="record 16UC1, mono16 or 32FC1 depth images",
        )
    if depths and not colors:
        return InputError(
            f"{log.path}: no colour topic; depth topics there: {_listed(depths)}", remedy="record the colour images"
        )
    kinds = sorted({t.topic.type_name or t.topic.encoding for t in survey.topics.values() if t.count})
    return InputError(
        f"{log.path}: no image topics; message types there: {_listed(kinds)}",
        remedy="expected sensor_msgs Image or CompressedImage",
    )


def _listed(names: Sequence[str]) -> str:
    """Up to eight names, then how many more."""
    shown = ", ".join(names[:8]) or "none"
    return f"{shown} and {len(names) - 8} more" if len(names) > 8 else shown

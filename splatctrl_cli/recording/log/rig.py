"""A log's cameras with intrinsics, world frame, lens and registration, or their problems."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from splatctrl_cli.config.fixed import IMAGES_FEWEST_BACK
from splatctrl_cli.errors import InputError, refuse_if, require
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.recording.container.raw_log import RawLog
from splatctrl_cli.recording.log.cameras import (
    find_cameras,
    find_info,
    frame_of,
    image_topics,
    is_registered,
    join_pose_topics,
    listed,
    no_camera,
    pose_topics,
)
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from splatctrl_cli.recording.log.messages import GRAY
from splatctrl_cli.recording.log.registration import (
    DISTORTION_MODELS,
    Lens,
    TfTree,
    correct_lens,
    is_distorted,
    lens_model,
    undistort_lens,
)
from splatctrl_cli.recording.log.survey import Calibration, Survey
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions, refuse_unknown_cameras
from splatctrl_cli.records import Float64, Intrinsics

_RECTIFIED = frozenset({"rect", "rectified", "undistorted"})  # words in the names of topics


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera(Lens):
    """An RGB-D camera of a log.

    fixed_pose: the user's T_world_camera. human_topic: of its masks. depth_scale [m per count]: the user's or the
    log's.
    """

    name: str
    color_topic: str
    depth_topic: str
    frame_id: str
    world_frame: str
    fixed_pose: Float64 | None = None
    depth_scale: float | None = None
    human_topic: str = ""

    def pose_at(self, tf: TfTree, stamp_ns: int, tolerance_ns: int) -> Float64 | None:
        """T_world_camera, None if tf does not know it."""
        if self.fixed_pose is not None:
            return self.fixed_pose
        return tf.lookup(self.world_frame, self.frame_id, stamp_ns, tolerance_ns)


def build_cameras(log: RawLog, survey: Survey, options: SourceOptions) -> tuple[Camera, ...]:
    """Build requested cameras. Raises InputError naming camera, topic and problem."""
    topics = camera_topics(log, survey, options)
    if not topics:
        raise no_camera(log, survey)
    known = {camera.name: camera for camera in topics}
    names = tuple(known) if options.cameras is None else options.cameras
    refuse_unknown_cameras(
        log.path, (*names, *options.camera_poses, *options.camera_pose_topics, *options.intrinsics), known
    )
    join_pose_topics(log, survey, options, [known[name] for name in names])
    check_mask_topics(log.path, survey, options.human_topics, tuple(known))
    try:
        cameras = tuple(_Builder(log, survey, options, known[name]).build() for name in names)
    except InputError as error:
        usable = [name for name in known if not _Builder(log, survey, options, known[name]).problems()]
        if not usable:
            raise
        raise InputError(error.message, remedy=f"{error.remedy}; or give --cameras {','.join(usable)}") from None
    worlds = {camera.world_frame for camera in cameras if camera.fixed_pose is None}
    refuse_if(
        len(worlds) > 1,
        f"{log.path}: the cameras are in separate tf trees, with roots {', '.join(sorted(worlds))}",
        remedy="record the transform that joins them, or choose with --cameras",
    )
    return cameras


def camera_topics(log: RawLog, survey: Survey, options: SourceOptions) -> tuple[CameraTopics, ...]:
    """The options' cameras, else those found; a mask topic is never colour."""
    return _given_topics(log, survey, options) or find_cameras(survey, without=options.human_topics.values())


def missing(log: RawLog, survey: Survey, options: SourceOptions) -> list[str]:
    """List what a reconstruction would miss."""
    camera_list = camera_topics(log, survey, options)
    if not camera_list:
        lacks = [str(no_camera(log, survey)).removeprefix(f"{log.path}: ")]
        if not survey.select_types(CAMERA_INFO):
            lacks.append("no CameraInfo topic; record the colour camera's camera_info")
        return lacks if survey.tf.frames else [*lacks, "no tf (/tf, /tf_static); record it, or give --camera-pose"]
    lacks = []
    try:
        join_pose_topics(log, survey, options, camera_list, only_first=True)
    except InputError as error:
        lacks.append(str(error).removeprefix(f"{log.path}: "))
    for topics in camera_list:
        if options.cameras is not None and topics.name not in options.cameras:
            continue
        lacks.extend(_Builder(log, survey, options, topics).problems())
        gap = nearest_gap_ns(*[survey.topics[name].stamps_ns for name in (topics.color, topics.depth)]) * 1e-9
        if gap > options.pairing_tolerance_s:
            lacks.append(
                f"camera {topics.name}: colour and depth are never closer than {gap * 1e3:.4g} ms; give "
                f"--pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right"
            )
    return lacks


def nearest_gap_ns(color_ns: Sequence[int], depth_ns: Sequence[int]) -> int:
    color, depth = np.sort(np.array(color_ns)), np.sort(np.array(depth_ns))
    after = np.clip(np.searchsorted(depth, color), 0, len(depth) - 1)
    return int(np.minimum(np.abs(depth[after] - color), np.abs(depth[np.clip(after - 1, 0, None)] - color)).min())


def intrinsics_of(calibration: Calibration) -> Intrinsics:
    """A CameraInfo's pinhole (its pixel convention is ours)."""
    K = calibration.K
    return Intrinsics(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=calibration.width,
        height=calibration.height,
    )


def _rectify(calibration: Calibration) -> Calibration:
    """The rectified camera: P if set, without distortion."""
    pinhole = replace(
        calibration,
        K=calibration.projection if calibration.projection[0, 0] > 0 else calibration.K,
        distortion_model="plumb_bob",
        distortion=np.zeros(0),
    )
    model = lens_model(calibration.distortion_model)
    if not is_distorted(model, calibration.distortion) or model not in DISTORTION_MODELS:
        return pinhole
    lens, R = intrinsics_of(calibration), calibration.rotation if np.any(calibration.rotation) else None
    with suppress(InputError):  # an impossible lens does not say what it saw
        seen = undistort_lens(intrinsics_of(pinhole), model, calibration.distortion, recorded=lens, R=R)
        return replace(pinhole, valid=seen.valid)
    return pinhole


ImageLens = Literal["pinhole", "distorted", "rectified", "contradicted"]  # by CameraInfo and the topic's name


def image_lens(survey: Survey, image_topic: str, calibration: Calibration) -> ImageLens:
    """Classify the lens of images by topic name and CameraInfo.

    A topic named rectified may have the distorted CameraInfo of raw images (image_proc). Its images are rectified if
    P differs from K, raw images are in its folder, or they are depth. RealSense's ``image_rect_raw`` is distorted.
    """
    says_rectified = not _RECTIFIED.isdisjoint(re.split("[/_]", image_topic.lower()))
    if not is_distorted(calibration.distortion_model, calibration.distortion):
        return "rectified" if says_rectified else "pinhole"
    if not says_rectified or image_topic.endswith("rect_raw"):
        return "distorted"
    folder, P = image_topic.rpartition("/")[0], calibration.projection
    has_raw = any(
        t.topic.name.startswith(f"{folder}/image_raw") for t in survey.select_types(IMAGE, COMPRESSED_IMAGE)
    )
    is_depth = any(t.topic.name == image_topic for t in image_topics(survey, "depth"))
    is_own = P[0, 0] > 0 and not np.allclose(P, calibration.K, rtol=1e-3)
    return "rectified" if has_raw or is_depth or is_own else "contradicted"


class _Builder:
    def __init__(self, log: RawLog, survey: Survey, options: SourceOptions, topics: CameraTopics) -> None:
        self._path = log.path
        self._where = f"{log.path}: camera {topics.name}"
        self._survey = survey
        self._options = options
        self._topics = topics
        self._frame_id = frame_of(survey, topics.color, topics.depth)
        self._is_registered = is_registered(survey, topics.color, topics.depth, topics.info, topics.depth_info)

    def build(self) -> Camera:
        topics = self._topics
        self._check_depth()
        self._check_clock()
        lens = self._lens(self._calibration(topics.info, topics.color), topics.info)
        lens = lens if self._is_registered else self._add_depth_lens(lens)
        fixed = self._options.camera_poses.get(topics.name)
        return Camera(
            **vars(lens),
            name=topics.name,
            color_topic=topics.color,
            depth_topic=topics.depth,
            frame_id=self._frame_id,
            world_frame=self._check_world(),
            fixed_pose=None if fixed is None else transform_from(fixed[:3], fixed[3:]),
            depth_scale=self._depth_scale,
            human_topic=self._options.human_topics.get(topics.name, ""),
        )

    def problems(self) -> list[str]:
        problems = []
        any_lens = Lens(intrinsics=Intrinsics(fx=1, fy=1, cx=0, cy=0, width=1, height=1))
        steps: list[Callable[[], object]] = [
            self._check_depth,
            self._check_clock,
            lambda: self._calibration(self._topics.info, self._topics.color),
            self._check_world,
            lambda: None if self._is_registered else self._add_depth_lens(any_lens),
            self.build,
        ]
        for step in steps:
            try:
                step()
            except InputError as error:
                problems.append(str(error).removeprefix(f"{self._path}: "))
        return list(dict.fromkeys(problems))

    @property
    def _depth_scale(self) -> float | None:
        if self._options.depth_scale is not None:
            return self._options.depth_scale
        try:
            return self._survey.realsense.depth_unit(self._topics.depth)
        except InputError as error:
            raise InputError(f"{self._where}: {error.message}", remedy=error.remedy) from None

    def _calibration(self, info: str, image_topic: str) -> Calibration:
        calibration = self._survey.topics[info].calibration if info else None
        option = self._options.intrinsics.get(self._topics.name)
        if option is not None and image_topic == self._topics.color:
            return self._read_intrinsics(option, image_topic)
        infos = [t.topic.name for t in self._survey.select_types(CAMERA_INFO)]
        calibration = require(
            calibration,
            f"{self._where}: topic {image_topic} has no usable CameraInfo",
            remedy=f"record its camera_info, name it with --camera; CameraInfo topics there: {listed(infos)};"
            f" or give --intrinsics {self._topics.name}=FX,FY,CX,CY",
        )
        image = self._survey.topics[image_topic].image
        size, expected = (image.width, image.height), (calibration.width, calibration.height)
        if expected == (0, 0) and not calibration.cut:
            expected = size
        by_hand = f", or give --intrinsics {self._topics.name}=FX,FY,CX,CY of the recorded images"
        remedy = f"name the right CameraInfo with --camera{by_hand if calibration.cut else ''}"
        refuse_if(
            not calibration.is_possible,
            f"{self._where}: topic {image_topic}: {info} says {calibration.cut}, which lies outside of images of"
            f" {size[0]}x{size[1]}",
            remedy=remedy,
        )
        cut = f" ({calibration.cut})" if calibration.cut else ""
        refuse_if(
            size != expected,
            f"{self._where}: topic {image_topic}: expected {expected[0]}x{expected[1]} images as {info} says{cut},"
            f" got {size[0]}x{size[1]}",
            remedy=remedy,
        )
        sized = replace(calibration, width=size[0], height=size[1])
        lens = image_lens(self._survey, image_topic, sized)
        if lens == "contradicted":
            raise self._contradicted(sized, info, image_topic)
        return _rectify(sized) if lens == "rectified" else sized

    def _contradicted(self, calibration: Calibration, info: str, image_topic: str) -> InputError:
        k = intrinsics_of(calibration)
        pinhole = f"--intrinsics {self._topics.name}={k.fx:.9g},{k.fy:.9g},{k.cx:.9g},{k.cy:.9g}"
        bent = ",".join(f"{value:.9g}" for value in calibration.distortion)
        return InputError(
            f"{self._where}: topic {image_topic} says rectified, but {info} has a distortion and no P of its own",
            remedy=f"give {pinhole} if the images are rectified, {pinhole},{bent} if they are as the lens sees them",
        )

    def _read_intrinsics(self, intrinsics: tuple[float, ...], image_topic: str) -> Calibration:
        image = self._survey.topics[image_topic].image
        fx, fy, cx, cy, *distortion = intrinsics
        return Calibration(
            width=image.width,
            height=image.height,
            K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            projection=np.zeros((3, 3)),
            rotation=np.zeros((3, 3)),
            distortion_model="plumb_bob",
            distortion=np.array(distortion),
            frame_id=image.frame_id,
        )

    def _check_depth(self) -> None:
        topics = self._topics
        image = self._survey.topics[topics.depth].image
        refuse_if(
            image.kind != "depth",
            f"{self._where}: topic {topics.depth}: expected depth images, got {image.encoding}",
            remedy="name a topic of depth images with --camera",
        )
        refuse_if(
            topics.rivals,
            f"{self._where}: {', '.join(topics.rivals)} could each be its depth, and no name says which",
            remedy=f"give --camera {topics.name}={topics.color},DEPTH with the one that is depth",
        )

    def _check_clock(self) -> None:
        for name in (self._topics.color, self._topics.depth):
            clock = self._survey.topics[name].clock
            refuse_if(
                clock.num_back >= IMAGES_FEWEST_BACK,
                f"{self._where}: topic {name}: the clock of its headers goes back by {clock.back_ns / 1e9:.3f} s"
                f" at {clock.back_log_ns / 1e9:.3f} s of the log (a bag in a loop, a simulation that was reset),"
                f" {clock.num_back} images in all",
                remedy="give --stamps log to take the times of logging, or cut the log there",
            )

    def _check_world(self) -> str:
        tf, frame_id = self._survey.tf, self._frame_id
        if self._topics.name in self._options.camera_poses:
            return self._options.world_frame or "world"
        world = self._options.world_frame or tf.root_of(frame_id)
        refuse_if(
            world not in tf.frames and tf.frames and self._options.world_frame,
            f"{self._where}: tf has no frame {world!r}",
            remedy=f"--world-frame: use one of {listed(tf.frames)}",
        )
        target = f" in {world!r}" if world != frame_id else ""
        topics = pose_topics(self._survey)
        instead = f", or NAME=TOPIC[@FRAME] of a pose topic ({listed(topics)})" if topics else ""
        refuse_if(
            frame_id not in tf.frames or not tf.connects(world, frame_id),
            f"{self._where}: no tf for frame {frame_id!r} of topic {self._topics.color}{target};"
            f" frames tf knows: {listed(tf.frames)}",
            remedy=f"record /tf and /tf_static, or give --camera-pose {self._topics.name}=x,y,z,qx,qy,qz,qw{instead}",
        )
        return world

    def _lens(self, calibration: Calibration, info: str) -> Lens:
        k, model, bent = intrinsics_of(calibration), calibration.distortion_model, calibration.distortion
        try:
            return correct_lens(k, model, bent, calibration.valid)
        except InputError as error:
            raise InputError(f"{self._where}: {info}: {error.message}", remedy=error.remedy) from None

    def _add_depth_lens(self, lens: Lens) -> Lens:
        topics, tf, color_frame = self._topics, self._survey.tf, self._frame_id
        depth_image = self._survey.topics[topics.depth].image
        size = f"{depth_image.encoding} {depth_image.width}x{depth_image.height}"
        what = f"{self._where}: depth {size} of {topics.depth} is not registered to colour of {topics.color}"
        remedy = "record depth aligned to colour"
        refuse_if(
            not topics.depth_info, f"{what}, and {topics.depth} has no CameraInfo", remedy=f"record it, or {remedy}"
        )
        calibration = self._calibration(topics.depth_info, topics.depth)
        frame = depth_image.frame_id
        T_color_depth = self._survey.realsense.T_between(topics.color, topics.depth)
        if is_registered(self._survey, topics.color, topics.depth, topics.info, ""):  # except for the lens
            T_color_depth = np.eye(4)
            self._survey.tf.note(
                f"camera {topics.name}: {topics.info} and {topics.depth_info} differ in distortion: colour and depth"
                " are undistorted each by its own"
            )
        color_info = self._survey.topics[topics.info].calibration if topics.info else None
        if T_color_depth is None and frame == color_frame and color_info is not None:
            is_one_sensor = (calibration.cut or color_info.cut) and np.allclose(
                calibration.sensor_K, color_info.sensor_K, rtol=0.01
            )
            T_color_depth = np.eye(4) if is_one_sensor else None
        refuse_if(
            T_color_depth is None and frame == color_frame,
            f"{what}: their CameraInfo differ but both say frame {frame!r}",
            remedy=f"{remedy}, or correct the frames",
        )
        if T_color_depth is None:
            T_color_depth = tf.lookup(color_frame, frame, (tf.span_ns(frame) or tf.span_ns(color_frame) or (0, 0))[0])
        T_color_depth = require(
            T_color_depth,
            f"{what}, and tf does not join their frames {frame!r} and {color_frame!r};"
            f" frames tf knows: {listed(tf.frames)}",
            remedy=f"record /tf_static, or {remedy}",
        )
        return replace(lens, depth_lens=self._lens(calibration, topics.depth_info), T_color_depth=T_color_depth)


def _given_topics(log: RawLog, survey: Survey, options: SourceOptions) -> tuple[CameraTopics, ...]:
    cameras = []
    for camera in options.camera_topics:
        for topic, kind in ((camera.color, "colour"), (camera.depth, "depth")):
            images = [t.topic.name for t in survey.select_types(IMAGE, COMPRESSED_IMAGE) if t.first_image is not None]
            refuse_if(
                topic not in images,
                f"{log.path}: --camera {camera.name}: no {kind} images on topic {topic}",
                remedy=f"image topics there: {listed(images)}",
            )
        refuse_if(
            camera.info and camera.info not in [t.topic.name for t in survey.select_types(CAMERA_INFO)],
            f"{log.path}: --camera {camera.name}: no CameraInfo on topic {camera.info}",
            remedy="leave INFO out to have it found",
        )
        color, depth = survey.topics[camera.color], survey.topics[camera.depth]
        cameras.append(
            CameraTopics(
                name=camera.name,
                color=camera.color,
                depth=camera.depth,
                info=camera.info or find_info(survey, color),
                depth_info=camera.depth_info or find_info(survey, depth),
            )
        )
    return tuple(cameras)


def check_mask_topics(path: Path, survey: Survey, topics: Mapping[str, str], cameras: tuple[str, ...]) -> None:
    """Raise InputError for a mask topic without camera or grey images."""
    grey = [
        topic.topic.name
        for topic in survey.select_types(IMAGE, COMPRESSED_IMAGE)
        if topic.first_image is not None and topic.first_image.encoding in GRAY
    ]
    for camera, topic in topics.items():
        refuse_if(
            camera not in cameras,
            f"{path}: --human-topic {camera}={topic}: no camera {camera!r}",
            remedy=f"use one of: {', '.join(cameras)}",
        )
        refuse_if(
            topic not in grey,
            f"{path}: --human-topic {camera}={topic}: no mono8 or 8UC1 images on that topic",
            remedy=f"grey topics there: {', '.join(grey) or 'none'}",
        )

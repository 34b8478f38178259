"""Checks of a log in one pass: observed messages, and a few frames per camera."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.checks.check_cameras import calibration_findings, camera_findings, tf_findings
from splatctrl_cli.checks.check_folder import judge_frames
from splatctrl_cli.checks.check_images import (
    ImageWatch,
    Thumbnail,
    depth_findings,
    image_findings,
    sample_findings,
    thumbnail_lens,
)
from splatctrl_cli.checks.check_states import log_states
from splatctrl_cli.checks.check_times import (
    TimesWatch,
    clock_findings,
    ending_findings,
    file_findings,
    join_gaps,
    part_findings,
    peer_findings,
    time_findings,
)
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.checks.finding import (
    NOTE,
    WARNING,
    CheckReport,
    Finding,
    damage_findings,
    error,
    find_lacks,
    judge,
    note,
)
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import strided_lens
from splatctrl_cli.recording.calibrated import read_correction
from splatctrl_cli.recording.container.raw_log import Damage, JoinedLog, RawLog, RawMessage, Topic
from splatctrl_cli.recording.log.cameras import image_topics
from splatctrl_cli.recording.log.decoder import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    TRANSFORMS,
    MessageDecoder,
    UndecodableMessageError,
    header_stamp_ns,
    is_ros,
    stamp_ns,
)
from splatctrl_cli.recording.log.messages import (
    COLOR_CONVERSIONS,
    DEPTH_ENCODINGS,
    color_of,
    depth_of,
    num_invalid,
    read_image,
)
from splatctrl_cli.recording.log.registration import TfTree, warp_depth
from splatctrl_cli.recording.log.rig import Camera, build_cameras, camera_topics, check_mask_topics, missing
from splatctrl_cli.recording.log.state_messages import STATE_TYPES
from splatctrl_cli.recording.log.survey import Survey, survey
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions, refuse_unknown_cameras
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.robot.model import RobotModel

_HEADED = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu")
_FIRST_FIELD = re.compile(r"^(?:std_msgs/(?:msg/)?)?Header\s+\w+")


class LogWatch(JoinedLog):
    """A log that observes its messages as they are read, decoding images as needed.

    num_images: reading ends after this many images of a topic. spans: first and last log time [ns] by file.
    """

    def __init__(self, log: RawLog, options: SourceOptions, num_images: int | None = None) -> None:
        super().__init__(log.path, (log,), log.container)
        self._scale, self._num_images = options.depth_scale, num_images
        self._by_log_time = options.stamps == "log"
        self.times: dict[str, TimesWatch] = {}
        self.transforms: dict[str, TimesWatch] = {}
        self.images: dict[str, ImageWatch] = {}
        self.changed_infos: dict[str, int] = {}
        self.spans: dict[str, tuple[int, int]] = {}
        self.is_whole = True
        self._infos: dict[str, tuple[object, ...]] = {}
        self._decoder = MessageDecoder()
        self._headed: dict[Topic, bool] = {}

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        for message in super().messages(damage, names):
            self._take(message)
            yield message
            images = self.images.get(message.topic.name)
            if images is not None and images.count == self._num_images:
                self.is_whole = False
                return

    def _take(self, message: RawMessage) -> None:
        topic, name, stamp = message.topic, message.topic.name, message.log_time_ns
        first, last = self.spans.get(message.file, (stamp, stamp))
        self.spans[message.file] = min(first, stamp), max(last, stamp)
        has_stamps = not self._by_log_time and self._is_headed(topic)
        if has_stamps:
            try:
                stamp = header_stamp_ns(message)
            except UndecodableMessageError:
                has_stamps = False
        times = self.times.get(name)
        if times is None:
            times = self.times[name] = TimesWatch(name, has_stamps=has_stamps)
        times.add(stamp, message.log_time_ns)
        if not is_ros(topic):
            return
        try:
            if topic.type_name in (IMAGE, COMPRESSED_IMAGE):
                self._image(message, stamp)
            elif topic.type_name == CAMERA_INFO and name not in self.changed_infos:
                self._info(message, stamp)
            elif topic.type_name in TRANSFORMS and not name.endswith("tf_static"):
                self._transforms(message)
        except UndecodableMessageError:
            return  # the survey counts it

    def _is_headed(self, topic: Topic) -> bool:
        if topic not in self._headed:
            fields = [line.split("#")[0].strip() for line in topic.definition.splitlines()]
            first = next((line for line in fields if line), "")
            is_headed = bool(_FIRST_FIELD.match(first)) if topic.definition else topic.type_name in _HEADED
            self._headed[topic] = is_ros(topic) and (is_headed or topic.type_name in _HEADED)
        return self._headed[topic]

    def _image(self, message: RawMessage, stamp: int) -> None:
        name = message.topic.name
        images = self.images.setdefault(name, ImageWatch(name, self._scale))
        is_wanted = images.is_wanted()
        try:
            image = read_image(self._decoder.decode(message), message.topic.type_name, lazily=True)
            if is_wanted and image.kind == "depth":
                images.add_depth(stamp, depth_of(image, self._scale), image.encoding, num_invalid(image.pixels))
            elif is_wanted and image.kind == "color":
                images.add_color(stamp, color_of(image), image.encoding)
            else:
                images.add_undecoded(image.encoding, image.width, image.height)
        except (UndecodableMessageError, ValueError) as reason:
            images.add_bad(stamp, str(reason))

    def _info(self, message: RawMessage, stamp: int) -> None:
        info = self._decoder.decode(message)
        fields = {name.lower(): getattr(info, name) for name in ("K", "k", "D", "d") if hasattr(info, name)}
        content = (info.width, info.height, tuple(fields["k"]), tuple(fields["d"]))
        if self._infos.setdefault(message.topic.name, content) != content:
            self.changed_infos[message.topic.name] = stamp

    def _transforms(self, message: RawMessage) -> None:
        for item in self._decoder.decode(message).transforms:
            child = item.child_frame_id.strip("/")
            edge = f"tf {item.header.frame_id.strip('/')} -> {child}"
            if child not in self.transforms:
                self.transforms[child] = TimesWatch(edge, has_stamps=True)
            self.transforms[child].add(
                message.log_time_ns if self._by_log_time else stamp_ns(item.header), message.log_time_ns
            )


def ready(log: RawLog, log_survey: Survey, topics: CameraTopics, options: SourceOptions) -> Camera | None:
    """The camera as `ingest` builds it, or None if it cannot."""
    with suppress(InputError):
        return build_cameras(log, log_survey, replace(options, cameras=(topics.name,)))[0]
    return None


def reduced_frames(
    topics: CameraTopics,
    camera: Camera,
    images: Mapping[str, ImageWatch],
    tf: TfTree,
    options: SourceOptions,
    late_ns: Mapping[str, int],
) -> list[RgbdFrame]:
    """Reduced frames of a camera, with kept depth and known pose.

    Colour is black without an image at the depth's time. late_ns: delay of frames' stamps against transforms, by
    camera.
    """
    depths, colors = images.get(topics.depth), images.get(topics.color)
    sampled_colors = {small.stamp_ns: small for small in (colors.samples if colors is not None else ())}
    frames = []
    for small in depths.samples if depths is not None else ():
        near = min(sorted(sampled_colors), key=lambda stamp: abs(stamp - small.stamp_ns), default=None)
        is_near = near is not None and abs(near - small.stamp_ns) <= options.pairing_tolerance_s * 1e9
        color = sampled_colors[near] if near is not None and is_near else None
        stamp_ns = small.stamp_ns if color is None else color.stamp_ns
        T = camera.pose_at(tf, stamp_ns - late_ns.get(camera.name, 0), round(options.pose_tolerance_s * 1e9))
        if T is not None:
            frames.append(_frame(camera, small, color, stamp_ns, T))
    return frames


def _frame(camera: Camera, small: Thumbnail, color: Thumbnail | None, stamp_ns: int, T: Float64) -> RgbdFrame:
    depth, stride = small.pixels, small.stride
    if camera.depth_lens is not None and camera.T_color_depth is not None:
        stride = max(1, round(camera.intrinsics.height / small.pixels.shape[0]))
        own, target = (
            strided_lens(camera.depth_lens.intrinsics, small.stride),
            strided_lens(camera.intrinsics, stride),
        )
        depth = warp_depth(depth, own, target, camera.T_color_depth)
    elif camera.maps is not None:
        depth = camera.remap(_enlarge(depth, small))[::stride, ::stride]
    pixels: NDArray[Any] = np.zeros((*depth.shape, 3), np.uint8)
    if color is not None and color.pixels.ndim == 3:
        pixels = color.pixels
        if camera.maps is not None:
            pixels = camera.remap(_enlarge(pixels, color), cv2.INTER_LINEAR)[:: color.stride, :: color.stride]
    if pixels.shape[:2] != depth.shape:
        pixels = np.zeros((*depth.shape, 3), np.uint8)
    return RgbdFrame(
        stamp_ns=stamp_ns,
        camera=camera.name,
        color=pixels,
        depth=np.asarray(depth, np.float32),
        intrinsics=strided_lens(camera.intrinsics, stride),
        T_world_camera=T,
    )


def _enlarge(image: NDArray[Any], thumbnail: Thumbnail) -> NDArray[Any]:
    return np.repeat(np.repeat(image, thumbnail.stride, axis=0)[: thumbnail.height], thumbnail.stride, axis=1)[
        :, : thumbnail.width
    ]


def image_motion(
    watch: LogWatch, cameras: Sequence[tuple[CameraTopics, Camera]], frames: Mapping[str, Sequence[RgbdFrame]]
) -> ImageMotion:
    """Motion in each camera's first images. frames: of `reduced_frames`."""
    motion = ImageMotion()
    for topics, camera in cameras:
        if frames[camera.name] and topics.color in watch.images:
            for frame in _thumbnails(watch, topics, camera, frames[camera.name]):
                motion.add(frame)
    return motion


def _thumbnails(watch: LogWatch, topics: CameraTopics, camera: Camera, posed: Sequence[RgbdFrame]) -> list[RgbdFrame]:
    gray = dict(watch.images[topics.color].thumbnails if camera.depth_lens is None else ())
    at, frames = sorted(gray), []
    poses = {frame.stamp_ns: frame.T_world_camera for frame in sorted(posed, key=lambda frame: frame.stamp_ns)}
    for stamp, depth in watch.images[topics.depth].thumbnails:
        near = min(at, key=lambda other: abs(other - stamp), default=None)
        color = gray.get(near) if near is not None else None
        if color is None or color.shape != (*depth.shape, 3):
            color = np.zeros((*depth.shape, 3), np.uint8)
        frames.append(
            RgbdFrame(
                stamp_ns=stamp,
                camera=camera.name,
                color=color,
                depth=depth,
                intrinsics=thumbnail_lens(camera.intrinsics),
                T_world_camera=poses[min(poses, key=lambda other: abs(other - stamp))],
            )
        )
    return frames


IMAGES = (IMAGE, COMPRESSED_IMAGE)
NAMED_ELSEWHERE = (" are never closer than ", " images as ", "distortion model ", " says rectified")


def check_log(
    log: RawLog,
    options: SourceOptions,
    *,
    model: RobotModel | None = None,
    num_images: int | None = None,
    only_errors: bool = False,
) -> CheckReport:
    """Check `log` in one pass and bounded memory; at most `num_images` per topic.

    Raises InputError for options that fit no log.
    """
    options.refuse(("root", "holdout"), "a log", log.path)
    watch = LogWatch(log, options, num_images)
    log_survey = survey(watch, by_log_time=options.stamps == "log")
    cameras = _chosen(log, log_survey, options)
    rig = [(topics, ready(log, log_survey, topics, options)) for topics in cameras]
    whole = [(topics, camera) for topics, camera in rig if camera is not None]
    for topics, camera in whole:
        if camera.depth_scale is not None and topics.depth in watch.images:
            watch.images[topics.depth].rescale(camera.depth_scale)
    findings = _findings(log, options, watch, log_survey, rig)
    correction = read_correction(options, log.path.name)
    late_ns = {c.name: correction.late_ns(c.name) for _, c in whole if correction is not None}
    frames = {c.name: reduced_frames(t, c, watch.images, log_survey.tf, options, late_ns) for t, c in whole}
    base = log_survey.tf.still_frames(whole[0][1].world_frame) if whole else {}
    of_states = log_states(log_survey, options, model, base)
    if correction is not None:
        frames = {name: list(map(correction.frame, its)) for name, its in frames.items()}
        if of_states.states is not None:
            of_states = replace(of_states, states=correction.states(of_states.states))
    first, last = _span(log_survey)
    report = CheckReport(
        path=str(log.path),
        kind=log.container,
        duration_s=(last - first) * 1e-9,
        num_messages=log_survey.num_messages,
        start_ns=min((t.first_ns for t in watch.times.values() if t.first_ns), default=None),
        findings=[*findings, *of_states.findings],
        rates=[
            t.rate(
                is_read=log_survey.topics[name].topic.type_name in (*IMAGES, CAMERA_INFO, *STATE_TYPES, *TRANSFORMS)
            )
            for name, t in sorted(watch.times.items())
        ],
        lacks=find_lacks(
            num_cameras=len(cameras),
            num_frames=max((images.count for images in watch.images.values()), default=0),
            states_lack=of_states.lack,
        ),
    )
    return judge_frames(
        report,
        of_states.model,
        frames=list(chain.from_iterable(frames.values())),
        depth_units={c.name: watch.images[t.depth].unit for t, c in whole if frames[c.name]},
        motion=image_motion(watch, whole, frames),
        states=of_states.states,
        cut="" if watch.is_whole else f"only the first {num_images} images of a topic were read",
        only_errors=only_errors,
    )


def _chosen(log: RawLog, log_survey: Survey, options: SourceOptions) -> tuple[CameraTopics, ...]:
    cameras = camera_topics(log, log_survey, options)
    names = tuple(camera.name for camera in cameras)
    if not names:
        return ()
    refuse_unknown_cameras(log.path, (*(options.cameras or ()), *options.camera_poses, *options.intrinsics), names)
    check_mask_topics(log.path, log_survey, options.human_topics, names)
    return tuple(c for c in cameras if options.cameras is None or c.name in options.cameras)


def _findings(
    log: RawLog,
    options: SourceOptions,
    watch: LogWatch,
    log_survey: Survey,
    rig: Sequence[tuple[CameraTopics, Camera | None]],
) -> list[Finding]:
    where, cameras = log.path.name, [topics for topics, _ in rig]
    used = {name for camera in cameras for name in (camera.color, camera.depth)}
    unused = watch.images.keys() - used if cameras else set()
    findings = [
        *damage_findings(where, log_survey.damage.notes),
        *(note("remark", where, text, value=num) for text, num in log_survey.damage.remarks.items()),
        *file_findings(watch.spans),
        *_time_findings(watch, log_survey, cameras, unused),
        *_image_findings(watch, unused, {t.topic.name for t in image_topics(log_survey, "unlike")}),
        *calibration_findings(log_survey, cameras, watch.changed_infos),
        *tf_findings(log_survey, cameras, options),
        *chain.from_iterable(camera_findings(log_survey, topics, camera, options) for topics, camera in rig),
    ]
    if any(finding.code == "pose-missing" for finding in findings):
        findings = [finding for finding in findings if finding.code != "tf-ends"]  # the same, from its cause
    if log_survey.num_messages:
        lacks = [
            lack for lack in missing(log, log_survey, options) if not any(words in lack for words in NAMED_ELSEWHERE)
        ]
    else:
        damage = "nothing usable before the damage" if log_survey.damage.count else "the log holds no messages"
        lacks = [f"{damage}; record it again, or give another file"]
    parts = (lack.rpartition("; ") for lack in lacks)
    return [*findings, *(error("missing", where, what or last, last if what else "") for what, _, last in parts)]


def _span(log_survey: Survey) -> tuple[int, int]:
    entries = [t for t in log_survey.topics.values() if t.count]
    return min((t.first_log_ns for t in entries), default=0), max((t.last_log_ns for t in entries), default=0)


def _time_findings(
    watch: LogWatch, log_survey: Survey, cameras: Sequence[CameraTopics], unused: Collection[str]
) -> list[Finding]:
    names = [n for n, e in sorted(log_survey.topics.items()) if e.topic.type_name in (*IMAGES, *STATE_TYPES)]
    times = [watch.times[n] for n in names if n in watch.times and n not in unused]
    each = [f for t in times for f in time_findings(t, "images" if t.topic in watch.images else "states")]
    each += [
        replace(f, code="tf-gap") if f.code == "gap" else f
        for edge in watch.transforms.values()
        for f in time_findings(edge, "transforms")
    ]
    last_ns = max((t.last_ns for t in times if t.topic in watch.images), default=0)
    peers = [[watch.times[getattr(camera, kind)] for camera in cameras] for kind in ("color", "depth")]
    clocks = clock_findings(times)
    topics_off = {finding.where for finding in clocks if finding.code == "clock-offset"}
    clocks += [f for topics in peers for f in peer_findings(topics) if f.where not in topics_off]
    return [
        *join_gaps(each),
        *(part_findings(times) if not any(f.code in {"clock", "clock-offset"} for f in clocks) else ()),
        *clocks,
        *ending_findings(list(watch.transforms.values()), last_ns),
    ]


def _image_findings(watch: LogWatch, unused: Collection[str], unlike: Collection[str]) -> list[Finding]:
    findings, known = [], ", ".join((*COLOR_CONVERSIONS, *DEPTH_ENCODINGS))
    for name, images in sorted(watch.images.items()):
        its = list(image_findings(images))
        kinds = set(images.encodings)
        unread = sorted(kinds - set(DEPTH_ENCODINGS) - set(COLOR_CONVERSIONS))
        remedy = f"record another topic of this camera, or convert it; read: {known}"
        text = f"encoding {', '.join(map(repr, unread[:1]))} is not read"
        its += judge(WARNING if unread else None, "encoding", name, text, remedy)
        if name in unused:
            its = [replace(f, severity=NOTE, what=f"{f.what}; no camera uses the topic") for f in its]
        elif kinds & set(DEPTH_ENCODINGS) and images.num_decoded and name not in unlike:
            its += depth_findings(images)
        findings += its
    return [*findings, *sample_findings(list(watch.images.values()))]

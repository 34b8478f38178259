"""Everything that is wrong with a log, from one pass over it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.cameras import is_registered
from splatctrl_cli.io.check_arm import arm_agreement, arm_findings
from splatctrl_cli.io.check_cameras import (
    MAX_POSES,
    calibration_findings,
    lens_findings,
    pose_findings,
    tf_findings,
)
from splatctrl_cli.io.check_images import (
    KeptDepth,
    depth_findings,
    image_findings,
    strided_lens,
    thumbnail_lens,
)
from splatctrl_cli.io.check_report import CheckReport, needs
from splatctrl_cli.io.check_states import robot_findings, stream_findings
from splatctrl_cli.io.check_times import TimesWatch, clock_findings, time_findings
from splatctrl_cli.io.check_watch import LogWatch
from splatctrl_cli.io.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, TRANSFORMS
from splatctrl_cli.io.finding import Finding, error, note, warning
from splatctrl_cli.io.joints import joint_records
from splatctrl_cli.io.messages import COLOR_CONVERSIONS, DEPTH_ENCODINGS
from splatctrl_cli.io.options import CameraTopics, SourceOptions
from splatctrl_cli.io.pairing import pair_by_stamp
from splatctrl_cli.io.raw_log import RawLog
from splatctrl_cli.io.rig import camera_topics, intrinsics_of, missing, nearest_gap_ns
from splatctrl_cli.io.state_messages import STATE_TYPES
from splatctrl_cli.io.state_motion import ImageMotion
from splatctrl_cli.io.state_offset import RobotPoints, estimate_clock_offset
from splatctrl_cli.io.survey import Survey, survey
from splatctrl_cli.records import Float64, Intrinsics, JointState, LossReport, RgbdFrame
from splatctrl_cli.robot.model import RobotModel

MIN_PAIRED = 0.95  # of the images of the rarer topic
LATE_PAIR = 0.010  # [s] between colour and depth at which an arm at 1 m/s is 1 cm apart
MAX_PAIRED = 20_000  # stamps of a topic that are paired
OFFSET = 0.030  # [s] between the clocks of cameras and robot


@dataclass(frozen=True, kw_only=True)
class _View:
    """A camera whose depth can be placed: the lens and frame of its depth images, T_world_camera by kept image."""

    topics: CameraTopics
    lens: Intrinsics
    frame_id: str
    is_registered: bool
    posed: tuple[tuple[KeptDepth, Float64], ...]


def check_log(
    log: RawLog, options: SourceOptions, *, model: RobotModel | None = None, num_images: int | None = None
) -> CheckReport:
    """Read `log` once, every image decoded, in bounded memory; with `num_images` up to as many of a topic."""
    watch = LogWatch(log, options.depth_scale, num_images)
    found = survey(watch)
    findings = [warning("damaged", log.path.name, text, "copy the file again") for text in found.damage.notes]
    findings += _time_findings(watch, found)
    cameras = camera_topics(log, found, options)
    findings += _image_findings(watch, cameras)
    findings += calibration_findings(found, cameras, watch.changed_infos)
    findings += tf_findings(found, cameras, options)
    views = []
    for topics in cameras:
        findings += _pairing(found, topics, options)
        findings += _lens(found, topics)
        findings += _poses(found, topics, options)
        view = _view(watch, found, topics, options)
        views += [] if view is None else [view]
    states, states_lack, of_states = _states(found, options, model)
    findings += of_states
    if states:
        findings += _clock(watch, found, views, states, model)
        if model is not None:
            findings += _arm(views, states, model)
    if not watch.is_whole:
        findings.append(note("quick", log.path.name, f"only the first {num_images} images of a topic were read"))
    lacks = missing(log, found, options) if found.num_messages else ["the log holds no messages; record it again"]
    first, last = _span(found)
    return CheckReport(
        path=str(log.path),
        kind=log.container,
        duration_s=(last - first) * 1e-9,
        num_messages=found.num_messages,
        start_ns=watch.first_ns,
        findings=findings,
        rates=[t.rate(is_read=_is_read(found, name)) for name, t in sorted(watch.times.items())],
        needs=needs(
            lacks=lacks,
            num_cameras=len(cameras),
            num_frames=max((images.count for images in watch.images.values()), default=0),
            has_joints=bool(states),
            states_lack=states_lack,
        ),
        frames=[frame for view in views for frame in _frames(view)],
    )


def _is_read(found: Survey, name: str) -> bool:
    return found.topics[name].topic.type_name in (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, *STATE_TYPES, *TRANSFORMS)


def _span(found: Survey) -> tuple[int, int]:
    entries = [t for t in found.topics.values() if t.count]
    return min((t.first_log_ns for t in entries), default=0), max((t.last_log_ns for t in entries), default=0)


def _time_findings(watch: LogWatch, found: Survey) -> list[Finding]:
    judged = (IMAGE, COMPRESSED_IMAGE, *STATE_TYPES)
    names = [name for name, entry in sorted(found.topics.items()) if entry.topic.type_name in judged]
    times = [watch.times[name] for name in names if name in watch.times]
    findings = [f for t in times for f in time_findings(t, "images" if t.topic in watch.images else "states")]
    findings += clock_findings(times)
    edges = list(watch.transforms.values())
    return findings + [f for edge in edges for f in _edge_findings(edge)]


def _edge_findings(edge: TimesWatch) -> list[Finding]:
    """Of one moving transform: the same as of a topic, a gap under its own name."""
    return [
        replace(finding, code="tf-gap") if finding.code == "gap" else finding
        for finding in time_findings(edge, "transforms")
    ]


def _image_findings(watch: LogWatch, cameras: Sequence[CameraTopics]) -> list[Finding]:
    findings = []
    used = {name for camera in cameras for name in (camera.color, camera.depth)}
    for name, images in sorted(watch.images.items()):
        findings += image_findings(images)
        kinds = set(images.encodings)
        if name in used and kinds & set(DEPTH_ENCODINGS) and images.count > images.num_bad:
            findings += depth_findings(images)
        unread = sorted(kinds - set(DEPTH_ENCODINGS) - set(COLOR_CONVERSIONS))
        if unread:
            text = f"encoding {unread[0]!r} is not read"
            known = ", ".join((*COLOR_CONVERSIONS, *DEPTH_ENCODINGS))
            remedy = f"record another topic of this camera, or convert it; read: {known}"
            findings.append(warning("encoding", name, text, remedy))
    return findings


def _pairing(found: Survey, camera: CameraTopics, options: SourceOptions) -> list[Finding]:
    where = f"camera {camera.name}"
    color, depth = (found.topics[t].stamps_ns[:MAX_PAIRED] for t in (camera.color, camera.depth))
    pairs = pair_by_stamp(color, depth, round(options.pairing_tolerance_s * 1e9))
    rarer = min(len(color), len(depth))
    if not pairs or not rarer:
        gap = nearest_gap_ns(color, depth) * 1e-9
        text = f"no colour image has a depth image of its time; the closest are {1e3 * gap:.4g} ms apart"
        remedy = f"give --pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right"
        return [error("pairing", where, text, remedy, value=1e3 * gap, unit="ms")]
    findings = []
    if len(pairs) < MIN_PAIRED * rarer:
        text = f"{len(pairs)} of {rarer} images find a partner within {1e3 * options.pairing_tolerance_s:g} ms"
        remedy = "let the driver synchronise colour and depth, or give --pairing-tolerance"
        findings.append(warning("pairing", where, text, remedy, value=len(pairs) / rarer))
    offset = float(np.median([depth[j] - color[i] for i, j in pairs])) * 1e-9
    if abs(offset) > LATE_PAIR:
        text = f"depth is stamped {1e3 * offset:+.1f} ms against its colour image (median)"
        remedy = "let the driver synchronise colour and depth: what moves is in two places"
        findings.append(note("pair-offset", where, text, remedy, value=1e3 * offset, unit="ms"))
    return findings


def _lens(found: Survey, camera: CameraTopics) -> list[Finding]:
    names = dict.fromkeys(name for name in (camera.info, camera.depth_info) if name)
    calibrations = [(name, found.topics[name].calibration) for name in names]
    return [f for name, c in calibrations if c is not None and c.width for f in lens_findings(name, intrinsics_of(c))]


def _poses(found: Survey, camera: CameraTopics, options: SourceOptions) -> list[Finding]:
    image = found.topics[camera.color].first_image
    if camera.name in options.camera_poses or image is None or image.frame_id not in found.tf.frames:
        return []
    world = options.world_frame or found.tf.root_of(image.frame_id)
    stamps = sorted(found.topics[camera.color].stamps_ns)[:MAX_POSES]
    tolerance_ns = round(options.pose_tolerance_s * 1e9)
    poses = [found.tf.lookup(world, image.frame_id, stamp, tolerance_ns) for stamp in stamps]
    return pose_findings(f"camera {camera.name}", stamps, poses)


def _view(watch: LogWatch, found: Survey, camera: CameraTopics, options: SourceOptions) -> _View | None:
    """None where the depth images have no lens or no pose."""
    images, first = watch.images.get(camera.depth), found.topics[camera.depth].first_image
    registered = is_registered(found, camera.color, camera.depth, camera.info, camera.depth_info)
    info = camera.info if registered else camera.depth_info
    calibration = found.topics[info].calibration if info else None
    color = found.topics[camera.color].first_image
    if images is None or first is None or color is None or calibration is None:
        return None
    frame_id = color.frame_id if registered else first.frame_id
    lens = replace(intrinsics_of(calibration), width=first.width, height=first.height)
    world = options.world_frame or found.tf.root_of(frame_id)
    tolerance_ns = round(options.pose_tolerance_s * 1e9)
    given = options.camera_poses.get(camera.name)
    if given is not None and not registered:
        return None
    posed = []
    for kept in images.kept:
        T = found.tf.lookup(world, frame_id, kept.stamp_ns, tolerance_ns) if given is None else _given(given)
        if T is not None and (given is not None or frame_id in found.tf.frames):
            posed.append((kept, T))
    if not posed:
        return None
    return _View(topics=camera, lens=lens, frame_id=frame_id, is_registered=registered, posed=tuple(posed))


def _given(values: Sequence[float]) -> Float64:
    from splatctrl_cli.geometry import transform_from

    return transform_from(values[:3], values[3:])


def _frames(view: _View) -> list[RgbdFrame]:
    """The kept depth images as frames without colour."""
    return [
        RgbdFrame(
            stamp_ns=kept.stamp_ns,
            camera=view.topics.name,
            color=np.zeros((*kept.depth.shape, 3), np.uint8),
            depth=kept.depth,
            intrinsics=strided_lens(view.lens, kept),
            T_world_camera=T,
        )
        for kept, T in view.posed
    ]


def _states(
    found: Survey, options: SourceOptions, model: RobotModel | None
) -> tuple[Sequence[JointState], str, list[Finding]]:
    """The joint states (in the model's order where there is one), why there are none, and what is wrong with them."""
    findings: list[Finding] = []
    for topic in found.of_type(*STATE_TYPES):
        for stream in topic.joints.streams:
            findings += stream_findings(topic.topic.name, stream)
    loss = LossReport()
    wanted = None if model is None else model.joint_names
    try:
        names, states = joint_records(found, options, loss, wanted)
    except InputError as wrong:
        return [], str(wrong), [*findings, error("joints", "joint states", wrong.message, wrong.remedy)]
    findings += [note("joints", "joint states", text) for text in loss.notes]
    if not len(states):
        return [], "no joint states; record /joint_states, or give the states apart (docs/replay.md, Logs)", findings
    if model is None:
        return states, "", findings
    absent = [name for name in model.joint_names if name not in names]
    if absent:
        text = f"the robot's joints {', '.join(absent)} are in no joint state"
        remedy = "give this robot's URDF, or hold them still with --lock"
        return [], f"{text}; {remedy}", [*findings, error("joints", "joint states", text, remedy)]
    order = model.joint_order(names)
    ordered = [replace(s, position=s.position[order], velocity=s.velocity[order]) for s in states]
    return ordered, "", [*findings, *robot_findings(model, ordered, "joint states")]


def _clock(
    watch: LogWatch, found: Survey, views: Sequence[_View], states: Sequence[JointState], model: RobotModel | None
) -> list[Finding]:
    """The offset between the clocks of cameras and robot, from when both see it move."""
    motion = ImageMotion()
    for view in views:
        lens, T = thumbnail_lens(view.lens), view.posed[0][1]
        colors = watch.images[view.topics.color].thumbnails if view.topics.color in watch.images else []
        gray = {thumbnail.stamp_ns: thumbnail.color for thumbnail in colors} if view.is_registered else {}
        at = sorted(gray)
        for thumbnail in watch.images[view.topics.depth].thumbnails:
            near = _nearest(at, thumbnail.stamp_ns)
            color = gray.get(near) if near is not None else None
            assert thumbnail.depth is not None
            if color is None or color.shape[:2] != thumbnail.depth.shape:
                color = np.zeros((*thumbnail.depth.shape, 3), np.uint8)
            frame = RgbdFrame(
                stamp_ns=thumbnail.stamp_ns,
                camera=view.topics.name,
                color=color,
                depth=thumbnail.depth,
                intrinsics=lens,
                T_world_camera=_pose_near(view, thumbnail.stamp_ns) if len(view.posed) > 1 else T,
            )
            motion.add(frame)
    if not motion.cameras:
        return []
    robot = None
    if model is not None:
        centers = np.array([model.sphere_centers(state.position) for state in states])
        robot = RobotPoints(centers=centers, radii=model.sphere_set.radii)
    offset = estimate_clock_offset(states, motion, robot)
    if offset.offset_s is None or offset.uncertainty_s is None:
        return [note("robot-clock", "joint states", offset.sentence)]
    is_off = abs(offset.offset_s) > OFFSET + 2 * offset.uncertainty_s
    remedy = "synchronise the clocks, or shift the stamps: robot labels and replay come too late" if is_off else ""
    make = warning if is_off else note
    value = 1e3 * offset.offset_s
    return [make("robot-clock", "joint states", offset.sentence, remedy, value=value, unit="ms")]


def _pose_near(view: _View, stamp_ns: int) -> Float64:
    return min(view.posed, key=lambda item: abs(item[0].stamp_ns - stamp_ns))[1]


def _nearest(stamps: Sequence[int], stamp_ns: int) -> int | None:
    if not stamps:
        return None
    after = int(np.searchsorted(np.array(stamps), stamp_ns))
    return min(stamps[max(0, after - 1) : after + 1], key=lambda stamp: abs(stamp - stamp_ns))


def _arm(views: Sequence[_View], states: Sequence[JointState], model: RobotModel) -> list[Finding]:
    """Each camera's depth against the robot's spheres at the joint states."""
    stamps = np.array([state.stamp_ns for state in states], dtype=np.int64)
    findings: list[Finding] = []
    for view in views:
        agreement = arm_agreement(model, view.lens, view.posed, states, stamps)
        where = f"camera {view.topics.name}"
        if agreement is None:
            findings.append(note("arm", where, "too little of the arm is in view to compare it with the joints"))
        else:
            findings += arm_findings(where, agreement)
    return findings

"""A log's RGB-D cameras, and their poses from messages instead of tf.

Poses: nav_msgs/Odometry (of child_frame_id in header.frame_id), geometry_msgs/PoseStamped, PoseWithCovarianceStamped
and TransformStamped.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import islice, takewhile
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.formats.image_file import JPEG
from splatctrl_cli.libraries import is_installed
from splatctrl_cli.recording.container.log_formats import read_formats
from splatctrl_cli.recording.container.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.recording.log.decoder import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    VIDEO,
    MessageDecoder,
    UndecodableMessageError,
    device_of,
    is_ros,
    stamp_ns,
)
from splatctrl_cli.recording.log.messages import DEPTH, GRAY, OTHERS, word_of
from splatctrl_cli.recording.log.registration import is_distorted, lens_model
from splatctrl_cli.recording.log.survey import Calibration, Survey, TopicSurvey
from splatctrl_cli.recording.log.video import EXTRA, KEY_FRAME, LIBRARY, OFTENER, is_video
from splatctrl_cli.recording.source_options import CameraTopics, SourceOptions
from splatctrl_cli.records import Float64

_REGISTERED = ("aligned_depth", "registered", "depth_to_color", "depth_to_rgb")  # in names of depth topics
_ENCODINGS = ("cdr", "ros1", "protobuf", "json")  # of messages


def image_topics(survey: Survey, kind: str) -> list[TopicSurvey]:
    """Topics whose first image is of `kind`: color, depth, other or ``unlike``.

    ``unlike``: the name contradicts the image, as for 16-bit infrared.
    """
    topics = [(t, t.first_image) for t in survey.select_types(IMAGE, COMPRESSED_IMAGE)]
    return [t for t, image in topics if image is not None and kind == ("unlike" if _unlike(t) else image.kind)]


def _unlike(topic: TopicSurvey) -> str:
    image, parts = topic.image, _parts(topic.topic.name)
    if image.kind == "depth":
        word = word_of(parts) or word_of((image.frame_id,))
        return word if word in OTHERS else ""
    word = word_of(parts, is_device=False)
    return word if image.kind == "color" and word == DEPTH else ""


def find_cameras(survey: Survey, without: Collection[str] = ()) -> tuple[CameraTopics, ...]:
    """Pair colour and depth topics that share a namespace, deepest first, into named cameras.

    Prefers registered depth, colour over grey, rectified over raw, and uncompressed images.
    """
    colors = [topic for topic in image_topics(survey, "color") if topic.topic.name not in without]
    depths = image_topics(survey, "depth")
    groups: dict[tuple[str, ...], list[TopicSurvey]] = {}
    for depth in depths:
        prefixes = [common_prefix(depth.topic.name, color.topic.name) for color in colors]
        device = device_of(depth.topic.name)
        if prefixes:
            groups.setdefault((device,) if device else max(prefixes, key=len), []).append(depth)
    cameras: list[CameraTopics] = []
    used: set[str] = set()
    for namespace in sorted(groups, key=lambda parts: (-len(parts), parts)):
        free = [c for c in colors if c.topic.name not in used and _parts(c.topic.name)[: len(namespace)] == namespace]
        if not free:
            continue
        used.update(c.topic.name for c in free)
        color = min(free, key=_color_rank)
        cameras.append(_camera(survey, namespace, color, groups[namespace]))
    return _name_cameras(cameras)


def _camera(
    survey: Survey, namespace: tuple[str, ...], color: TopicSurvey, depths: list[TopicSurvey]
) -> CameraTopics:
    info = find_info(survey, color, namespace)
    depths = [d for d in depths if word_of(_parts(d.topic.name)) == DEPTH] or depths
    names = {_family(d.topic.name): d.topic.name for d in reversed(depths) if word_of(_parts(d.topic.name)) != DEPTH}
    depth, depth_info = min(
        [(depth, find_info(survey, depth, namespace)) for depth in depths],
        key=lambda item: (
            not is_registered(survey, color.topic.name, item[0].topic.name, info, item[1]),
            not any(word in item[0].topic.name for word in _REGISTERED),
            item[0].topic.type_name == COMPRESSED_IMAGE,
            item[0].topic.name,
        ),
    )
    info = info or (depth_info if _is_of_file(color) else "")
    return CameraTopics(
        name="/".join(namespace),
        color=color.topic.name,
        depth=depth.topic.name,
        info=info or "",
        depth_info=depth_info or "",
        rivals=tuple(sorted(names.values())) if len(names) > 1 else (),
    )


def _family(name: str) -> tuple[str, ...]:
    parts = _parts(name)
    return (*parts[:-1], re.sub("_?(rect|raw)", "", parts[-1]))


def find_info(survey: Survey, image: TopicSurvey, namespace: tuple[str, ...] | None = None) -> str:
    """The CameraInfo topic of an image topic, "" if none.

    It shares more path with the image than `namespace`, is in the image's folder or the namespace's, or has the
    image's frame and size.
    """
    folder, its = _parts(image.topic.name)[:-1], image.first_image
    view = ("", 0, 0) if its is None else (its.frame_id, its.width, its.height)
    level = len(folder) - 1 if namespace is None else len(namespace)
    candidates: list[tuple[int, int, str]] = []
    for info in survey.select_types(CAMERA_INFO):
        calibration = info.calibration
        if calibration is None:
            continue
        info_folder = _parts(info.topic.name)[:-1]
        shared = len(common_prefix(info.topic.name, image.topic.name))
        is_near = shared > level or info_folder in {folder, folder[:level]}
        if is_near or (view == (calibration.frame_id, calibration.width, calibration.height) and view[0] != ""):
            candidates.append((-shared, len(info_folder), info.topic.name))
    return min(candidates)[2] if candidates else ""


def is_registered(survey: Survey, color: str, depth: str, info: str, depth_info: str) -> bool:
    """True if depth is on colour pixels, by size, frame (or topic name), K and distortion."""
    color_image, depth_image = survey.topics[color].image, survey.topics[depth].image
    is_other_size = (color_image.width, color_image.height) != (depth_image.width, depth_image.height)
    T_color_depth = survey.realsense.T_between(color, depth)
    is_moved = T_color_depth is not None and not np.allclose(T_color_depth, np.eye(4), atol=1e-6)
    is_other_frame = frame_of(survey, color, depth) != depth_image.frame_id
    if is_other_size or is_moved or (is_other_frame and not any(word in depth for word in _REGISTERED)):
        return False
    calibration = survey.topics[info].calibration if info else None
    depth_calibration = survey.topics[depth_info].calibration if depth_info else None
    if calibration is None or depth_calibration is None:
        return True
    is_same_K = bool(abs(calibration.K - depth_calibration.K).max() <= 0.01 * calibration.K[0, 0])
    return is_same_K and _same_distortion(calibration, depth_calibration)


def _same_distortion(one: Calibration, two: Calibration) -> bool:
    bent = [is_distorted(c.distortion_model, c.distortion) for c in (one, two)]
    if not all(bent):
        return not any(bent)
    a, b = (np.pad(c.distortion, (0, 14))[:14] for c in (one, two))
    return lens_model(one.distortion_model) == lens_model(two.distortion_model) and bool(np.allclose(a, b, atol=1e-6))


def frame_of(survey: Survey, color: str, depth: str) -> str:
    """Frame of the colour images; for a video file, of the depth images."""
    return survey.topics[depth if _is_of_file(survey.topics[color]) else color].image.frame_id


def _is_of_file(topic: TopicSurvey) -> bool:
    return topic.topic.encoding == VIDEO and topic.first_image is not None and not topic.first_image.frame_id


def common_prefix(name: str, other: str) -> tuple[str, ...]:
    """Leading path parts two topics share, without their last."""
    pairs = zip(_parts(name)[:-1], _parts(other)[:-1], strict=False)
    return tuple(a for a, _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _color_rank(topic: TopicSurvey) -> tuple[bool, bool, bool, bool, str]:
    name = topic.topic.name
    return (
        topic.image.encoding in GRAY,
        any(part.startswith(("infra", "ir")) for part in _parts(name)),
        "rect" not in name,
        topic.topic.type_name == COMPRESSED_IMAGE,
        name,
    )


def _parts(name: str) -> tuple[str, ...]:
    parts = tuple(part for part in name.split("/") if part)
    return parts[:-1] if len(parts) > 1 and parts[-1] in {"compressed", "compressedDepth"} else parts


def _name_cameras(cameras: list[CameraTopics]) -> tuple[CameraTopics, ...]:
    """Name cameras by the namespace's last part if unique, else all of it.

    Names are folders: unusual characters become ``_``.
    """
    short, long = (
        [re.sub(r"[^\w.-]", "_", name).lstrip(".-")[:80] or "camera" for name in names]
        for names in ([c.name.rpartition("/")[2] for c in cameras], [c.name.replace("/", "_") for c in cameras])
    )
    names = [name if short.count(name) == 1 else long[i] for i, name in enumerate(short)]
    named = [
        replace(camera, name=name if names.count(name) == 1 else f"{name}_{i}")
        for i, (camera, name) in enumerate(zip(cameras, names, strict=True))
    ]
    return tuple(sorted(named, key=lambda camera: camera.name))


def no_camera(log: RawLog, survey: Survey) -> InputError:
    colors, depths = ([t.topic.name for t in image_topics(survey, kind)] for kind in ("color", "depth"))
    broken = [t.topic.name for t in survey.select_types(IMAGE, COMPRESSED_IMAGE) if t.first_image is None]
    topics = [t.topic for t in survey.topics.values() if t.count]
    rgbd = [f"{t.type_name} on {t.name}" for t in topics if t.type_name.rpartition("/")[2].startswith("RGBD")]
    named, first = _named_unlike(survey), "".join(broken[:1])
    chosen = "; if one of these is depth, give --camera NAME=COLOR,DEPTH" if "(named " in named else ""
    unread = "".join(f"; {note}" for note in survey.damage.remarks if any(name in note for name in broken))
    videos = ", ".join(sorted(topic.name for topic in topics if is_video(topic)))
    lacks = "" if depths else "; and there is no depth topic"
    codec, to_images = (
        "which is neither H.264 nor H.265",
        "`ros2 run image_transport republish` for ROS topics, else ffmpeg",
    )
    lost = next((note for note in survey.damage.notes if KEY_FRAME in note), "")
    why = next((note for note in survey.damage.all_notes if "image" in note or first in note), "see `splatctrl info`")
    kinds = listed(sorted({_kind(topic) for topic in topics}))
    formats = read_formats(log.path) or {topic.encoding for topic in topics}
    alien = sorted(formats - set(_ENCODINGS))
    reasons = [
        (
            rgbd and not (colors and depths),
            f"colour and depth are in one message, which is not read: {''.join(rgbd[:1])}",
            "record the camera's own topics instead: colour and aligned depth images, their camera_info, tf",
        ),
        (
            not depths and (colors or named),
            f"no depth topic{named}{unread}; colour topics there: {listed(colors)}",
            f"record 16UC1, mono16 or 32FC1 depth images (info and replay of joint states work without){chosen}",
        ),
        (
            videos and not colors and not is_installed(LIBRARY),
            f"colour is video ({videos}), for which the library {LIBRARY} is not installed{lacks}",
            f"pip install 'splatctrl-cli[{EXTRA}]'",
        ),
        (
            videos and not colors,
            f"colour is video ({videos}), {codec}{lacks}",
            f"decode it to images first: {to_images}",
        ),
        (lost and not colors, f"no image of the video can be decoded ({lost})", OFTENER),
        (
            broken,
            f"no image of {listed(broken)} can be decoded ({why.removeprefix(f'{first}: ')})",
            "record raw images, JPEG or PNG; decode video to images first",
        ),
        (
            depths and not colors,
            f"no colour topic{named}; depth topics there: {listed(depths)}",
            "record the colour images",
        ),
        (
            alien and len(alien) == len(formats),
            f"expected messages in {', '.join(_ENCODINGS)}, got {', '.join(alien)}: {kinds}",
            "convert the log, for example with `ros2 bag convert`",
        ),
        (True, f"no image topics; message types there: {kinds}", "expected sensor_msgs Image or CompressedImage"),
    ]
    what, remedy = next((what, remedy) for is_so, what, remedy in reasons if is_so)
    return InputError(f"{log.path}: {what}", remedy=remedy)


def _named_unlike(survey: Survey) -> str:
    texts = []
    for topic in image_topics(survey, "unlike"):
        image, name = topic.image, topic.topic.name
        is_jpeg = image.compressed is not None and image.compressed.startswith(JPEG)
        lossy = (
            "depth in a JPEG: JPEG loses depth: record PNG" if is_jpeg else f"{image.encoding} that is named depth"
        )
        texts.append(f"{name} ({f'named {_unlike(topic)}' if image.kind == 'depth' else lossy})")
    return f"; neither depth nor colour: {listed(texts)}" if texts else ""


def listed(names: Sequence[str]) -> str:
    """The first eight names, then the number of others."""
    shown = ", ".join(names[:8]) or "none"
    return f"{shown} and {len(names) - 8} more" if len(names) > 8 else shown


def _kind(topic: Topic) -> str:
    name = topic.schema or topic.type_name
    return name if is_ros(topic) and name else f"{name} ({topic.encoding})".strip()


ODOMETRY, TRANSFORM_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
POSE_TYPES = (
    ODOMETRY,
    TRANSFORM_STAMPED,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)


StampedPose = tuple[str, str, int, Float64, Float64]
"""Parent, child ("" where a message names none), stamp [ns], position (3,) [m], quat_xyzw (4,) of T_parent_child."""


def join_pose_topics(
    log: RawLog, survey: Survey, options: SourceOptions, cameras: Sequence[CameraTopics], *, only_first: bool = False
) -> None:
    """Add poses from topics to a survey's tf tree.

    Options name topics by camera. Without these, an odometry is used, with a note, if tf misses its child, a camera's
    frame, or its parent, the world frame. only_first: one pose, enough to see connections. Raises InputError if a
    topic cannot place its camera, or several odometries place one frame.
    """
    frames = {camera.name: survey.topics[camera.color].image.frame_id for camera in cameras}
    by_camera = {name: pose_topic for name, pose_topic in options.camera_pose_topics.items() if name in frames}
    for topic, child in (
        {
            pose_topic[0]: _child_of(log, survey, name, pose_topic, frames[name])
            for name, pose_topic in by_camera.items()
        }
        or _odometries(log, survey, options, set(frames.values()))
    ).items():
        _add(log, survey, topic, child, only_first=only_first)


def pose_topics(survey: Survey) -> list[str]:
    return [topic.topic.name for topic in survey.select_types(*POSE_TYPES)]


def _child_of(log: RawLog, survey: Survey, camera: str, pose_topic: tuple[str, str], frame: str) -> str:
    topic, posed = pose_topic
    where = f"{log.path}: --camera-pose {camera}={topic}"
    refuse_if(
        topic not in pose_topics(survey),
        f"{where}: no poses on that topic",
        remedy=f"expected {', '.join(name.rpartition('/')[2] for name in POSE_TYPES)}; pose topics there:"
        f" {', '.join(pose_topics(survey)) or 'none'}",
    )
    _, first_child, *_ = next(_poses(log, survey, topic, Damage()), ("", ""))
    child = posed or first_child or frame
    tf = survey.tf
    refuse_if(
        child != frame and not tf.connects(child, frame),
        f"{where}: poses frame {child!r}, which tf does not join to the camera's frame {frame!r}",
        remedy=f"record /tf_static, or give --camera-pose {camera}={topic}@{frame} if it poses the camera",
    )
    refuse_if(
        tf.root_of(child) != child,
        f"{where}: tf has frame {child!r} in {tf.root_of(child)!r} already",
        remedy="leave the option out",
    )
    return child


def _odometries(log: RawLog, survey: Survey, options: SourceOptions, frames: set[str]) -> dict[str, str]:
    known = set(survey.tf.frames)
    odometries: dict[str, str] = {}
    for topic in survey.select_types(ODOMETRY):
        parent, child, *_ = next(_poses(log, survey, topic.topic.name, Damage()), ("", ""))
        if not child or child == parent or survey.tf.root_of(child) != child:
            continue
        places_camera = child in frames - known
        reaches_world = options.world_frame not in known and options.world_frame == parent
        if places_camera or (reaches_world and child in known | frames):
            odometries[topic.topic.name] = child
        elif child in known and any(survey.tf.root_of(frame) == child for frame in frames & known):
            survey.tf.note(
                f"{topic.topic.name} says where {child!r} is in {parent!r}; to use it give --world-frame {parent}"
            )
    for child in sorted(set(odometries.values())):
        topics = sorted(name for name, posed in odometries.items() if posed == child)
        refuse_if(
            len(topics) > 1,
            f"{log.path}: {len(topics)} odometries place frame {child!r}: {', '.join(topics)}",
            remedy=f"choose one with --camera-pose NAME={topics[0]}",
        )
    for name, child in odometries.items():
        survey.tf.note(f"poses of frame {child!r} are those of {name}: tf does not say where it is")
    return odometries


def _add(log: RawLog, survey: Survey, topic: str, child: str, *, only_first: bool) -> None:
    if survey.tf.root_of(child) != child:
        return  # added before
    for parent, _, stamp, position, quat_xyzw in islice(
        _poses(log, survey, topic, survey.damage), 1 if only_first else None
    ):
        try:
            survey.tf.add(parent, child, stamp, position, quat_xyzw, static=False, holds=only_first)
        except ValueError as error:
            survey.damage.add(f"{topic}: {error}")


def _poses(log: RawLog, survey: Survey, topic: str, damage: Damage) -> Iterator[StampedPose]:
    decoder = MessageDecoder()
    for message in log.messages(Damage(), {topic}):  # the survey has counted this damage
        try:
            yield _pose(message, decoder.decode(message), by_log_time=survey.by_log_time)
        except (UndecodableMessageError, AttributeError) as error:
            damage.add(f"{topic}: {error}")


def _pose(message: RawMessage, decoded: Any, *, by_log_time: bool) -> StampedPose:
    kind = message.topic.type_name
    if kind == TRANSFORM_STAMPED:
        position, orientation = decoded.transform.translation, decoded.transform.rotation
    else:
        pose = decoded.pose if kind == "geometry_msgs/msg/PoseStamped" else decoded.pose.pose
        position, orientation = pose.position, pose.orientation
    return (
        decoded.header.frame_id.strip("/") or "world",
        str(getattr(decoded, "child_frame_id", "")).strip("/"),
        message.log_time_ns if by_log_time else stamp_ns(decoded.header),
        np.array([position.x, position.y, position.z], dtype=np.float64),
        np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64),
    )

"""Poses that a log has as messages of their own instead of tf: odometry, tracked poses, stamped transforms.

Fields are those of nav_msgs/Odometry (the pose of child_frame_id in header.frame_id), geometry_msgs/PoseStamped,
PoseWithCovarianceStamped and TransformStamped.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.decoder import MessageDecoder, UndecodableMessageError, stamp_ns
from splatctrl_cli.logs.source_options import CameraTopics, PoseTopic, SourceOptions
from splatctrl_cli.logs.survey import Survey
from splatctrl_cli.records import Float64

ODOMETRY, TRANSFORM_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
POSE_TYPES = (
    ODOMETRY,
    TRANSFORM_STAMPED,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)


@dataclass(frozen=True, kw_only=True)
class StampedPose:
    """T_parent_child as one message says it; child is "" where the message names none."""

    stamp_ns: int
    parent: str
    child: str
    position: Float64
    quat_xyzw: Float64


def join_pose_topics(
    log: RawLog, survey: Survey, options: SourceOptions, cameras: Sequence[CameraTopics], *, only_first: bool = False
) -> None:
    """Add to the tf tree of a survey what pose topics say of its cameras; what is used without being asked is noted.

    A person names topics by camera. Else an odometry is taken whose child is a camera's frame that tf does not know,
    or whose parent is the world frame asked for. only_first: the first pose alone, enough to see what joins what.
    Raises InputError where a topic cannot place its camera, and where several odometries could.
    """
    frames = {camera.name: _frame(survey, camera) for camera in cameras}
    asked = {name: given for name, given in options.camera_pose_topics.items() if name in frames}
    children = {
        given.topic: _child_of(log, survey, name, given, frames[name]) for name, given in asked.items()
    } or _odometries(log, survey, options, set(frames.values()))
    for topic, child in children.items():
        _add(log, survey, topic, child, only_first=only_first)


def pose_topics(survey: Survey) -> list[str]:
    """The topics that hold poses."""
    return [topic.topic.name for topic in survey.of_type(*POSE_TYPES)]


def _frame(survey: Survey, camera: CameraTopics) -> str:
    image = survey.topics[camera.color].first_image
    return "" if image is None else image.frame_id


def _child_of(log: RawLog, survey: Survey, camera: str, given: PoseTopic, frame: str) -> str:
    """The frame that a topic poses. Raises InputError where that does not place the camera."""
    where = f"{log.path}: --camera-pose {camera}={given.topic}"
    if given.topic not in pose_topics(survey):
        raise InputError(
            f"{where}: no poses on that topic",
            remedy=f"expected {', '.join(name.rpartition('/')[2] for name in POSE_TYPES)}; pose topics there:"
            f" {', '.join(pose_topics(survey)) or 'none'}",
        )
    first = next(_poses(log, survey, given.topic, Damage()), None)
    child = given.frame or (first.child if first is not None and first.child else frame)
    tf = survey.tf
    if child != frame and not tf.connects(child, frame):
        raise InputError(
            f"{where}: poses frame {child!r}, which tf does not join to the camera's frame {frame!r}",
            remedy=f"record /tf_static, or give --camera-pose {camera}={given.topic}@{frame} if it poses the camera",
        )
    if tf.root_of(child) != child:
        raise InputError(
            f"{where}: tf has frame {child!r} in {tf.root_of(child)!r} already", remedy="leave the option out"
        )
    return child


def _odometries(log: RawLog, survey: Survey, options: SourceOptions, frames: set[str]) -> dict[str, str]:
    """The frame that each odometry poses that nothing else places."""
    known = set(survey.tf.frames)
    found: dict[str, str] = {}
    for topic in survey.of_type(ODOMETRY):
        first = next(_poses(log, survey, topic.topic.name, Damage()), None)
        if (
            first is None
            or not first.child
            or first.child == first.parent
            or survey.tf.root_of(first.child) != first.child
        ):
            continue
        places_camera = first.child in frames - known
        reaches_world = options.world_frame not in known and options.world_frame == first.parent
        if places_camera or (reaches_world and first.child in known | frames):
            found[topic.topic.name] = first.child
        elif first.child in known and any(survey.tf.root_of(frame) == first.child for frame in frames & known):
            survey.tf.note(
                f"{topic.topic.name} says where {first.child!r} is in {first.parent!r}; to use it give"
                f" --world-frame {first.parent}"
            )
    for child in sorted(set(found.values())):
        topics = sorted(name for name, posed in found.items() if posed == child)
        if len(topics) > 1:
            raise InputError(
                f"{log.path}: {len(topics)} odometries place frame {child!r}: {', '.join(topics)}",
                remedy=f"choose one with --camera-pose NAME={topics[0]}",
            )
    for name, child in found.items():
        survey.tf.note(f"poses of frame {child!r} are those of {name}: tf does not say where it is")
    return found


def _add(log: RawLog, survey: Survey, topic: str, child: str, *, only_first: bool) -> None:
    """The poses of a topic as those of a frame."""
    if survey.tf.root_of(child) != child:
        return  # added before
    for pose in _poses(log, survey, topic, survey.damage):
        try:
            survey.tf.add(
                pose.parent, child, pose.stamp_ns, pose.position, pose.quat_xyzw, static=False, holds=only_first
            )
        except ValueError as error:
            survey.damage.add(f"{topic}: {error}")
        if only_first:
            return


def _poses(log: RawLog, survey: Survey, topic: str, damage: Damage) -> Iterator[StampedPose]:
    """The poses of a topic; messages that do not decode go to `damage`."""
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
    return StampedPose(
        stamp_ns=message.log_time_ns if by_log_time else stamp_ns(decoded.header),
        parent=decoded.header.frame_id.strip("/") or "world",
        child=str(getattr(decoded, "child_frame_id", "")).strip("/"),
        position=np.array([position.x, position.y, position.z], dtype=np.float64),
        quat_xyzw=np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64),
    )

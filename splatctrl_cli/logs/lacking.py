"""Why a log has no camera, in words, and names in lists."""

from collections.abc import Sequence

from splatctrl_cli.containers.bag_log import told_formats
from splatctrl_cli.containers.raw_log import RawLog, Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.cameras import image_topics
from splatctrl_cli.logs.decoder import COMPRESSED_IMAGE, IMAGE, is_ros
from splatctrl_cli.logs.survey import Survey

_ENCODINGS = ("cdr", "ros1", "protobuf", "json")  # of messages


def no_camera(log: RawLog, survey: Survey) -> InputError:
    """The refusal of a log in which no colour and depth belong together."""
    colors = [t.topic.name for t in image_topics(survey, "color")]
    depths = [t.topic.name for t in image_topics(survey, "depth")]
    if colors and not depths:
        return InputError(
            f"{log.path}: no depth topic; colour topics there: {listed(colors)}",
            remedy="record 16UC1, mono16 or 32FC1 depth images",
        )
    videos = sorted(t.topic.name for t in survey.topics.values() if t.count and _is_video(t.topic))
    if depths and not colors and videos:
        return InputError(
            f"{log.path}: colour is video ({', '.join(videos)}), which is not read",
            remedy="decode it to images first: `ros2 run image_transport republish` for ROS topics, else ffmpeg",
        )
    broken = [t.topic.name for t in survey.of_type(IMAGE, COMPRESSED_IMAGE) if t.first_image is None]
    if broken:
        why = next((note for note in survey.damage.notes if "image" in note), "see `splatctrl info`")
        return InputError(
            f"{log.path}: no image of {listed(broken)} can be decoded ({why})",
            remedy="record raw images, JPEG or PNG; decode video to images first",
        )
    if depths and not colors:
        return InputError(
            f"{log.path}: no colour topic; depth topics there: {listed(depths)}", remedy="record the colour images"
        )
    topics = [t.topic for t in survey.topics.values() if t.count]
    kinds = sorted({_kind(topic) for topic in topics})
    if videos:
        return InputError(
            f"{log.path}: colour is video ({', '.join(videos)}), which is not read, and there is no depth topic",
            remedy="record depth images, and decode the video to images first",
        )
    formats = told_formats(log.path) or {topic.encoding for topic in topics}
    alien = sorted(formats - set(_ENCODINGS))
    if alien and len(alien) == len(formats):
        return InputError(
            f"{log.path}: expected messages in {', '.join(_ENCODINGS)}, got {', '.join(alien)}: {listed(kinds)}",
            remedy="convert the log, for example with `ros2 bag convert`",
        )
    return InputError(
        f"{log.path}: no image topics; message types there: {listed(kinds)}",
        remedy="expected sensor_msgs Image or CompressedImage",
    )


def _is_video(topic: Topic) -> bool:
    """Foxglove's CompressedVideo, or ffmpeg_image_transport's packets."""
    return (topic.schema or topic.type_name).endswith(("CompressedVideo", "FFMPEGPacket"))


def listed(names: Sequence[str]) -> str:
    """Up to eight names, then how many more."""
    shown = ", ".join(names[:8]) or "none"
    return f"{shown} and {len(names) - 8} more" if len(names) > 8 else shown


def _kind(topic: Topic) -> str:
    """The type of a topic's messages, and their encoding where it is none of ROS."""
    name = topic.schema or topic.type_name
    return name if is_ros(topic) and name else f"{name} ({topic.encoding})".strip()

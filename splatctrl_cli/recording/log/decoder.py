"""Decoded messages of the standard types, by the definitions in the log; and RealSense extras.

RealSense bags have extrinsics and depth units on ``/device_D/sensor_S/STREAM_N/...`` (librealsense,
src/media/ros/ros_file_format.h). ``tf/R`` maps points of group R's reference stream to STREAM_N: T_color_depth =
T_color_R T_R_depth (docs/formats.md). In newer bags (2.5x) an image's frame is "1", and a little-endian float32
follows the message: metres per count of depth, 0 for other images (src/media/ros/ros_writer.cpp).
"""

import re
import struct
from dataclasses import dataclass, field
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.geometry import invert_transform, transform_from
from splatctrl_cli.recording.container.foxglove import DEFINITIONS, TEXT, as_ros, read_foxglove
from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.records import Float64

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"
VIDEO = "video"  # the encoding of images that were taken out of video, `pack_image`
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_KNOWN = frozenset(  # what is read by its fields
    {
        *(IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, JOINT_STATE, TRANSFORMS[0], "std_msgs/msg/Header"),
        *("builtin_interfaces/msg/Time", "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/Transform"),
        *("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Quaternion", "geometry_msgs/msg/Twist"),
        *("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Pose", "geometry_msgs/msg/Point"),
    }
)
_IMAGE_HEAD = struct.Struct("<4siIIII")
_MOST_TEXT = 1 << 20  # characters of a definition
_MOST_ITEMS = 1 << 16  # of a fixed array in a definition: code is generated for each item that is not a number
_DIRECTIVE = re.compile(r"^[ \t]*#.*$", re.MULTILINE)  # of IDL: what it includes is another part of the text
_ARRAY = re.compile(r"\[\s*(\d+)\s*\]|,\s*(\d+)\s*>")  # `type[N]` of .msg, `sequence<type, N>` of .idl


class UndecodableMessageError(ValueError):
    """A message whose bytes do not fit its type."""


class UnreadFormError(UndecodableMessageError):
    """A message of an unread or refused form, perhaps undamaged."""


def is_ros(topic: Topic) -> bool:
    return topic.encoding in {"cdr", "ros1", VIDEO} or is_foxglove(topic)


def is_foxglove(topic: Topic) -> bool:
    return topic.schema != "" and topic.encoding in {"protobuf", "json"}


class MessageDecoder:
    """A decoder with type definitions by topic: an unusable one affects no other topic."""

    def __init__(self) -> None:
        self._stores: dict[Topic, Any] = {}
        self._refused: dict[Topic, str] = {}

    def decode(self, message: RawMessage) -> Any:
        """Decode to an object with fields. Raises UndecodableMessageError."""
        topic = message.topic
        if topic.encoding == VIDEO:
            _, seconds, nanoseconds, height, width, length = _IMAGE_HEAD.unpack_from(message.data)
            start, stamp = _IMAGE_HEAD.size + length, SimpleNamespace(sec=seconds, nanosec=nanoseconds)
            return SimpleNamespace(
                header=SimpleNamespace(stamp=stamp, frame_id=message.data[_IMAGE_HEAD.size : start].decode()),
                height=height,
                width=width,
                encoding="rgb8",
                is_bigendian=0,
                step=3 * width,
                data=np.frombuffer(message.data, np.uint8, offset=start),
            )
        store = None if is_foxglove(topic) else self._store(topic)
        with refuse_faults(
            f"{topic.name}: a {topic.schema or topic.type_name} that does not decode",
            Exception,
            error=UndecodableMessageError,
        ):  # generated code over foreign bytes: there is no list of what it raises
            if store is None:
                return read_foxglove(topic.schema, topic.encoding, topic.definition, message.data)
            read = store.deserialize_ros1 if topic.encoding == "ros1" else store.deserialize_cdr
            decoded = read(message.data[:-4] if has_unit(message) else message.data, topic.schema or topic.type_name)
            return as_ros(topic.schema, decoded) if topic.schema else decoded

    def _store(self, topic: Topic) -> Any:
        if topic not in self._stores and topic not in self._refused:
            try:
                self._stores[topic] = _type_store(topic)
            except Exception as error:  # a parser over foreign text, RecursionError and MemoryError included
                self._refused[topic] = " ".join(str(error).split())[:200] or type(error).__name__
        if topic in self._refused:
            raise UnreadFormError(
                f"{topic.name}: the definition of {topic.type_name} is not usable: {self._refused[topic]}"
            )
        return self._stores[topic]


def header_stamp_ns(message: RawMessage) -> int:
    """Stamp of a message that begins with a std_msgs/Header, without decoding the rest.

    The stamp's two 32-bit words follow four bytes (CDR's encapsulation, or ROS 1's `seq`). Raises
    UndecodableMessageError if too short.
    """
    if message.topic.schema == TEXT:
        return message.log_time_ns
    if is_foxglove(message.topic):
        return stamp_ns(MessageDecoder().decode(message).header)
    start = 0 if message.topic.schema and message.topic.encoding == "ros1" else 4  # foxglove_msgs have no `seq`
    is_little = message.topic.encoding == "ros1" or message.data[1:2] in {b"\x01", b"\x03", b"\x07", b"\x09"}
    damage = f"{message.topic.name}: a message of {len(message.data)} bytes"
    with refuse_faults(lambda _: damage, struct.error, error=UndecodableMessageError):
        seconds, nanoseconds = struct.unpack_from("<iI" if is_little else ">iI", message.data, start)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def pack_image(header: Any, pixels: NDArray[np.uint8]) -> bytes:
    """Pack an RGB video image (H, W, 3), with its stamp where CDR has it."""
    frame, (height, width) = header.frame_id.strip("/").encode(), pixels.shape[:2]
    head = _IMAGE_HEAD.pack(b"\0\1\0\0", header.stamp.sec, header.stamp.nanosec, height, width, len(frame))
    return bytes(head + frame + pixels.tobytes())


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _type_store(topic: Topic) -> Any:
    if not topic.definition and topic.schema in DEFINITIONS:
        return _foxglove_store()
    if not topic.definition:
        return get_typestore(Stores.ROS1_NOETIC if topic.encoding == "ros1" else Stores.ROS2_HUMBLE)
    refuse_if(
        len(topic.definition) > _MOST_TEXT,
        f"{len(topic.definition)} characters, at most {_MOST_TEXT} are read",
        error=ValueError,
    )  # it would take much memory or time to compile
    largest = max((int("".join(sizes)[:12]) for sizes in _ARRAY.findall(topic.definition)), default=0)
    refuse_if(largest > _MOST_ITEMS, f"an array of {largest} items, at most {_MOST_ITEMS} are read", error=ValueError)
    return _store_of(topic.definition, topic.definition_format, topic.schema or topic.type_name)


@lru_cache(maxsize=32)
def _store_of(definition: str, form: str, type_name: str) -> Any:
    store = get_typestore(Stores.EMPTY)
    if form == "idl":
        for part in filter(str.strip, definition.split("=" * 80 + "\n")):
            body = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
            store.register(get_types_from_idl(_DIRECTIVE.sub("", body)))
    else:
        store.register(get_types_from_msg(definition, type_name))
    _check_fields(store)
    named = {name for _, fields in store.fielddefs.values() for _, kind in fields for name in _names(kind)}
    if form == "idl" and (missing := sorted(named - store.fielddefs.keys())):
        raise ValueError(f"it names {', '.join(missing)}, which its text does not define")
    return store


def _names(description: Any) -> list[str]:
    kind, detail = description
    return [detail] if kind == Nodetype.NAME else [] if kind == Nodetype.BASE else _names(detail[0])


def _check_fields(store: Any) -> None:
    standard = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    for name in sorted(_KNOWN & store.fielddefs.keys()):
        fields = {key.lower(): _kind(description) for key, description in store.fielddefs[name][1]}
        for key, description in standard[name][1]:
            refuse_if(
                fields.get(key) != _kind(description),
                f"{name} lacks the field {key} of the standard",
                error=ValueError,
            )


@lru_cache(maxsize=1)
def _foxglove_store() -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    return store


def _kind(description: Any) -> object:
    kind, detail = description
    return detail if kind == Nodetype.NAME else detail[0] if kind == Nodetype.BASE else [_kind(detail[0])]


TRANSFORM, OPTION = "geometry_msgs/msg/Transform", "std_msgs/msg/Float32"
_STREAM = re.compile(r"/(device_\d+)/(sensor_\d+)/([A-Za-z0-9]+_\d+)/")
_EXTRINSICS = re.compile(r"(/device_\d+/sensor_\d+/[A-Za-z0-9]+_\d+)/tf/(?:ref_)?(\d+)")
_FRAME_1, _AT = b"\x01\x00\x00\x001", 12  # a header's frame behind its number and stamp: its length, then its text
_DEPTH_UNITS = re.compile(r"(/device_\d+/sensor_\d+)/option/Depth[ _]Units/value")


@dataclass(kw_only=True)
class RealSense:
    """Extrinsics by stream and group, depth units [m] by sensor, image units [m] by stream."""

    extrinsics: dict[str, dict[str, Float64]] = field(default_factory=dict)
    depth_units: dict[str, float] = field(default_factory=dict)
    image_units: dict[str, list[float]] = field(default_factory=dict)

    def add(self, topic: str, message: Any) -> None:
        """Store extrinsics or a depth unit; ignore other topics. Raises ValueError if invalid."""
        extrinsics, units = _EXTRINSICS.fullmatch(topic), _DEPTH_UNITS.fullmatch(topic)
        if extrinsics:
            t, r = message.translation, message.rotation
            quat_xyzw = np.array([r.x, r.y, r.z, r.w], dtype=np.float64)
            position = np.array([t.x, t.y, t.z], dtype=np.float64)
            refuse_if(
                not (np.isfinite(position).all() and 0.5 < np.linalg.norm(quat_xyzw) < 2.0),
                f"{topic}: not a rigid transform",
                error=ValueError,
            )
            self.extrinsics.setdefault(extrinsics[1], {})[extrinsics[2]] = transform_from(position, quat_xyzw)
        elif units:
            self.depth_units[units[1]] = _unit(message.data, topic)
        elif topic.endswith("/image/metadata") and message.data:
            self._say(topic, message.data)

    def add_image(self, message: RawMessage) -> None:
        """Store an image's depth unit, if any. Raises ValueError if invalid."""
        if has_unit(message) and (value := struct.unpack("<f", message.data[-4:])[0]):
            self._say(message.topic.name, value)

    def _say(self, topic: str, value: float) -> None:
        units, unit = self.image_units.setdefault(_stream(topic), []), _unit(value, topic)
        if unit not in units:
            units.append(unit)

    def T_between(self, to_topic: str, from_topic: str) -> Float64 | None:
        """T_to_from (4, 4) of two image topics' streams; None without a common group."""
        to_all, from_all = (self.extrinsics.get(_stream(topic), {}) for topic in (to_topic, from_topic))
        group = next((group for group in to_all if group in from_all), None)
        return None if group is None else to_all[group] @ invert_transform(from_all[group])

    def depth_unit(self, topic: str) -> float | None:
        """Metres per count, None if unknown. Raises InputError if it changes."""
        units = self.image_units.get(_stream(topic), [])
        if len(units) > 1:
            raise InputError(
                f"topic {topic}: the depth unit changes, from {units[0]:g} to {units[1]:g} m",
                remedy="cut the bag there, or give --depth-scale [m per count] for all of it",
            )
        return units[0] if units else self.depth_units.get(_stream(topic).rpartition("/")[0])


def has_unit(message: RawMessage) -> bool:
    topic = message.topic
    is_image = topic.encoding == "ros1" and topic.type_name == "sensor_msgs/msg/Image"
    return is_image and message.data[_AT : _AT + len(_FRAME_1)] == _FRAME_1 and device_of(topic.name) != ""


def device_of(topic: str) -> str:
    match = _STREAM.match(topic)
    return match[1] if match else ""


def _unit(value: float, topic: str) -> float:
    """Metres per count, to six digits (0.001 was a float32)."""
    unit = float(f"{float(value):.6g}")
    refuse_if(not 0 < unit < 1, f"{topic}: expected metres per count, got {unit}", error=ValueError)
    return unit


def _stream(topic: str) -> str:
    match = _STREAM.match(topic)
    return match[0].rstrip("/") if match else ""

"""What bags of the RealSense SDK say beside their images: where the sensors are, and what depth counts.

Topics are ``/device_D/sensor_S/STREAM_N/...`` (librealsense, src/media/ros/ros_file_format.h). ``tf/R`` maps points
of the reference stream of group R to this stream, so that in one group T_color_depth = T_color_R T_R_depth: the way
round in which the edges of depth and colour meet (docs/formats.md).

In newer bags (2.5x) the frame of an image's header is "1", and four bytes follow the message that its definition does
not know: a little-endian float32, metres per count of depth, 0 of other images (librealsense, src/media/ros/
ros_writer.cpp, third-party/realsense-file/rosbag/msgs/sensor_msgs/Image.h).
"""

import re
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatctrl_cli.containers.raw_log import RawMessage
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform, transform_from
from splatctrl_cli.records import Float64

TRANSFORM, OPTION = "geometry_msgs/msg/Transform", "std_msgs/msg/Float32"
_STREAM = re.compile(r"/(device_\d+)/(sensor_\d+)/([A-Za-z0-9]+_\d+)/")
_EXTRINSICS = re.compile(r"(/device_\d+/sensor_\d+/[A-Za-z0-9]+_\d+)/tf/(\d+)")
_FRAME_1, _AT = b"\x01\x00\x00\x001", 12  # a header's frame behind its number and stamp: its length, then its text
_DEPTH_UNITS = re.compile(r"(/device_\d+/sensor_\d+)/option/Depth[ _]Units/value")


@dataclass(kw_only=True)
class RealSense:
    """Extrinsics by stream and group, depth units by sensor, as one pass over a bag finds them; the units that images
    say themselves, in the order of the bag.
    """

    extrinsics: dict[str, dict[str, Float64]] = field(default_factory=dict)
    depth_units: dict[str, float] = field(default_factory=dict)
    image_units: dict[str, list[float]] = field(default_factory=dict)

    def add(self, topic: str, message: Any) -> None:
        """Take a Transform or an option's value; other topics are passed over. Raises ValueError for nonsense."""
        extrinsics, units = _EXTRINSICS.fullmatch(topic), _DEPTH_UNITS.fullmatch(topic)
        if extrinsics:
            t, r = message.translation, message.rotation
            quat_xyzw = np.array([r.x, r.y, r.z, r.w], dtype=np.float64)
            position = np.array([t.x, t.y, t.z], dtype=np.float64)
            if not (np.isfinite(position).all() and 0.5 < np.linalg.norm(quat_xyzw) < 2.0):
                raise ValueError(f"{topic}: not a rigid transform")
            self.extrinsics.setdefault(extrinsics[1], {})[extrinsics[2]] = transform_from(position, quat_xyzw)
        elif units:
            self.depth_units[units[1]] = _unit(message.data, topic)

    def add_image(self, message: RawMessage) -> None:
        """Take the depth unit of an image that says one. Raises ValueError for nonsense."""
        topic = message.topic.name
        if has_unit(message) and (value := struct.unpack("<f", message.data[-4:])[0]):
            units, unit = self.image_units.setdefault(_stream(topic), []), _unit(value, topic)
            if unit not in units:
                units.append(unit)

    def T_between(self, to_topic: str, from_topic: str) -> Float64 | None:
        """T_to_from (4, 4) of the streams of two image topics; None where no group holds both."""
        to_all, from_all = (self.extrinsics.get(_stream(topic), {}) for topic in (to_topic, from_topic))
        group = next((group for group in to_all if group in from_all), None)
        return None if group is None else to_all[group] @ invert_transform(from_all[group])

    def depth_unit(self, topic: str) -> float | None:
        """Metres per count of a depth topic, None where the bag does not say. Raises InputError where it changes."""
        said = self.image_units.get(_stream(topic), [])
        if len(said) > 1:
            raise InputError(
                f"topic {topic}: the depth unit changes, from {said[0]:g} to {said[1]:g} m",
                remedy="cut the bag there, or give --depth-scale [m per count] for all of it",
            )
        return said[0] if said else self.depth_units.get(_stream(topic).rpartition("/")[0])


def has_unit(message: RawMessage) -> bool:
    """Whether four bytes with a depth unit follow a message of the SDK's images."""
    topic = message.topic
    is_image = topic.encoding == "ros1" and topic.type_name == "sensor_msgs/msg/Image"
    return is_image and message.data[_AT : _AT + len(_FRAME_1)] == _FRAME_1 and device_of(topic.name) != ""


def device_of(topic: str) -> str:
    """The device whose stream a topic of the SDK is, "" for any other topic."""
    match = _STREAM.match(topic)
    return match[1] if match else ""


def _unit(value: float, topic: str) -> float:
    """Metres per count; 0.001 was written as a float32."""
    unit = float(f"{float(value):.6g}")
    if not 0 < unit < 1:
        raise ValueError(f"{topic}: expected metres per count, got {unit}")
    return unit


def _stream(topic: str) -> str:
    match = _STREAM.match(topic)
    return match[0].rstrip("/") if match else ""

"""What bags of the RealSense SDK say beside their images: where the sensors are, and what depth counts.

Topics are ``/device_D/sensor_S/STREAM_N/...`` (librealsense, src/media/ros/ros_file_format.h). ``tf/R`` maps points
of the reference stream of group R to this stream, so that in one group T_color_depth = T_color_R T_R_depth: the way
round in which the edges of depth and colour meet (docs/formats.md).
"""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatctrl_cli.geometry import invert_transform, transform_from
from splatctrl_cli.records import Float64

TRANSFORM, OPTION = "geometry_msgs/msg/Transform", "std_msgs/msg/Float32"
_STREAM = re.compile(r"/(device_\d+)/(sensor_\d+)/([A-Za-z0-9]+_\d+)/")
_EXTRINSICS = re.compile(r"(/device_\d+/sensor_\d+/[A-Za-z0-9]+_\d+)/tf/(\d+)")
_DEPTH_UNITS = re.compile(r"(/device_\d+/sensor_\d+)/option/Depth[ _]Units/value")


@dataclass(kw_only=True)
class RealSense:
    """Extrinsics by stream and group, depth units by sensor, as one pass over a bag finds them."""

    extrinsics: dict[str, dict[str, Float64]] = field(default_factory=dict)
    depth_units: dict[str, float] = field(default_factory=dict)

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
            unit = float(f"{float(message.data):.6g}")  # 0.001 was written as a float32
            if not 0 < unit < 1:
                raise ValueError(f"{topic}: expected metres per count, got {unit}")
            self.depth_units[units[1]] = unit

    def T_between(self, to_topic: str, from_topic: str) -> Float64 | None:
        """T_to_from (4, 4) of the streams of two image topics; None where no group holds both."""
        to_all, from_all = (self.extrinsics.get(_stream(topic), {}) for topic in (to_topic, from_topic))
        group = next((group for group in to_all if group in from_all), None)
        return None if group is None else to_all[group] @ invert_transform(from_all[group])

    def depth_unit(self, topic: str) -> float | None:
        """Metres per count of a depth topic, None where the bag does not say."""
        return self.depth_units.get(_stream(topic).rpartition("/")[0])


def device_of(topic: str) -> str:
    """The device whose stream a topic of the SDK is, "" for any other topic."""
    match = _STREAM.match(topic)
    return match[1] if match else ""


def _stream(topic: str) -> str:
    match = _STREAM.match(topic)
    return match[0].rstrip("/") if match else ""

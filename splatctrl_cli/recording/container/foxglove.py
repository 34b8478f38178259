"""Foxglove's schemas, and the RealSense SDK's texts, as the ROS messages they stand for.

Foxglove's messages are JSON, ROS twins, or protobuf, read by the log's FileDescriptorSet. Fields: docs.foxglove.dev
("Schemas"). JSON times are {sec, nsec} and bytes base64; protobuf times are google.protobuf.Timestamp. The SDK's .db3
has intrinsics, extrinsics and depth units as std_msgs/String (librealsense, src/media/ros2/ros2_writer.cpp).
"""

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from google.protobuf.descriptor_database import DescriptorDatabase, DescriptorDatabaseConflictingDefinitionError
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from splatctrl_cli.errors import refuse_faults
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.recording.container.raw_log import Topic


@lru_cache(maxsize=16)
def _pool(descriptor_set: bytes) -> Any:
    files = DescriptorDatabase()  # asked by the pool, so that a file may come before those that it imports
    with refuse_faults(
        "protobuf: the schema is not usable",
        DecodeError,
        DescriptorDatabaseConflictingDefinitionError,
        error=ValueError,
    ):
        for file in FileDescriptorSet.FromString(descriptor_set).file:
            files.Add(file)
    return DescriptorPool(files)


def read_protobuf(descriptor_set: bytes, type_name: str, data: bytes) -> Any:
    """Decode a message by a FileDescriptorSet; unwritten fields have defaults.

    Raises ValueError if the set lacks `type_name`, or the message does not decode.
    """
    with (
        refuse_faults(lambda _: f"the schema does not define {type_name}", KeyError, error=ValueError),
        refuse_faults("protobuf", DecodeError, TypeError, error=ValueError),
    ):
        return GetMessageClass(_pool(descriptor_set).FindMessageTypeByName(type_name)).FromString(data)


_STANDS_FOR = {
    "CompressedImage": "sensor_msgs/msg/CompressedImage",
    "CompressedVideo": "foxglove_msgs/msg/CompressedVideo",  # ROS has none; the same fields as a CompressedImage
    "RawImage": "sensor_msgs/msg/Image",
    "CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "FrameTransform": "tf2_msgs/msg/TFMessage",
    "FrameTransforms": "tf2_msgs/msg/TFMessage",
    "JointStates": "sensor_msgs/msg/JointState",
}
_STAMPED = "builtin_interfaces/Time timestamp\nstring frame_id\n"
_SIZED = f"{_STAMPED}uint32 width\nuint32 height\n"
DEFINITIONS = {  # for bags without any; foxglove/schemas, ros_foxglove_msgs/ros2
    "foxglove_msgs/msg/CompressedImage": f"{_STAMPED}uint8[] data\nstring format\n",
    "foxglove_msgs/msg/CompressedVideo": f"{_STAMPED}uint8[] data\nstring format\n",
    "foxglove_msgs/msg/RawImage": f"{_SIZED}string encoding\nuint32 step\nuint8[] data\n",
    "foxglove_msgs/msg/CameraCalibration": (
        f"{_SIZED}string distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
    ),
    "foxglove_msgs/msg/FrameTransform": (
        "builtin_interfaces/Time timestamp\nstring parent_frame_id\nstring child_frame_id\n"
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "foxglove_msgs/msg/FrameTransforms": "foxglove_msgs/FrameTransform[] transforms\n",
}
TEXT = "std_msgs/msg/String"
_SENSOR = r"/device_\d+/sensor_\d+"
_TEXTS = {  # by the topic, what a text of the SDK stands for; metadata say the depth unit of one image
    rf"{_SENSOR}/\w+_\d+/camera_info": "sensor_msgs/msg/CameraInfo",
    rf"{_SENSOR}/\w+_\d+/tf/ref_\d+": "geometry_msgs/msg/Transform",
    rf"{_SENSOR}/(option/Depth_Units/value|\w+_\d+/image/metadata)": "std_msgs/msg/Float32",
}


def find_ros_type(schema: str) -> str:
    """The ROS type of a Foxglove schema, "" for others."""
    match = re.match(r"foxglove(?:\.|_msgs/(?:msg/)?)(.*)", schema, re.DOTALL)
    return _STANDS_FOR.get(match[1], "") if match else ""


def add_ros_type(topic: Topic) -> Topic:
    """The topic with the ROS type that its foxglove_msgs or SDK texts stand for."""
    texts = _TEXTS if topic.type_name == TEXT else {}
    schema = next((kind for pattern, kind in texts.items() if re.fullmatch(pattern, topic.name)), "")
    ros_type = schema or find_ros_type(topic.type_name)
    return replace(topic, type_name=ros_type, schema=topic.type_name) if ros_type else topic


def read_foxglove(schema: str, encoding: str, definition: str, data: bytes) -> Any:
    """Decode `data` to a ROS message.

    definition: protobuf's FileDescriptorSet, one byte per character. Raises ValueError, KeyError, TypeError or
    AttributeError if `data` does not decode.
    """
    return as_ros(
        schema,
        _object(json.loads(data))
        if encoding == "json"
        else read_protobuf(definition.encode("latin-1"), schema, data),
    )


def as_ros(schema: str, message: Any) -> Any:
    return _READERS[schema.replace("/", ".").rpartition(".")[2]](message)


def _object(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{key: _object(item) for key, item in value.items()})
    return [_object(item) for item in value] if isinstance(value, list) else value


def _header(message: Any, frame_id: str | None = None) -> Any:
    frame_id = str(getattr(message, "frame_id", "")) if frame_id is None else frame_id
    time = getattr(message, "timestamp", None)
    seconds = _either(time, "sec", "seconds")
    nanoseconds = _either(time, "nsec", "nanos", "nanosec")
    return SimpleNamespace(stamp=SimpleNamespace(sec=int(seconds), nanosec=int(nanoseconds)), frame_id=frame_id)


def _either(message: Any, *names: str) -> Any:
    """The first present field; 0 if none (JSON omits zeros)."""
    return next((getattr(message, name) for name in names if hasattr(message, name)), 0)


def _data(message: Any) -> Any:
    value = message.data
    return np.frombuffer(base64.b64decode(value, validate=True) if isinstance(value, str) else value, dtype=np.uint8)


def _calibration(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message),
        width=int(message.width),
        height=int(message.height),
        distortion_model=str(_either(message, "distortion_model") or ""),
        d=_numbers(_either(message, "D", "d"), 0),
        k=_numbers(_either(message, "K", "k"), 9),
        r=_numbers(_either(message, "R", "r"), 9),
        p=_numbers(_either(message, "P", "p"), 12),
    )


def _numbers(values: Any, count: int) -> Any:
    array = np.asarray([] if isinstance(values, int) else values, dtype=np.float64)
    return array if array.size else np.zeros(count)


def _transform(message: Any) -> Any:
    t, r = message.translation, message.rotation
    return SimpleNamespace(
        header=_header(message, str(message.parent_frame_id)),
        child_frame_id=str(message.child_frame_id),
        transform=SimpleNamespace(
            translation=SimpleNamespace(**{key: float(_either(t, key)) for key in "xyz"}),
            rotation=SimpleNamespace(**{key: float(_either(r, key)) for key in "xyzw"}),
        ),
    )


def _sdk_text(message: Any) -> Any:
    entries = dict(part.split("=", 1) for part in message.data.split(";") if "=" in part)
    fields = ("fx", "fy", "ppx", "ppy", "coeffs", "rotation", "translation")
    values = {key: np.array(entries[key].split(","), np.float64) for key in fields if key in entries}
    if "fx" in entries:
        fx, fy, cx, cy = (float(values[key][0]) for key in ("fx", "fy", "ppx", "ppy"))
        size = SimpleNamespace(width=float(entries["width"]), height=float(entries["height"]))
        lens = {"distortion_model": entries["model"], "K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "D": values["coeffs"]}
        return _calibration(SimpleNamespace(**vars(size), **lens))
    if "rotation" in entries:
        x, y, z, w = quat_from_rotation(values["rotation"].reshape(3, 3).T)  # written by columns
        t = dict(zip("xyz", values["translation"], strict=True))
        return SimpleNamespace(translation=SimpleNamespace(**t), rotation=SimpleNamespace(x=x, y=y, z=z, w=w))
    return SimpleNamespace(data=float(entries.get("Depth Units", 0) if entries else message.data))


_READERS: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(
        ("CompressedImage", "CompressedVideo"),
        lambda message: SimpleNamespace(header=_header(message), format=message.format, data=_data(message)),
    ),
    "RawImage": lambda message: SimpleNamespace(
        header=_header(message),
        width=int(message.width),
        height=int(message.height),
        encoding=str(message.encoding),
        step=int(message.step),
        is_bigendian=0,
        data=_data(message),
    ),
    "CameraCalibration": _calibration,
    "FrameTransform": lambda message: SimpleNamespace(transforms=[_transform(message)]),
    "JointStates": lambda message: SimpleNamespace(  # without velocities: an unset one looks like zero
        header=_header(message),
        name=[str(joint.name) for joint in message.joints],
        position=np.array([float(_either(joint, "position")) for joint in message.joints]),
        velocity=np.zeros(0),
    ),
    "String": _sdk_text,
    "FrameTransforms": lambda message: SimpleNamespace(transforms=[_transform(item) for item in message.transforms]),
}

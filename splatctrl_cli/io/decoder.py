"""Messages of the standard types from their bytes, by the definitions the log itself carries."""

import struct
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from splatctrl_cli.io.raw_log import RawMessage, Topic

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_UNDECODABLE = (SerdeError, TypesysError, struct.error, ValueError, IndexError, KeyError, AssertionError, TypeError)


class UndecodableMessageError(ValueError):
    """A message whose bytes do not fit its type."""


def is_ros(topic: Topic) -> bool:
    """Whether the topic's messages are in a ROS encoding."""
    return topic.encoding in {"cdr", "ros1"}


class MessageDecoder:
    """Decodes messages, one type store per definition met, so that one odd definition spoils no other topic."""

    def __init__(self) -> None:
        self._stores: dict[Topic, Any] = {}

    def decode(self, message: RawMessage) -> Any:
        """The message as an object with its fields. Raises UndecodableMessageError."""
        topic = message.topic
        try:
            if topic not in self._stores:
                self._stores[topic] = _type_store(topic)
            store = self._stores[topic]
            if topic.encoding == "ros1":
                return store.deserialize_ros1(message.data, topic.type_name)
            return store.deserialize_cdr(message.data, topic.type_name)
        except _UNDECODABLE as error:
            raise UndecodableMessageError(
                f"{topic.name}: a {topic.type_name} that does not decode: {error}"
            ) from None


def header_stamp_ns(message: RawMessage) -> int:
    """Stamp of a message that begins with a std_msgs/Header, without decoding the rest.

    The stamp follows four bytes (CDR's encapsulation, or ROS 1's `seq`) as two 32-bit words. Raises
    UndecodableMessageError for a message too short.
    """
    is_little = message.topic.encoding == "ros1" or message.data[1:2] in {b"\x01", b"\x03", b"\x07", b"\x09"}
    try:
        seconds, nanoseconds = struct.unpack_from("<iI" if is_little else ">iI", message.data, 4)
    except struct.error:
        raise UndecodableMessageError(f"{message.topic.name}: a message of {len(message.data)} bytes") from None
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def stamp_ns(header: Any) -> int:
    """Stamp of a decoded std_msgs/Header."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _type_store(topic: Topic) -> Any:
    if not topic.definition:
        return get_typestore(Stores.ROS1_NOETIC if topic.encoding == "ros1" else Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.EMPTY)
    if topic.definition_format == "idl":
        separator = "=" * 80 + "\n"
        parts = [part for part in topic.definition.split(separator) if part.strip()]
        for part in parts:
            body = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
            store.register(get_types_from_idl(body))
    else:
        store.register(get_types_from_msg(topic.definition, topic.type_name))
    return store

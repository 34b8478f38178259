"""Logs written message by message: the one way in which tests make an MCAP and the bags of both ROS."""

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.containers.log_formats import open_raw_log
from splatctrl_cli.containers.raw_log import Damage, RawMessage, Topic

STORE = get_typestore(Stores.ROS2_HUMBLE)
SCHEMAS = {"cdr": "ros2msg", "ros1": "ros1msg", "protobuf": "protobuf", "json": "jsonschema"}  # by encoding


@lru_cache
def _definition(store: Any, kind: str, version: int) -> str:
    return str(store.generate_msgdef(kind, ros_version=version)[0])


def encoded(log_ns: int, topic: str, content: Any, store: Any = STORE, *, ros: int = 2) -> RawMessage:
    """A message of ROS 1 or 2 as a log has it."""
    kind = content.__msgtype__
    encoding, write = ("cdr", store.serialize_cdr) if ros == 2 else ("ros1", store.serialize_ros1)
    channel = Topic(name=topic, type_name=kind, encoding=encoding, definition=_definition(store, kind, ros))
    return RawMessage(topic=channel, log_time_ns=log_ns, data=bytes(write(content, kind)))


def write_raw(path: Path, messages: Iterable[RawMessage], **options: Any) -> Path:
    """An MCAP of the messages, in their order; options are the writer's."""
    schemas: dict[tuple[str, str], int] = {}
    channels: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = McapWriter(stream, **{"compression": CompressionType.ZSTD, **options})
        writer.start(profile="ros2", library="tests")
        for message in messages:
            topic, time = message.topic, message.log_time_ns
            if topic.name not in channels:
                name = topic.schema or topic.type_name
                name = name.replace("/msg/", "/") if topic.encoding == "ros1" else name
                key = name, topic.definition
                if key not in schemas:
                    definition = topic.definition.encode("latin-1" if topic.encoding == "protobuf" else "utf-8")
                    schemas[key] = writer.register_schema(name, SCHEMAS.get(topic.encoding, ""), definition)
                channels[topic.name] = writer.register_channel(topic.name, topic.encoding, schemas[key])
            writer.add_message(channels[topic.name], time, message.data, time)
        writer.finish()
    return path


def write_bag(
    path: Path, messages: Iterable[RawMessage], store: Any = STORE, plugin: StoragePlugin | None = None
) -> Path:
    """A bag of the messages by rosbags: of ROS 2 in a folder, kept by `plugin`, or without one a file of ROS 1."""
    with Bag1Writer(path) if plugin is None else Bag2Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for message in messages:
            name, kind = message.topic.name, message.topic.type_name
            if name not in connections:
                connections[name] = writer.add_connection(name, kind, typestore=store)
            writer.write(connections[name], message.log_time_ns, message.data)
    return path


def messages_of(log: Path) -> Iterator[RawMessage]:
    """All messages of a log that is whole."""
    damage = Damage()
    yield from open_raw_log(log).messages(damage)
    assert not damage.count


def rewritten(log: Path, path: Path, change: Callable[[RawMessage], RawMessage]) -> Path:
    """The log with every message changed."""
    return write_raw(path, map(change, messages_of(log)))

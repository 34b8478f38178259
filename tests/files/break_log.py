"""A good log, changed message by message into one that is broken in exactly one way."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tests.logs.make_log import STORE, LogRecipe, make_log

Message = tuple[int, str, str, Any]  # log time [ns], topic, type, message
Change = Callable[[int, str, str, Any], Iterable[Message]]


def broken_log(path: Path, change: Change, recipe: LogRecipe | None = None) -> Path:
    """The log of `recipe` with every message replaced by what `change` makes of it."""
    good = make_log(path.with_suffix(".good.mcap"), recipe or LogRecipe(num_frames=30))
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    with good.open("rb") as stream, path.open("wb") as out:
        writer = McapWriter(out, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="tests")
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            assert schema is not None
            decoded = STORE.deserialize_cdr(bytearray(message.data), schema.name)  # whose arrays can be written
            for log_time, topic, kind, changed in change(message.log_time, channel.topic, schema.name, decoded):
                if kind not in schemas:
                    text, _ = STORE.generate_msgdef(kind, ros_version=2)
                    schemas[kind] = writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
                data = bytes(STORE.serialize_cdr(changed, kind))
                writer.add_message(channels[topic], log_time=log_time, publish_time=log_time, data=data)
        writer.finish()
    return path


def stamp_of(message: Any) -> int:
    """Header stamp [ns]."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def set_stamp(message: Any, stamp_ns: int) -> None:
    """Give a message another header stamp."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)

"""A good log, changed message by message into one that is broken in exactly one way."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from splatctrl_cli.containers.raw_log import RawMessage
from tests.logs.make_log import LogRecipe, make_log
from tests.logs.write_log import STORE, encoded, messages_of, write_raw

Message = tuple[int, str, str, Any]  # log time [ns], topic, type, message
Change = Callable[[int, str, str, Any], Iterable[Message]]


def broken_log(path: Path, change: Change, recipe: LogRecipe | None = None) -> Path:
    """The log of `recipe` with every message replaced by what `change` makes of it."""
    good = make_log(path.with_suffix(".good.mcap"), recipe or LogRecipe(num_frames=30))
    changed = (
        encoded(time, topic, content)
        for message in messages_of(good)
        for time, topic, _, content in change(message.log_time_ns, message.topic.name, *_decoded(message))
    )
    return write_raw(path, changed)


def _decoded(message: RawMessage) -> tuple[str, Any]:
    """Type and content, whose arrays can be written."""
    kind = message.topic.type_name
    return kind, STORE.deserialize_cdr(bytearray(message.data), kind)


def stamp_of(message: Any) -> int:
    """Header stamp [ns]."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def set_stamp(message: Any, stamp_ns: int) -> None:
    """Give a message another header stamp."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)

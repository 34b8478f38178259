"""MCAP read from front to back, with its checksums.

The `mcap` package's indexed reader needs an intact summary: it raises on valid files without one and yields nothing
from a truncated file. The stream reader needs none, so what precedes a cut is read.
"""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.raw_log import Damage, RawMessage, Topic

_UNREADABLE = (
    McapError,
    ValueError,
    RuntimeError,
    KeyError,
    EOFError,
    MemoryError,
    struct.error,
    zstandard.ZstdError,
)
_COMPRESSIONS = ("", "none", "zstd", "lz4")


class McapLog:
    """One MCAP file."""

    container = "MCAP"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = (path,)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Topic] = {}
        self._read_summary()

    def topics(self) -> tuple[Topic, ...]:
        """The channels of the summary section, and those met while reading."""
        return tuple(self._channels.values())

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages in file order; a chunk whose checksum differs is left out, a cut ends the file."""
        for record in self._records(damage):
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._add_channel(record)
            elif isinstance(record, Message):
                topic = self._channels.get(record.channel_id)
                if topic is None:
                    damage.add(f"{self.path.name}: a message of undeclared channel {record.channel_id}")
                elif names is None or topic.name in names:
                    yield RawMessage(topic=topic, log_time_ns=record.log_time, data=record.data)

    def _records(self, damage: Damage) -> Iterator[McapRecord]:
        with self.path.open("rb") as stream:
            reader = StreamReader(
                stream, emit_chunks=True, validate_crcs=True, record_size_limit=self.path.stat().st_size
            )
            records = iter(reader.records)
            has_footer = False
            while True:
                offset = stream.tell()
                try:
                    record = next(records)
                except StopIteration:
                    return
                except CRCValidationError:
                    damage.add(f"{self.path.name}: checksum of the data section differs")
                    return
                except _UNREADABLE:
                    where = "its closing mark is missing" if has_footer else f"cut or damaged after byte {offset}"
                    damage.add(f"{self.path.name}: {where}")
                    return
                has_footer = has_footer or isinstance(record, Footer)
                if isinstance(record, Chunk):
                    yield from self._chunk_records(record, offset, damage)
                else:
                    yield record

    def _chunk_records(self, chunk: Chunk, offset: int, damage: Damage) -> list[McapRecord]:
        if chunk.compression not in _COMPRESSIONS:
            raise InputError(
                f"{self.path}: chunk compression {chunk.compression!r} is unknown",
                remedy="rewrite the file with zstd, lz4 or no compression",
            )
        try:
            records: list[McapRecord] = breakup_chunk(chunk, validate_crc=True)
        except _UNREADABLE as error:
            reason = "checksum differs" if isinstance(error, CRCValidationError) else "cannot be decompressed"
            damage.add(f"{self.path.name}: the chunk at byte {offset} was left out: {reason}")
            return []
        return records

    def _read_summary(self) -> None:
        """Take schemas and channels from the summary, so that a damaged chunk hides no channel of others."""
        try:
            with self.path.open("rb") as stream:
                summary = SeekingReader(stream).get_summary()
        except _UNREADABLE:
            return
        if summary is not None:
            self._schemas.update(summary.schemas)
            for channel in summary.channels.values():
                self._add_channel(channel)

    def _add_channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        is_ros = schema is not None and schema.encoding in {"ros2msg", "ros2idl", "ros1msg"}
        self._channels[channel.id] = Topic(
            name=channel.topic,
            type_name="" if schema is None else ros_type_name(schema.name) if is_ros else schema.name,
            encoding=channel.message_encoding,
            definition=schema.data.decode("utf-8", "replace") if schema is not None and is_ros else "",
            definition_format="idl" if schema is not None and schema.encoding == "ros2idl" else "msg",
        )


def ros_type_name(name: str) -> str:
    """``package/msg/Type`` of ROS 1's ``package/Type``; other names as they are."""
    package, slash, kind = name.partition("/")
    return f"{package}/msg/{kind}" if slash and "/" not in kind else name

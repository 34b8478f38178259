"""An MCAP file's messages, and its index without a full read.

Damage is skipped and counted. The `mcap` package allocates the sizes that records announce, and needs a summary.
"""

import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.errors import refuse_if
from splatctrl_cli.formats.unpacking import BadBlockError, Budget, unpacked_start
from splatctrl_cli.recording.container.foxglove import add_ros_type, find_ros_type
from splatctrl_cli.recording.container.mcap_file import (
    CHANNEL,
    CHUNK,
    FIRST_OPCODE,
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    SCHEMA,
    STATISTICS,
    Channel,
    Chunk,
    ChunkIndex,
    McapFile,
    Schema,
    Statistics,
    parse_record,
)
from splatctrl_cli.recording.container.raw_log import Damage, RawLog, RawMessage, Topic

MOST_HEADS = 100_000  # records that are visited: a second or so


LogIndex = tuple[dict[int, int], tuple[int, int], tuple[ChunkIndex, ...], tuple[str, ...]]
"""Number of messages by channel, first and last log time [ns], chunks in file order, notes on missing parts."""


def index_by_heads(file: McapFile) -> LogIndex:
    """Index a file without a summary, up to damage or MOST_HEADS records."""
    counts: dict[int, int] = {}
    chunks: list[ChunkIndex] = []
    stamps: list[int] = []
    offset, num_heads = len(MAGIC), 0
    with file.path.open("rb") as stream:
        while offset + HEAD.size <= file.size and num_heads < MOST_HEADS:
            stream.seek(offset)
            head = stream.read(HEAD.size + 64)  # bytes that hold the fields of a chunk before its records
            opcode, length = HEAD.unpack_from(head)
            if opcode < FIRST_OPCODE or opcode == FOOTER or offset + HEAD.size + length > file.size:
                break
            content = head[HEAD.size :]
            if opcode == CHUNK:
                with suppress(BadBlockError):
                    chunk: Chunk = parse_record(CHUNK, content)
                    chunks.append(
                        ChunkIndex(
                            message_start_time=chunk.message_start_time,
                            message_end_time=chunk.message_end_time,
                            chunk_start_offset=offset,
                            chunk_length=length + HEAD.size,
                            message_index_offsets={},
                            message_index_length=0,
                            compression=chunk.compression,
                            compressed_size=chunk.compressed_size,
                            uncompressed_size=chunk.uncompressed_size,
                        )
                    )
            elif opcode == MESSAGE_INDEX and chunks:
                channel, size = struct.unpack_from("<HI", content)
                counts[channel] = counts.get(channel, 0) + size // 16
                chunks[-1] = replace(
                    chunks[-1], message_index_offsets={**chunks[-1].message_index_offsets, channel: offset}
                )
            elif opcode == MESSAGE:
                channel, _, stamp, _ = struct.unpack_from("<HIQQ", content)
                counts[channel] = counts.get(channel, 0) + 1
                stamps.append(stamp)
            offset += HEAD.size + length
            num_heads += 1
    stamps += [stamp for c in chunks for stamp in (c.message_start_time, c.message_end_time)]
    notes = [] if offset + HEAD.size >= file.size else [f"counted up to byte {offset} of {file.size}"]
    span_ns = min(stamps, default=0), max(stamps, default=0)
    return counts, span_ns, tuple(chunks), ("has no summary: counted by the heads of its records", *notes)


_MESSAGE = struct.Struct("<HIQQ")


class McapLog(RawLog):
    container = "MCAP"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = (path,)
        self._file = McapFile(path)
        self._schemas: dict[int, Schema] = {}
        self.channels: dict[int, Topic] = {}
        self._statistics: Statistics | None = None
        self._budget = Budget(self._file.size)
        self._whole: tuple[int, int] | None = None  # the file's state when a pass found all its checksums right
        for part in self._file.summary():  # so that a damaged chunk hides no other chunk's channels
            if part.opcode in {SCHEMA, CHANNEL, STATISTICS}:
                self._declare(part.opcode, part.content, Damage())

    def index(self) -> LogIndex:
        statistics, chunks = self._statistics, tuple(self._file.chunk_indexes())
        if statistics is None or len(chunks) != statistics.chunk_count:
            return index_by_heads(self._file)
        return (
            dict(statistics.channel_message_counts),
            (statistics.message_start_time, statistics.message_end_time),
            chunks,
            (),
        )

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield in file order; skip damage, read a cut chunk up to its cut.

        Checksums are compared until one full pass finds no damage.
        """
        self._budget = Budget(self._file.size)
        state, count = self._forget_changed(), damage.count
        for part in self._file.parts(damage, is_known=self._whole is not None):
            if part.opcode == CHUNK and part.content:
                yield from self._chunk_messages(part.content, part.offset, damage, names, is_cut=part.is_cut)
            elif part.opcode == MESSAGE and part.content:
                yield from self._message(part.content, 0, len(part.content), part.offset, damage, names)
            elif part.opcode in {SCHEMA, CHANNEL}:
                self._declare(part.opcode, part.content, damage)
        self._whole = state if damage.count == count else None

    def messages_of(self, chunks: Collection[ChunkIndex], damage: Damage) -> Iterator[RawMessage]:
        """Yield these chunks' messages."""
        self._forget_changed()
        for index in chunks:
            content = self._file.chunk_at(index)
            yield from self._chunk_messages(content, index.chunk_start_offset, damage, None, is_cut=False)

    def _forget_changed(self) -> tuple[int, int]:
        stat = self.path.stat()
        state = stat.st_size, stat.st_mtime_ns
        self._whole = self._whole if state == self._whole else None
        return state

    def _chunk_messages(
        self, content: bytes, offset: int, damage: Damage, names: Collection[str] | None, *, is_cut: bool
    ) -> Iterator[RawMessage]:
        records = self._records_in(content, offset, damage, is_cut=is_cut)
        at, end = 0, len(records)
        while at + HEAD.size <= end:
            opcode, length = HEAD.unpack_from(records, at)
            start, at = at + HEAD.size, at + HEAD.size + length
            if at > end or opcode < FIRST_OPCODE:
                if not is_cut:
                    damage.add(f"{self.path.name}: the chunk at byte {offset} holds bytes that are not a record")
                return
            if opcode == MESSAGE:
                yield from self._message(records, start, at, offset, damage, names)
            elif opcode in {SCHEMA, CHANNEL}:
                self._declare(opcode, records[start:at], damage)

    def _records_in(self, content: bytes, offset: int, damage: Damage, *, is_cut: bool) -> bytes:
        try:
            chunk: Chunk = parse_record(CHUNK, content)
            if is_cut or len(chunk.records) < chunk.compressed_size:
                return unpacked_start(chunk.records, chunk.compression, chunk.uncompressed_size)
            records = self._budget.unpacked(chunk.records, chunk.compression, chunk.uncompressed_size)
            refuse_if(
                chunk.uncompressed_crc and self._whole is None and zlib.crc32(records) != chunk.uncompressed_crc,
                "checksum differs",
                error=BadBlockError,
            )
        except BadBlockError as error:
            if not is_cut:  # the cut has been counted
                damage.add(f"{self.path.name}: the chunk at byte {offset} was left out: {error}")
            return b""
        return records

    def _message(
        self, records: bytes, start: int, end: int, offset: int, damage: Damage, names: Collection[str] | None
    ) -> Iterator[RawMessage]:
        if end - start < _MESSAGE.size:
            damage.add(f"{self.path.name}: a message record of {end - start} bytes")
            return
        channel, _, log_time_ns, _ = _MESSAGE.unpack_from(records, start)
        topic = self.channels.get(channel)
        if topic is None:
            damage.add(f"{self.path.name}: a message of undeclared channel {channel}")
        elif names is None or topic.name in names:
            yield RawMessage(
                topic=topic,
                log_time_ns=log_time_ns,
                data=records[start + _MESSAGE.size : end],
                file=self.path.name,
                offset=offset,
            )

    def _declare(self, opcode: int, content: bytes, damage: Damage) -> None:
        try:
            record = parse_record(opcode, content)
        except BadBlockError as error:
            damage.add(f"{self.path.name}: a schema or channel was left out: {error}")
            return
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = _topic(record, self._schemas.get(record.schema_id))
        elif isinstance(record, Statistics):
            self._statistics = record


def _topic(channel: Channel, schema: Schema | None) -> Topic:
    if schema is None:
        return Topic(name=channel.topic, type_name="", encoding=channel.message_encoding)
    is_ros, is_protobuf = schema.encoding in {"ros2msg", "ros2idl", "ros1msg"}, schema.encoding == "protobuf"
    type_name, ros_type = ros_type_name(schema.name) if is_ros else schema.name, find_ros_type(schema.name)
    topic = Topic(
        name=channel.topic,
        type_name=ros_type or type_name,
        encoding=channel.message_encoding,
        definition=schema.data.decode("utf-8" if is_ros else "latin-1", "replace") if is_ros or is_protobuf else "",
        definition_format={"ros2idl": "idl", "protobuf": "protobuf"}.get(schema.encoding, "msg"),
        schema=type_name if ros_type else "",
    )
    return add_ros_type(topic) if is_ros else topic


def ros_type_name(name: str) -> str:
    """``package/msg/Type`` for ROS 1's ``package/Type``; other names unchanged."""
    package, slash, kind = name.partition("/")
    return f"{package}/msg/{kind}" if slash and "/" not in kind else name

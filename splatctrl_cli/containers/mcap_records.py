"""The records of an MCAP file, each parsed from its bytes and from no more than them.

Names and order are those of the format's specification (mcap.dev/spec). Bytes after the last field are allowed, as
it demands of a reader.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, ATTACHMENT, SCHEMA, CHANNEL = 0x05, 0x06, 0x09, 0x03, 0x04
DATA_END, FOOTER, CHUNK_INDEX, STATISTICS, MESSAGE_INDEX = 0x0F, 0x02, 0x08, 0x0B, 0x07
FIRST_OPCODE = 0x01

_MESSAGE = struct.Struct("<HIQQ")
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class BadRecordError(ValueError):
    """A record whose bytes do not hold its fields."""


class Message(NamedTuple):
    """One message; times [ns]. (A tuple: there are millions of them.)"""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass(frozen=True, kw_only=True)
class Header:
    """First record of a file."""

    profile: str
    library: str


@dataclass(frozen=True, kw_only=True)
class Footer:
    """Last record: where the summary begins (0 = none) and its checksum, of which 0 means not computed."""

    summary_start: int
    summary_offset_start: int
    summary_crc: int


@dataclass(frozen=True, kw_only=True)
class Schema:
    """Definition of a message type."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A stream of messages of one schema (0 = none)."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """A batch of records; `records` as stored, perhaps fewer bytes than `compressed_size` where the file is cut."""

    message_start_time: int
    message_end_time: int
    uncompressed_size: int
    uncompressed_crc: int
    compression: str
    compressed_size: int
    records: bytes


@dataclass(frozen=True, kw_only=True)
class MessageIndex:
    """(log time, offset in the chunk) of each message of a channel."""

    channel_id: int
    records: tuple[tuple[int, int], ...]


@dataclass(frozen=True, kw_only=True)
class ChunkIndex:
    """Where a chunk lies and what it holds."""

    message_start_time: int
    message_end_time: int
    chunk_start_offset: int
    chunk_length: int
    message_index_offsets: dict[int, int]
    message_index_length: int
    compression: str
    compressed_size: int
    uncompressed_size: int


@dataclass(frozen=True, kw_only=True)
class Attachment:
    """A file within the file."""

    log_time: int
    create_time: int
    name: str
    media_type: str
    data: bytes
    crc: int


@dataclass(frozen=True, kw_only=True)
class AttachmentIndex:
    """Where an attachment lies."""

    offset: int
    length: int
    log_time: int
    create_time: int
    data_size: int
    name: str
    media_type: str


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """What the file holds, as its writer counted."""

    message_count: int
    schema_count: int
    channel_count: int
    attachment_count: int
    metadata_count: int
    chunk_count: int
    message_start_time: int
    message_end_time: int
    channel_message_counts: dict[int, int]


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """Named texts."""

    name: str
    metadata: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class MetadataIndex:
    """Where a metadata record lies."""

    offset: int
    length: int
    name: str


@dataclass(frozen=True, kw_only=True)
class SummaryOffset:
    """Where the summary's records of one opcode lie."""

    group_opcode: int
    group_start: int
    group_length: int


@dataclass(frozen=True, kw_only=True)
class DataEnd:
    """End of the data section; its checksum, of which 0 means not computed."""

    data_section_crc: int


Record = (
    Header
    | Footer
    | Schema
    | Channel
    | Message
    | Chunk
    | MessageIndex
    | ChunkIndex
    | Attachment
    | AttachmentIndex
    | Statistics
    | Metadata
    | MetadataIndex
    | SummaryOffset
    | DataEnd
)


def parse_record(opcode: int, content: bytes) -> Record | None:
    """The record of these bytes, None for an opcode that the format leaves open. Raises BadRecordError."""
    read = _PARSERS.get(opcode)
    return None if read is None else read(_Fields(content))


def parse_message(content: bytes) -> Message:
    """The message of a record's content. Raises BadRecordError."""
    if len(content) < _MESSAGE.size:
        raise BadRecordError(f"a message record of {len(content)} bytes")
    channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
    return Message(channel_id, sequence, log_time, publish_time, content[_MESSAGE.size :])


class _Fields:
    """Reads the fields of a record one after the other, within its bytes."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def _number(self, form: struct.Struct) -> int:
        if self._at + form.size > len(self._content):
            raise BadRecordError(f"a record of {len(self._content)} bytes ends within a field")
        self._at += form.size
        return int(form.unpack_from(self._content, self._at - form.size)[0])

    def u8(self) -> int:
        return self.take(1)[0]

    def u16(self) -> int:
        return self._number(_U16)

    def u32(self) -> int:
        return self._number(_U32)

    def u64(self) -> int:
        return self._number(_U64)

    def take(self, count: int) -> bytes:
        if self._at + count > len(self._content):
            raise BadRecordError(f"a field of {count} bytes in a record of {len(self._content)}")
        self._at += count
        return self._content[self._at - count : self._at]

    def rest(self) -> bytes:
        return self.take(len(self._content) - self._at)

    def text(self) -> str:
        return self.take(self.u32()).decode("utf-8", "replace")

    def texts(self) -> dict[str, str]:
        inner = _Fields(self.take(self.u32()))
        found = {}
        while not inner.is_done:
            key = inner.text()
            found[key] = inner.text()
        return found

    def counts(self) -> dict[int, int]:
        inner = _Fields(self.take(self.u32()))
        found = {}
        while not inner.is_done:
            key = inner.u16()
            found[key] = inner.u64()
        return found

    def pairs(self) -> tuple[tuple[int, int], ...]:
        inner = _Fields(self.take(self.u32()))
        found = []
        while not inner.is_done:
            stamp = inner.u64()
            found.append((stamp, inner.u64()))
        return tuple(found)

    @property
    def is_done(self) -> bool:
        return self._at >= len(self._content)


def _chunk(f: _Fields) -> Chunk:
    """A chunk; of one that the file's end cuts, the bytes that are there."""
    start, end, size, crc = f.u64(), f.u64(), f.u64(), f.u32()
    compression, compressed_size = f.text(), f.u64()
    rest = f.rest()
    return Chunk(
        message_start_time=start,
        message_end_time=end,
        uncompressed_size=size,
        uncompressed_crc=crc,
        compression=compression,
        compressed_size=compressed_size,
        records=rest if len(rest) <= compressed_size else rest[:compressed_size],
    )


def _chunk_index(f: _Fields) -> ChunkIndex:
    return ChunkIndex(
        message_start_time=f.u64(),
        message_end_time=f.u64(),
        chunk_start_offset=f.u64(),
        chunk_length=f.u64(),
        message_index_offsets=f.counts(),
        message_index_length=f.u64(),
        compression=f.text(),
        compressed_size=f.u64(),
        uncompressed_size=f.u64(),
    )


def _statistics(f: _Fields) -> Statistics:
    return Statistics(
        message_count=f.u64(),
        schema_count=f.u16(),
        channel_count=f.u32(),
        attachment_count=f.u32(),
        metadata_count=f.u32(),
        chunk_count=f.u32(),
        message_start_time=f.u64(),
        message_end_time=f.u64(),
        channel_message_counts=f.counts(),
    )


def _attachment_index(f: _Fields) -> AttachmentIndex:
    return AttachmentIndex(
        offset=f.u64(),
        length=f.u64(),
        log_time=f.u64(),
        create_time=f.u64(),
        data_size=f.u64(),
        name=f.text(),
        media_type=f.text(),
    )


_PARSERS: dict[int, Callable[[_Fields], Record]] = {
    0x01: lambda f: Header(profile=f.text(), library=f.text()),
    FOOTER: lambda f: Footer(summary_start=f.u64(), summary_offset_start=f.u64(), summary_crc=f.u32()),
    SCHEMA: lambda f: Schema(id=f.u16(), name=f.text(), encoding=f.text(), data=f.take(f.u32())),
    CHANNEL: lambda f: Channel(
        id=f.u16(), schema_id=f.u16(), topic=f.text(), message_encoding=f.text(), metadata=f.texts()
    ),
    MESSAGE: lambda f: parse_message(f.rest()),
    CHUNK: _chunk,
    MESSAGE_INDEX: lambda f: MessageIndex(channel_id=f.u16(), records=f.pairs()),
    CHUNK_INDEX: _chunk_index,
    ATTACHMENT: lambda f: Attachment(
        log_time=f.u64(), create_time=f.u64(), name=f.text(), media_type=f.text(), data=f.take(f.u64()), crc=f.u32()
    ),
    0x0A: _attachment_index,
    STATISTICS: _statistics,
    0x0C: lambda f: Metadata(name=f.text(), metadata=f.texts()),
    0x0D: lambda f: MetadataIndex(offset=f.u64(), length=f.u64(), name=f.text()),
    0x0E: lambda f: SummaryOffset(group_opcode=f.u8(), group_start=f.u64(), group_length=f.u64()),
    DATA_END: lambda f: DataEnd(data_section_crc=f.u32()),
}

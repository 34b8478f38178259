"""The records of an MCAP file whose fields are read, each parsed from its bytes and from no more than them.

Names and order are those of the format's specification (mcap.dev/spec). Bytes after the last field are allowed, as
it demands of a reader.
"""

import struct
from collections.abc import Callable, Iterator
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, ATTACHMENT, SCHEMA, CHANNEL = 0x05, 0x06, 0x09, 0x03, 0x04
DATA_END, FOOTER, CHUNK_INDEX, STATISTICS, MESSAGE_INDEX = 0x0F, 0x02, 0x08, 0x0B, 0x07
FIRST_OPCODE = 0x01
HEAD = struct.Struct("<BQ")  # opcode and length of what follows

_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class BadRecordError(ValueError):
    """A record whose bytes do not hold its fields."""


K = TypeVar("K")
V = TypeVar("V")


class _Fields:
    """Reads the fields of a record one after the other, within its bytes."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def _number(self, form: struct.Struct) -> int:
        if self._at + form.size > len(self._content):
            raise BadRecordError(f"a record of {len(self._content)} bytes ends within a field")
        self._at += form.size
        return int(form.unpack_from(self._content, self._at - form.size)[0])

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

    def short_bytes(self) -> bytes:
        return self.take(self.u32())

    def text(self) -> str:
        return self.short_bytes().decode("utf-8", "replace")

    def texts(self) -> dict[str, str]:
        return dict(self._entries(_Fields.text, _Fields.text))

    def counts(self) -> dict[int, int]:
        return dict(self._entries(_Fields.u16, _Fields.u64))

    def _entries(self, key: "Callable[[_Fields], K]", value: "Callable[[_Fields], V]") -> Iterator[tuple[K, V]]:
        """The entries of a map or a list of pairs, read within the bytes that it announces."""
        inner = _Fields(self.short_bytes())
        while inner._at < len(inner._content):
            yield key(inner), value(inner)


U16 = Annotated[int, _Fields.u16]
U32 = Annotated[int, _Fields.u32]
U64 = Annotated[int, _Fields.u64]
Text = Annotated[str, _Fields.text]
Texts = Annotated[dict[str, str], _Fields.texts]
Counts = Annotated[dict[int, int], _Fields.counts]
ShortBytes = Annotated[bytes, _Fields.short_bytes]
Rest = Annotated[bytes, _Fields.rest]


class Footer(NamedTuple):
    """Last record: where the summary begins (0 = none) and its checksum, of which 0 means not computed."""

    summary_start: U64
    summary_offset_start: U64
    summary_crc: U32


class Schema(NamedTuple):
    """Definition of a message type."""

    id: U16
    name: Text
    encoding: Text
    data: ShortBytes


class Channel(NamedTuple):
    """A stream of messages of one schema (0 = none)."""

    id: U16
    schema_id: U16
    topic: Text
    message_encoding: Text
    metadata: Texts


class Chunk(NamedTuple):
    """A batch of records."""

    message_start_time: U64
    message_end_time: U64
    uncompressed_size: U64
    uncompressed_crc: U32
    compression: Text
    compressed_size: U64
    rest: Rest

    @property
    def records(self) -> bytes:
        """As stored; perhaps fewer bytes than `compressed_size` where the file is cut."""
        return self.rest[: self.compressed_size]


class ChunkIndex(NamedTuple):
    """Where a chunk lies and what it holds."""

    message_start_time: U64
    message_end_time: U64
    chunk_start_offset: U64
    chunk_length: U64
    message_index_offsets: Counts
    message_index_length: U64
    compression: Text
    compressed_size: U64
    uncompressed_size: U64


class Statistics(NamedTuple):
    """What the file holds, as its writer counted."""

    message_count: U64
    schema_count: U16
    channel_count: U32
    attachment_count: U32
    metadata_count: U32
    chunk_count: U32
    message_start_time: U64
    message_end_time: U64
    channel_message_counts: Counts


class DataEnd(NamedTuple):
    """End of the data section; its checksum, of which 0 means not computed."""

    data_section_crc: U32


_KINDS: dict[int, type[Any]] = {  # by opcode
    FOOTER: Footer,
    SCHEMA: Schema,
    CHANNEL: Channel,
    CHUNK: Chunk,
    CHUNK_INDEX: ChunkIndex,
    STATISTICS: Statistics,
    DATA_END: DataEnd,
}
_READERS = {  # of the fields in their order, as their types say
    opcode: [field.__metadata__[0] for field in get_type_hints(kind, include_extras=True).values()]
    for opcode, kind in _KINDS.items()
}


def parse_record(opcode: int, content: bytes) -> object:
    """The record of these bytes, None for an opcode that is not among `_KINDS`. Raises BadRecordError."""
    kind = _KINDS.get(opcode)
    if kind is None:
        return None
    fields = _Fields(content)
    return kind(*[read(fields) for read in _READERS[opcode]])

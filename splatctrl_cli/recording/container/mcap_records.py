"""The MCAP records whose fields are read, each within its own bytes.

The `mcap` package reads them (mcap.dev/spec). Bytes after the last field are allowed, as specified.
"""

import struct
from io import BytesIO
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Schema, Statistics

__all__ = ["Channel", "Chunk", "ChunkIndex", "DataEnd", "Footer", "Schema", "Statistics", "parse_record"]
MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, ATTACHMENT, SCHEMA, CHANNEL = 0x05, 0x06, 0x09, 0x03, 0x04
DATA_END, FOOTER, CHUNK_INDEX, STATISTICS, MESSAGE_INDEX = 0x0F, 0x02, 0x08, 0x0B, 0x07
FIRST_OPCODE = 0x01
HEAD = struct.Struct("<BQ")  # opcode and length of what follows


class BadRecordError(ValueError):
    """A record too short for its fields."""


class _Fields(ReadDataStream):  # type: ignore[misc]
    def read(self, length: int) -> bytes:
        """Read exactly `length` bytes. Raises EndOfFile, where the package returns fewer."""
        found: bytes = super().read(length)
        if len(found) < length:
            raise EndOfFile
        return found

    def read_prefixed_string(self) -> str:
        return self.read(self.read4()).decode("utf-8", "replace")

    def rest(self) -> bytes:
        """The remaining bytes."""
        return bytes(self._stream.read())


class Chunk(NamedTuple):
    """Stored records; shorter than `compressed_size` if cut."""

    message_start_time: int
    message_end_time: int
    uncompressed_size: int
    uncompressed_crc: int
    compression: str
    compressed_size: int
    records: bytes

    @classmethod
    def read(cls, fields: _Fields) -> "Chunk":
        numbers = (fields.read8(), fields.read8(), fields.read8(), fields.read4())
        compression, size = fields.read_prefixed_string(), fields.read8()
        return cls(*numbers, compression, size, fields.rest()[:size])


_KINDS: dict[int, Any] = {  # by opcode
    FOOTER: Footer,
    SCHEMA: Schema,
    CHANNEL: Channel,
    CHUNK: Chunk,
    CHUNK_INDEX: ChunkIndex,
    STATISTICS: Statistics,
    DATA_END: DataEnd,
}


def parse_record(opcode: int, content: bytes) -> Any:
    """A record, None if not in `_KINDS`. Raises BadRecordError."""
    if opcode not in _KINDS:
        return None
    try:
        return _KINDS[opcode].read(_Fields(BytesIO(content)))
    except EndOfFile:
        raise BadRecordError(f"a record of {len(content)} bytes ends within a field") from None

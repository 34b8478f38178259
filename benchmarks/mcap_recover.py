"""The algorithm of the MCAP project's recovery tool, in short.

`mcap recover` of foxglove/mcap: go/cli/mcap/cmd/recover.go on go/mcap/lexer.go and go/cli/mcap/utils/rebuild_info.go,
as published (commit 6dfb6290 and later). It reads records in order and stops at the first record that is invalid at
its place. By default, chunks are copied unchanged. Their messages are counted by the message indexes after them; a
chunk is unpacked only for a new channel, or if it is the last. With --always-decode-chunk, each chunk is unpacked and
its checksum compared. A chunk with another checksum is omitted; a chunk that does not unpack ends the run.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, DATA_END = 2, 3, 4, 5, 6, 7, 9, 15
LARGEST = 1 << 31  # bytes that Go would fail to allocate here

Key = tuple[str, int, bytes]  # topic, log time, data


class StopError(Exception):
    """The tool goes no further."""


@dataclass
class Recovered:
    """`claimed`: number of messages that the tool reports. `kept`: messages in its output that a reader with checksum
    tests finds.
    """

    claimed: int = 0
    kept: list[Key] = field(default_factory=list)


@dataclass(frozen=True)
class _Chunk:
    size: int
    crc: int
    compression: str
    records: bytes


def recover(content: bytes, *, always_decode: bool = False) -> Recovered:
    """What `mcap recover` makes of the bytes of a file."""
    run = _Run(always_decode)
    try:
        for opcode, record in _records(content):
            run.take(opcode, record)
            if opcode in {DATA_END, FOOTER}:
                return run.found
    except (StopError, struct.error, IndexError):
        pass
    run.write_chunk(by_indexes=False)
    return run.found


class _Run:
    def __init__(self, always_decode: bool) -> None:
        self.found = Recovered()
        self._always_decode = self._is_decoding = always_decode
        self._channels: dict[int, str] = {}
        self._last: _Chunk | None = None
        self._indexes: list[tuple[int, int]] = []  # channel, number of messages

    def take(self, opcode: int, record: bytes) -> None:
        """One record of the file."""
        if opcode != MESSAGE_INDEX:
            self.write_chunk(by_indexes=True)
        if opcode == CHUNK:
            chunk = _chunk(record)
            if self._always_decode:
                self._take_all(self._unpacked(chunk))
            else:
                self._last = chunk
                if self._is_decoding:
                    self.write_chunk(by_indexes=False)
        elif opcode == MESSAGE_INDEX and not self._is_decoding:
            channel, length = struct.unpack_from("<HI", record)
            if self._last is None or 6 + length > len(record):
                self._last = None  # an error of its own, after which nothing more is written
                raise StopError
            self._indexes.append((channel, length // 16))
        elif opcode in {SCHEMA, CHANNEL, MESSAGE}:
            self._is_decoding = True
            self._take_all(struct.pack("<BQ", opcode, len(record)) + record)

    def write_chunk(self, *, by_indexes: bool) -> None:
        """Copy the chunk that was met last, if any."""
        chunk, indexes = self._last, self._indexes if by_indexes else []
        self._last, self._indexes = None, []
        if chunk is None:
            return
        indexes = [(channel, count) for channel, count in indexes if count]
        claimed = sum(count for _, count in indexes)
        try:
            records = _unpack(chunk)
            is_good = len(records) == chunk.size and (zlib.crc32(records) == chunk.crc or not chunk.crc)
        except StopError:
            records, is_good = b"", False
        must_unpack = not indexes or any(channel not in self._channels for channel, _ in indexes)
        if must_unpack and not is_good:
            return
        before = len(self.found.kept), self.found.claimed
        if is_good:
            self._take_all(records)
        self.found.claimed = before[1] + (claimed if indexes else len(self.found.kept) - before[0])

    def _unpacked(self, chunk: _Chunk) -> bytes:
        """Records of a decoded chunk; empty if its checksum differs. Raises StopError if it does not unpack."""
        records = _unpack(chunk)
        if len(records) < chunk.size:
            raise StopError
        return records if zlib.crc32(records[: chunk.size]) == chunk.crc or not chunk.crc else b""

    def _take_all(self, records: bytes) -> None:
        for opcode, record in _within(records):
            if opcode == CHANNEL:
                length = struct.unpack_from("<I", record, 4)[0]
                self._channels[struct.unpack_from("<H", record)[0]] = record[8 : 8 + length].decode(
                    "utf-8", "replace"
                )
            elif opcode == MESSAGE:
                channel, _, log_time = struct.unpack_from("<HIQ", record)
                self.found.claimed += 1
                if channel in self._channels:
                    self.found.kept.append((self._channels[channel], log_time, record[22:]))


def _records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """The records of a file; raises StopError at the first record that is incomplete or has opcode 0."""
    if content[:8] != MAGIC:
        raise StopError
    at = 8
    while True:
        if at + 9 > len(content):
            raise StopError
        opcode, length = struct.unpack_from("<BQ", content, at)
        if opcode == 0 or at + 9 + length > len(content) or length > LARGEST:
            raise StopError
        yield opcode, content[at + 9 : at + 9 + length]
        at += 9 + length


def _within(records: bytes) -> Iterator[tuple[int, bytes]]:
    """The records in a chunk."""
    at = 0
    while at + 9 <= len(records):
        opcode, length = struct.unpack_from("<BQ", records, at)
        if opcode == 0 or at + 9 + length > len(records):
            raise StopError
        yield opcode, records[at + 9 : at + 9 + length]
        at += 9 + length


def _chunk(record: bytes) -> _Chunk:
    size, crc, length = struct.unpack_from("<QII", record, 16)
    stored = struct.unpack_from("<Q", record, 32 + length)[0]
    if size > LARGEST or len(record) < 40 + length + stored:
        raise StopError
    return _Chunk(size, crc, record[32 : 32 + length].decode("latin-1"), record[40 + length : 40 + length + stored])


def _unpack(chunk: _Chunk) -> bytes:
    try:
        match chunk.compression:
            case "":
                return chunk.records
            case "zstd":
                return zstandard.ZstdDecompressor().decompressobj().decompress(chunk.records)
            case "lz4":
                return bytes(lz4.frame.decompress(chunk.records))
    except (zstandard.ZstdError, RuntimeError, MemoryError):
        raise StopError from None
    raise StopError

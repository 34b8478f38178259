"""The records of an MCAP file from front to back, despite damage, in bounded memory.

After an impossible record, reading continues at the summary's next place, or the next compressed chunk with
consistent lengths. The `mcap` package reads a record's fields (mcap.dev/spec); bytes after the last field are
allowed.
"""

import bisect
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Schema, Statistics

from splatctrl_cli.errors import refuse_faults
from splatctrl_cli.formats.unpacking import MAX_BLOCK, PIECE, BadBlockError
from splatctrl_cli.recording.container.raw_log import Damage, Part

__all__ = ["Channel", "Chunk", "ChunkIndex", "DataEnd", "Footer", "Schema", "Statistics", "parse_record"]
MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, ATTACHMENT, SCHEMA, CHANNEL = 0x05, 0x06, 0x09, 0x03, 0x04
DATA_END, FOOTER, CHUNK_INDEX, STATISTICS, MESSAGE_INDEX = 0x0F, 0x02, 0x08, 0x0B, 0x07
FIRST_OPCODE = 0x01
HEAD = struct.Struct("<BQ")  # opcode and length of what follows


class _Fields(ReadDataStream):  # type: ignore[misc]
    def read(self, length: int) -> bytes:
        """Read exactly `length` bytes. Raises EndOfFile where the package returns fewer."""
        content: bytes = super().read(length)
        if len(content) < length:
            raise EndOfFile
        return content

    def read_prefixed_string(self) -> str:
        return self.read(self.read4()).decode("utf-8", "replace")

    def rest(self) -> bytes:
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
    """A record, None if not in `_KINDS`. Raises BadBlockError."""
    if opcode not in _KINDS:
        return None
    with refuse_faults(
        lambda _: f"a record of {len(content)} bytes ends within a field", EndOfFile, error=BadBlockError
    ):
        return _KINDS[opcode].read(_Fields(BytesIO(content)))


_CHUNK_HEAD = struct.Struct("<BQQQQI")  # opcode, length, start, end, unpacked size, crc; then the compression's name
_COMPRESSIONS = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_FOOTER_SIZE = HEAD.size + 20


class McapFile:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size

    def parts(self, damage: Damage, *, is_known: bool = False) -> Iterator[Part]:
        """Yield records in order; losses and faults, wrong checksums included, go to `damage`.

        is_known: skip checksums that were compared before.
        """
        places = [index.chunk_start_offset for index in self.chunk_indexes()]  # where records are known to begin
        places += [part.offset for part in self.summary()[:1]]
        with self.path.open("rb") as stream:
            yield from _Walk(stream, self.path.name, self.size, damage, places, has_crc=not is_known).parts()

    def summary(self) -> list[Part]:
        with self.path.open("rb") as stream:
            footer = _footer(stream, self.size)
            if footer is None or not len(MAGIC) <= footer.summary_start < self.size:
                return []
            stream.seek(footer.summary_start)
            content = stream.read(min(self.size - footer.summary_start, 64 << 20))
        parts, at = [], 0
        while at + HEAD.size <= len(content):
            opcode, length = HEAD.unpack_from(content, at)
            start, at = at + HEAD.size, at + HEAD.size + length
            if opcode < FIRST_OPCODE or at > len(content) or opcode == FOOTER:
                break
            parts.append(Part(footer.summary_start + start - HEAD.size, opcode, content[start:at]))
        return parts

    def chunk_indexes(self) -> list[ChunkIndex]:
        indexes: list[ChunkIndex] = []
        for part in self.summary():
            with suppress(BadBlockError):
                indexes += [parse_record(CHUNK_INDEX, part.content)] if part.opcode == CHUNK_INDEX else []
        return sorted(indexes, key=lambda index: index.chunk_start_offset)

    def chunk_at(self, index: ChunkIndex) -> bytes:
        """Content of a chunk record, cut short where the file ends."""
        with self.path.open("rb") as stream:
            stream.seek(min(index.chunk_start_offset, self.size))
            opcode, length = HEAD.unpack((stream.read(HEAD.size) + bytes(HEAD.size))[: HEAD.size])
            return stream.read(min(length, MAX_BLOCK + PIECE)) if opcode == CHUNK else b""


class _Walk:
    def __init__(
        self, stream: BinaryIO, name: str, size: int, damage: Damage, places: list[int], *, has_crc: bool
    ) -> None:
        self._stream, self._name, self._size = stream, name, size
        self._damage, self._places = damage, sorted(places)
        self._crc: int | None = 0 if has_crc else None  # of the data section so far; None once a part was skipped

    def parts(self) -> Iterator[Part]:
        """Yield records up to the footer, or to what is left of a cut chunk."""
        if self._take(len(MAGIC)) != MAGIC:
            self._add("does not begin like an MCAP")
            return
        is_data = True
        while True:
            offset = self._stream.tell()
            head = self._stream.read(HEAD.size)
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            end = offset + HEAD.size + length
            if opcode < FIRST_OPCODE or end > self._size:
                if not head:
                    self._add("ends without a footer: cut, or still being written")
                    return
                part = self._beyond(offset, opcode)
                if part is not None:
                    yield part
                    return
                if self._stream.tell() >= self._size:
                    return
                continue
            if is_data and opcode in {DATA_END, FOOTER}:
                is_data = False
                self._check_data(opcode, length)
            part = self._part(offset, opcode, length, head)
            yield part
            if self._stream.tell() != end:
                self._stream.seek(end)
            if opcode == FOOTER:
                self._check_end(part)
                return

    def _part(self, offset: int, opcode: int, length: int, head: bytes) -> Part:
        self._count(head)
        if opcode == ATTACHMENT:
            self._check_attachment(offset, length)
            return Part(offset, opcode, b"")
        if opcode <= DATA_END and length <= MAX_BLOCK + PIECE:
            return Part(offset, opcode, self._take(length))
        if opcode <= DATA_END:
            self._add(f"the record at byte {offset} was left out: {length} bytes, at most {MAX_BLOCK} are read")
        self._pass_over(length)
        return Part(offset, opcode, b"", opcode <= DATA_END)

    def _beyond(self, offset: int, opcode: int) -> Part | None:
        """Go to the next readable place, or return the rest of a cut chunk."""
        start = self._next_place(offset)
        if start is not None:
            self._add(f"bytes {offset} to {start} are damaged and were left out")
            self._stream.seek(start)
            self._crc = None
            return None
        self._add(f"cut or damaged after byte {offset}")
        self._stream.seek(min(offset + HEAD.size, self._size))
        if opcode == CHUNK:
            return Part(offset, opcode, self._stream.read(MAX_BLOCK), True)
        self._stream.seek(self._size)
        return None

    def _next_place(self, offset: int) -> int | None:
        position = bisect.bisect_right(self._places, offset)
        if position < len(self._places) and self._places[position] + HEAD.size <= self._size:
            return self._places[position]
        before = _CHUNK_HEAD.size
        self._stream.seek(offset + 1)
        tail = b""
        while block := self._stream.read(PIECE):
            base = self._stream.tell() - len(block) - len(tail)
            block = tail + block
            place = min((at for at in self._chunks_in(block, base) if base + at > offset), default=None)
            if place is not None:
                return base + place
            tail = block[-(before + 16) :]
        return None

    def _chunks_in(self, block: bytes, base: int) -> Iterator[int]:
        """Yield where chunks with consistent lengths begin in `block`, the file from byte `base`."""
        for name in _COMPRESSIONS:
            at = block.find(name)
            while at >= 0:
                start, tail = at - _CHUNK_HEAD.size, at + len(name)
                if start >= 0 and tail + 8 <= len(block):
                    opcode, length, first, last, *_ = _CHUNK_HEAD.unpack_from(block, start)
                    stored = int.from_bytes(block[tail : tail + 8], "little")
                    agrees = length >= _CHUNK_HEAD.size - HEAD.size + len(name) + 8 + stored
                    if opcode == CHUNK and agrees and first <= last and base + start + 9 + length <= self._size:
                        yield start
                at = block.find(name, at + 1)

    def _check_data(self, opcode: int, length: int) -> None:
        if opcode != DATA_END or length > PIECE:
            return
        position, expected = self._stream.tell(), 0
        with suppress(BadBlockError):
            expected = parse_record(DATA_END, self._stream.read(length)).data_section_crc
        self._stream.seek(position)
        if expected and self._crc is not None and self._crc != expected:
            self._add("checksum of the data section differs")
        self._crc = None

    def _check_attachment(self, offset: int, length: int) -> None:
        start = self._stream.tell()
        head = self._take(min(length, 1 << 16))  # bytes in which its name and media type must end
        body = _attachment_length(head)
        if body is None or body + 4 > length:
            self._add(f"the attachment at byte {offset} does not hold what it announces")
            self._pass_over(length - len(head))
            return
        crc = zlib.crc32(head[:body])
        crc = self._pass_over(max(0, body - len(head)), crc)
        tail = head[body : body + 4]
        tail += self._take(4 - len(tail))
        expected = int.from_bytes(tail, "little")
        if expected and expected != crc:
            self._add(f"checksum of the attachment at byte {offset} differs")
        self._pass_over(length - (self._stream.tell() - start))

    def _check_end(self, part: Part) -> None:
        try:
            footer = parse_record(FOOTER, part.content)
        except BadBlockError:
            self._add("its footer is damaged")
            return
        after = self._stream.tell()
        if self._stream.read(len(MAGIC)) != MAGIC:
            self._add("its closing mark is missing")
        elif after + len(MAGIC) < self._size:
            self._add(f"{self._size - after - len(MAGIC)} bytes after its end were left out")
        start = footer.summary_start or part.offset
        end = part.offset + HEAD.size + 16
        is_inside = len(MAGIC) <= start <= part.offset
        self._stream.seek(start if is_inside else 0)
        self._crc = None
        if footer.summary_crc and not (is_inside and self._pass_over(end - start) == footer.summary_crc):
            self._add("checksum of the summary differs")

    def _pass_over(self, length: int, crc: int = 0) -> int:
        while length > 0 and (piece := self._take(min(length, PIECE))):
            crc = zlib.crc32(piece, crc)
            length -= len(piece)
        return crc

    def _take(self, length: int) -> bytes:
        content = self._stream.read(length)
        self._count(content)
        return content

    def _count(self, content: bytes) -> None:
        if self._crc is not None:
            self._crc = zlib.crc32(content, self._crc)

    def _add(self, note: str) -> None:
        self._damage.add(f"{self._name}: {note}")


def _footer(stream: BinaryIO, size: int) -> Footer | None:
    if size < 2 * len(MAGIC) + _FOOTER_SIZE:
        return None
    stream.seek(size - len(MAGIC) - _FOOTER_SIZE)
    content = stream.read(_FOOTER_SIZE + len(MAGIC))
    opcode, length = HEAD.unpack_from(content)
    if opcode != FOOTER or length != 20 or not content.endswith(MAGIC):
        return None
    return parse_record(FOOTER, content[HEAD.size : _FOOTER_SIZE])


def _attachment_length(head: bytes) -> int | None:
    at = 16
    for _ in range(2):
        if at + 4 > len(head):
            return None
        at += 4 + int.from_bytes(head[at : at + 4], "little")
    return None if at + 8 > len(head) else at + 8 + int.from_bytes(head[at : at + 8], "little")

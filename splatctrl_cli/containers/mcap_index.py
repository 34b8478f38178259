"""What an MCAP holds without reading it: from the heads of its records, where no summary says so."""

import struct
from dataclasses import dataclass

from splatctrl_cli.containers.mcap_file import McapFile
from splatctrl_cli.containers.mcap_records import (
    CHUNK,
    FIRST_OPCODE,
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    BadRecordError,
    Chunk,
    ChunkIndex,
    parse_record,
)

MOST_HEADS = 100_000  # records that are visited: a second or so


@dataclass(frozen=True, kw_only=True)
class LogIndex:
    """Messages by channel, log times [ns], chunks in file order; notes say what it does not cover."""

    counts: dict[int, int]
    first_ns: int
    last_ns: int
    chunks: tuple[ChunkIndex, ...]
    notes: tuple[str, ...]


def index_by_heads(file: McapFile) -> LogIndex:
    """The chunks and messages of a file without a summary, up to the first damaged place or MOST_HEADS records."""
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
                chunk = _chunk_index(content, offset, length)
                if chunk is not None:
                    chunks.append(chunk)
            elif opcode == MESSAGE_INDEX and chunks:
                channel, size = struct.unpack_from("<HI", content)
                counts[channel] = counts.get(channel, 0) + size // 16
                offsets = {**chunks[-1].message_index_offsets, channel: offset}
                chunks[-1] = chunks[-1]._replace(message_index_offsets=offsets)
            elif opcode == MESSAGE:
                channel, _, stamp, _ = struct.unpack_from("<HIQQ", content)
                counts[channel] = counts.get(channel, 0) + 1
                stamps.append(stamp)
            offset += HEAD.size + length
            num_heads += 1
    stamps += [stamp for c in chunks for stamp in (c.message_start_time, c.message_end_time)]
    notes = [] if offset + HEAD.size >= file.size else [f"counted up to byte {offset} of {file.size}"]
    return LogIndex(
        counts=counts,
        first_ns=min(stamps, default=0),
        last_ns=max(stamps, default=0),
        chunks=tuple(chunks),
        notes=("has no summary: counted by the heads of its records", *notes),
    )


def _chunk_index(content: bytes, offset: int, length: int) -> ChunkIndex | None:
    try:
        chunk = parse_record(CHUNK, content)
    except BadRecordError:
        return None
    assert isinstance(chunk, Chunk)
    return ChunkIndex(
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

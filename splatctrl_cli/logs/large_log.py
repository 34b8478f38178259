"""A survey of a log too large to read for a description: its index, and the first messages of each topic."""

from itertools import islice

from splatctrl_cli.containers.mcap_index import LogIndex
from splatctrl_cli.containers.mcap_log import McapLog
from splatctrl_cli.containers.mcap_records import ChunkIndex
from splatctrl_cli.containers.raw_log import Damage, RawLog
from splatctrl_cli.logs.decoder import MessageDecoder
from splatctrl_cli.logs.survey import Survey, TopicSurvey, add_message, survey

LARGE = 1 << 30  # bytes from which on an MCAP is described by its index
_MOST_CHUNKS = 24
_MOST_BYTES = 64 << 20  # of chunks that are unpacked
_MOST_MESSAGES = 2000  # of a file without chunks


def survey_to_describe(log: RawLog) -> tuple[Survey, tuple[str, ...]]:
    """A survey of the whole log; of a large MCAP one by its index, and notes that say so."""
    size = sum(file.stat().st_size for file in log.files)
    if size < LARGE or not isinstance(log, McapLog):
        return survey(log), ()
    index = log.index()
    found = _sampled(log, index)
    how = f"{size} bytes: described by index and first messages; neither checksums nor the rest were read"
    return found, (*index.notes, how)


def _sampled(log: McapLog, index: LogIndex) -> Survey:
    found, decoder = Survey(), MessageDecoder()
    chunks = _first_chunks(index)
    messages = log.messages_of(chunks, found.damage) if chunks else islice(log.messages(Damage()), _MOST_MESSAGES)
    for message in messages:
        add_message(found, decoder, message)
    for topic in log.topics():
        found.topics.setdefault(topic.name, TopicSurvey(topic=topic))
    for entry in found.topics.values():
        entry.count = 0
    for channel, count in index.counts.items():
        counted = log.topic_of(channel)
        if counted is not None:
            entry = found.topics[counted.name]
            entry.count += count
            entry.first_log_ns = entry.first_log_ns or index.first_ns
            entry.last_log_ns = index.last_ns
    return found


def _first_chunks(index: LogIndex) -> list[ChunkIndex]:
    """The first chunk of each channel, and the first ones of the file, within bounds."""
    wanted = {chunk.chunk_start_offset: chunk for chunk in index.chunks[:4]}
    for channel in sorted(index.counts):
        first = next((c for c in index.chunks if channel in c.message_index_offsets), None)
        if first is not None:
            wanted[first.chunk_start_offset] = first
    chosen: list[ChunkIndex] = []
    size = 0
    for _, chunk in sorted(wanted.items())[:_MOST_CHUNKS]:
        size += max(chunk.uncompressed_size, chunk.compressed_size)
        if size <= _MOST_BYTES or not chosen:
            chosen.append(chunk)
    return chosen

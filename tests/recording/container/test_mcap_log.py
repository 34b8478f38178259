"""Damaged and hostile MCAP files: what is whole is read, what is lost is counted, memory stays bounded. And the MCAP
project's conformance files are read as their JSON says.
"""

import bisect
import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Footer
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from benchmarks.mcap_recovery import DAMAGES, LOGS, NUM_MESSAGES, damaged, log
from splatctrl_cli.formats.unpacking import MAX_BLOCK, unpacked
from splatctrl_cli.recording.container.mcap_file import CHUNK, HEAD, MAGIC, MESSAGE, McapFile, Part, parse_record
from splatctrl_cli.recording.container.mcap_file import Chunk as StoredChunk
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import MAX_NOTES, Damage
from splatctrl_cli.recording.source import SourceOptions, open_source
from tests.recording.log.make_log import LogRecipe, make_log
from tests.refused import expect_refusal


def small_log(compression: CompressionType = CompressionType.ZSTD, num: int = 40, size: int = 3000) -> bytes:
    """A log of one topic: message i is logged at i + 1 ns and holds `size` bytes that do not compress away."""
    stream = BytesIO()
    writer = McapWriter(stream, chunk_size=10 * size, compression=compression, enable_data_crcs=True)
    writer.start(profile="", library="tests")
    schema = writer.register_schema(name="x", encoding="", data=b"")
    channel = writer.register_channel(topic="/x", message_encoding="x", schema_id=schema)
    for index in range(num):
        writer.add_message(channel, log_time=index + 1, publish_time=index + 1, data=payload(index, size))
    writer.add_attachment(create_time=1, log_time=1, name="a", media_type="b", data=b"attached")
    writer.finish()
    return stream.getvalue()


def payload(index: int, size: int) -> bytes:
    state, out = index + 1, bytearray()
    while len(out) < size:
        state = (state * 6364136223846793005 + 1442695040888963407) % (1 << 64)
        out += struct.pack("<Q", state)
    return bytes(out[:size])


def read(path: Path, data: bytes) -> tuple[list[int], Damage]:
    """Log times of the messages that `data` gives, each with its right content, and the damage."""
    path.write_bytes(data)
    damage = Damage()
    messages = list(McapLog(path).messages(damage))
    for message in messages:
        assert message.data == payload(message.log_time_ns - 1, len(message.data))
    return [message.log_time_ns for message in messages], damage


def chunk_places(path: Path, data: bytes | bytearray) -> list[int]:
    """Where the chunks of a file that holds `data` begin."""
    path.write_bytes(data)
    return [part.offset for part in McapFile(path).parts(Damage()) if part.opcode == CHUNK]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_cut_gives_the_whole_messages_of_the_chunk_it_cuts(tmp_path: Path, compression: CompressionType) -> None:
    data = small_log(compression, num=60, size=20_000)  # chunks of 200 kB: more than one block of zstd and lz4
    place = chunk_places(tmp_path / "x.mcap", data)[3]
    found, damage = read(tmp_path / "x.mcap", data[: place + 180_000])
    assert (found, damage.notes) == (
        list(range(1, len(found) + 1)),
        [f"x.mcap: cut or damaged after byte {place}"],
    )
    assert len(found) > 30 + 3, "the three chunks before the cut hold ten each; more are in the cut one"


@pytest.mark.parametrize("has_summary", [True, False])
def test_a_chunk_whose_length_is_wrong_costs_itself_alone(tmp_path: Path, has_summary: bool) -> None:
    data = bytearray(small_log())
    place, _, last = chunk_places(tmp_path / "x.mcap", data)[1:4]
    data[place + 1 : place + 9] = struct.pack("<Q", 100 << 30)
    found, damage = read(tmp_path / "x.mcap", bytes(data if has_summary else data[: last + 20]))
    assert found == [*range(1, 11), *range(21, 41 if has_summary else 31)]
    assert "are damaged and were left out" in damage.notes[0]
    assert has_summary or damage.count == 2


def test_a_hole_of_zeros_costs_what_it_covers(tmp_path: Path) -> None:
    data, path = bytearray(small_log()), tmp_path / "x.mcap"
    _, second, third, _ = chunk_places(path, data)
    data[second - 40 : third - 30] = bytes(third - second + 10)
    found, damage = read(path, bytes(data))
    assert found == [*range(1, 11), *range(21, 41)] and damage.count >= 1


@pytest.mark.parametrize(
    ("mark", "num", "note"),
    [
        (payload(12, 8), 30, "checksum differs"),
        (b"attached", 40, "checksum of the attachment"),
        (b"/x", 40, "of the summary"),
    ],
    ids=["chunk", "attachment", "summary"],
)
def test_each_checksum_is_checked(tmp_path: Path, mark: bytes, num: int, note: str) -> None:
    data = bytearray(small_log(CompressionType.NONE))
    data[data.rindex(mark)] ^= 1
    found, damage = read(tmp_path / "x.mcap", bytes(data))
    assert len(found) == num and any(note in said for said in damage.notes)


START = MAGIC + struct.pack("<BQII", 0x01, 8, 0, 0)  # a header without names


def chunks(records: bytes, size: int, num: int = 1) -> bytes:
    """A log of so many chunks of these records, each announcing `size` bytes unpacked."""
    builder = RecordBuilder()
    said = {"message_start_time": 0, "message_end_time": 1, "uncompressed_crc": 0, "uncompressed_size": size}
    for _ in range(num):
        Chunk(compression="zstd", data=records, **said).write(builder)
    DataEnd(0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return START + builder.end() + MAGIC


def unknown(opcode: int) -> bytes:
    """A thousand records of 64 kB, packed."""
    size = (1 << 16) - 9
    return zstandard.compress((struct.pack("<BQ", opcode, size) + bytes(size)) * (1 << 10))


HOSTILE: dict[
    str, tuple[Callable[[], bytes], str]
] = {  # small files that ask for much memory or time, and their note
    "record": (lambda: START + struct.pack("<BQ", 0x05, 100 << 30) + bytes(100), "cut or damaged after byte"),
    "attachment": (lambda: START + struct.pack("<BQ", 0x09, 100 << 30) + bytes(100), "cut or damaged after byte"),
    "text": (lambda: START + struct.pack("<BQHI", 0x03, 50, 1, 0xFFFFFFF0) + bytes(44), "was left out"),
    "bomb": (
        lambda: chunks(zstandard.compress(bytes(1 << 30)), 1 << 30),
        f"announces {1 << 30} bytes unpacked, at most {MAX_BLOCK} are read",
    ),
    "liar": (lambda: chunks(unknown(0), 1 << 20), "holds more"),
    # a frame that asks for a window of 3.75 TiB
    "window": (
        lambda: chunks(b"\x28\xb5\x2f\xfd\x00\xff\x01\x00\x00" + bytes(16), 1 << 20),
        "cannot be decompressed",
    ),
    "many": (lambda: chunks(unknown(0), 1 << 26, 20), "holds bytes that are not a record"),
    "flood": (lambda: chunks(unknown(0x10), 1 << 26, 20), "unpacks to over 1000 times"),
}


def test_unknown_records_are_passed_over(tmp_path: Path) -> None:
    data, path = small_log(), tmp_path / "x.mcap"
    place = chunk_places(path, data)[0]
    alien = b"".join(struct.pack("<BQ", opcode, 5) + b"alien" for opcode in (0x10, 0x7F, 0x80, 0xFF))
    found, damage = read(path, data[:place] + alien + data[place:])
    # the checksum of the data section differs
    assert (found, [note[-7:] for note in damage.notes[:1]]) == (list(range(1, 41)), ["differs"])


def test_notes_of_damage_are_bounded_and_their_count_is_not() -> None:
    damage = Damage()
    for index in range(1000):
        damage.add(f"note {index}")
    said = [f"note {MAX_NOTES - 1}", f"and {1000 - MAX_NOTES} more"]
    assert (damage.count, damage.notes[-2:]) == (1000, said)


READ = """
import resource, sys
from pathlib import Path
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage
resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))
for path in sys.argv[1:]:
    damage = Damage()
    assert list(McapLog(Path(path)).messages(damage)) == []
    status = Path("/proc/self/status").read_text().splitlines()
    peak = next(line for line in status if line.startswith("VmHWM"))  # ru_maxrss begins with a parent's
    print(int(peak.split()[1]) // 1024, damage.notes[0])
"""


def test_a_small_file_that_asks_for_much_gets_little(tmp_path: Path) -> None:
    for name, (make, _) in HOSTILE.items():
        (tmp_path / name).write_bytes(make())
        assert (tmp_path / name).stat().st_size < 1 << 18
    command = [sys.executable, "-c", READ, *(str(tmp_path / name) for name in HOSTILE)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    for (name, (_, told)), line in zip(HOSTILE.items(), done.stdout.splitlines(), strict=True):
        megabytes, note = line.split(" ", 1)
        assert told in note and int(megabytes) < 700, name


def test_checksums_are_compared_once_and_again_where_the_file_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(small_log(CompressionType.NONE))
    log, num_sums, crc32 = McapLog(path), 0, zlib.crc32

    def counting(data: bytes, value: int = 0) -> int:
        nonlocal num_sums
        num_sums += len(data) > 1000  # not those of the short heads and of the summary
        return crc32(data, value)

    monkeypatch.setattr(zlib, "crc32", counting)
    sums = []
    for _ in range(3):
        num_sums = 0
        assert len(list(log.messages(Damage()))) == 40
        sums.append(num_sums)
    assert sums[0] > 4 and sums[1:] == [0, 0]
    data = bytearray(path.read_bytes())
    data[data.index(payload(30, 100)) + 50] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(1, 1))
    for _ in range(2):
        damage = Damage()
        assert len(list(log.messages(damage))) < 40 and "checksum differs" in damage.notes[0]
    again = McapLog(path)
    assert next(again.messages(Damage())).log_time_ns == 1, "a pass that was not finished says nothing of checksums"
    assert len(list(again.messages(Damage()))) < 40


def test_a_log_whose_damage_took_what_is_missing_says_so(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(chunk_size=1))  # a chunk a message, tf first
    data, chunk = bytearray(log.read_bytes()), McapFile(log).chunk_indexes()[0]
    data[chunk.chunk_start_offset + chunk.chunk_length - 1] ^= 0xFF
    log.write_bytes(data)
    expected = r"no tf .*; but the log is damaged: .*chunk.*; copy the file again; if this is all there is: "
    expect_refusal(expected, open_source, log, SourceOptions(world_frame="world"))


STEP = 211

SAY_NOTHING = {CHUNK: {*range(9, 25)}, MESSAGE: {*range(11, 15), *range(23, 31)}}

"""Bytes of a record of which no message depends: the times of a chunk, number and time of publishing of a message."""


def standing(data: bytes, file: bytes, records: list[Part]) -> set[int]:
    """Places of records whose messages a damaged file still has to give: those before the damage and, where it leaves
    the lengths of all records, those in which no byte was changed that a message depends on.
    """
    changed = [i for i in range(len(data)) if file[i : i + 1] != data[i : i + 1]]
    places = [record.offset for record in records]
    bytes_of: dict[int, set[int]] = {place: set() for place in places}  # that changed, by record
    for i in changed:
        place = places[bisect.bisect_right(places, i) - 1]
        bytes_of[place].add(i - place)
    if any(0 < i < HEAD.size for own in bytes_of.values() for i in own):
        return {place for place, end in pairwise([*places, len(data)]) if end <= changed[0]}
    return {record.offset for record in records if bytes_of[record.offset] <= SAY_NOTHING.get(record.opcode, set())}


@pytest.mark.parametrize("name", LOGS)
def test_no_message_is_lost_whose_record_stands_and_each_loss_is_told(tmp_path: Path, name: str) -> None:
    """These are at least what `mcap recover` keeps (python -m benchmarks.mcap_recovery)."""
    data, path = log(*LOGS[name]), tmp_path / "x.mcap"
    path.write_bytes(data)
    records = list(McapFile(path).parts(Damage()))
    written = {(m.topic.name, m.log_time_ns, m.data): m.offset for m in McapLog(path).messages(Damage())}
    assert len(written) == NUM_MESSAGES
    for kind in DAMAGES:
        for number, file in enumerate(damaged(data, kind, STEP)):
            path.write_bytes(file)
            damage, places = Damage(), standing(data, file, records)
            found = {(m.topic.name, m.log_time_ns, m.data) for m in McapLog(path).messages(damage)}
            assert {message for message, at in written.items() if at in places} <= found, f"{kind} {number}"
            assert written.keys() <= found or damage.count > 0, f"{kind} {number}"


KINDS = ("Footer", "Schema", "Channel", "Statistics", "ChunkIndex", "DataEnd")  # messages: below


def records_of(path: Path, damage: Damage) -> Iterator[Any]:
    """The records of a file whose fields are read, those in its chunks in their place."""
    for part in McapFile(path).parts(damage):
        record = parse_record(part.opcode, part.content)
        if isinstance(record, StoredChunk):
            yield from records_in(record)
        elif record is not None:
            yield record


def records_in(chunk: StoredChunk) -> Iterator[Any]:
    content = unpacked(chunk.records, chunk.compression, chunk.uncompressed_size)
    assert chunk.uncompressed_crc in {0, zlib.crc32(content)}
    at = 0
    while at < len(content):
        opcode, length = HEAD.unpack_from(content, at)
        at += HEAD.size + length
        record = parse_record(opcode, content[at - length : at])
        if record is not None:
            yield record


def as_json(record: Any) -> dict[str, Any]:
    """A record in the suite's form: numbers as text, bytes as lists of numbers, fields by name."""
    fields = vars(record)
    return {"type": type(record).__name__, "fields": [[name, _value(fields[name])] for name in sorted(fields)]}


def _value(value: Any) -> Any:
    if isinstance(value, bytes):
        return [str(byte) for byte in value]
    if isinstance(value, dict):
        return {str(key): _value(item) for key, item in value.items()}
    return str(value)


@pytest.mark.parametrize("group", ["NoData", "OneMessage", "OneAttachment", "OneMetadata", "TenMessages"])
def test_every_conformance_file_reads_as_its_json_says(real_data: Path, group: str) -> None:
    files = sorted((real_data / "mcap_conformance" / group).glob("*.mcap"))
    assert files
    for file in files:
        damage = Damage()
        records = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))["records"]
        expected = [record for record in records if record["type"] in KINDS]
        assert len(expected) >= 2  # the end of the data and a footer
        assert [as_json(record) for record in records_of(file, damage)] == expected, file.name
        messages = [dict(record["fields"]) for record in records if record["type"] == "Message"]
        given = [(_value(m.data), str(m.log_time_ns)) for m in McapLog(file).messages(damage)]
        assert (given, damage.all_notes) == ([(m["data"], m["log_time"]) for m in messages], []), file.name

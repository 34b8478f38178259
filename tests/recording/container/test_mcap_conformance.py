"""The 342 files of the format's own conformance suite, each record that is read with each of its fields."""

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.formats.unpacking import unpacked
from splatctrl_cli.recording.container.mcap_file import McapFile
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.mcap_records import Chunk, parse_record
from splatctrl_cli.recording.container.raw_log import Damage

_HEAD = struct.Struct("<BQ")
READ = ("Footer", "Schema", "Channel", "Statistics", "ChunkIndex", "DataEnd")  # messages: below


def records_of(path: Path, damage: Damage) -> Iterator[Any]:
    """The records of a file whose fields are read, those in its chunks in their place."""
    for part in McapFile(path).parts(damage):
        record = parse_record(part.opcode, part.content)
        if isinstance(record, Chunk):
            yield from records_in(record)
        elif record is not None:
            yield record


def records_in(chunk: Chunk) -> Iterator[Any]:
    content = unpacked(chunk.records, chunk.compression, chunk.uncompressed_size)
    assert chunk.uncompressed_crc in {0, zlib.crc32(content)}
    at = 0
    while at < len(content):
        opcode, length = _HEAD.unpack_from(content, at)
        at += _HEAD.size + length
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
        found = [as_json(record) for record in records_of(file, damage)]
        records = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))["records"]
        expected = [record for record in records if record["type"] in READ]
        assert len(expected) >= 2  # the end of the data and a footer
        assert found == expected, file.name
        assert damage.notes == [], file.name


def test_the_messages_of_every_conformance_file_are_those_of_its_json(real_data: Path) -> None:
    for file in sorted((real_data / "mcap_conformance").rglob("*.mcap")):
        damage = Damage()
        records = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))["records"]
        expected = [dict(r["fields"]) for r in records if r["type"] == "Message"]
        found = list(McapLog(file).messages(damage))
        assert [_value(m.data) for m in found] == [m["data"] for m in expected], file.name
        assert [str(m.log_time_ns) for m in found] == [m["log_time"] for m in expected], file.name
        assert damage.count == 0, file.name

"""A large MCAP is described by its index in no more reads than it has topics."""

import struct
from pathlib import Path

import pytest

from splatctrl_cli.containers.log_formats import open_raw_log
from splatctrl_cli.containers.mcap_file import McapFile
from splatctrl_cli.containers.mcap_log import McapLog
from splatctrl_cli.containers.mcap_records import DATA_END
from splatctrl_cli.containers.raw_log import Damage
from splatctrl_cli.logs import survey as surveys
from splatctrl_cli.logs.survey import survey
from splatctrl_cli.sources.describe import describe
from tests.logs.make_log import LogRecipe, make_log

GIB = 1 << 30


def sparse_log(path: Path, num_bytes: int) -> Path:
    """A small log with an unknown record of `num_bytes` before the end of its data; offsets behind it are wrong by
    that much but for the summary's, which are not used with this record.
    """
    make_log(path, LogRecipe(num_frames=20))
    data = path.read_bytes()
    end = next(part.offset for part in McapFile(path).parts(Damage()) if part.opcode == DATA_END)
    tail = bytearray(data[end:])
    footer = len(tail) - 8 - 20
    moved = [value + num_bytes + 9 if value else 0 for value in struct.unpack_from("<QQ", tail, footer)]
    struct.pack_into("<QQI", tail, footer, *moved, 0)
    with path.open("r+b") as stream:
        stream.seek(end)
        stream.write(struct.pack("<BQ", 0x80, num_bytes))
        stream.seek(end + 9 + num_bytes)
        stream.write(tail)
    return path


def test_a_large_log_is_described_without_being_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = sparse_log(tmp_path / "log.mcap", 10 * GIB)
    assert log.stat().st_size > 10 * GIB
    monkeypatch.setattr(surveys, "survey", None)  # would be called to read it all
    summary = describe(log)
    assert summary.facts["messages"] == 20 * 4 + 21
    assert summary.missing == ()
    assert summary.damaged == 0
    assert any("neither checksums nor the rest were read" in note for note in summary.notes)


@pytest.mark.parametrize("has_summary", [True, False])
def test_an_index_counts_what_a_survey_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_summary: bool
) -> None:
    path = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=20))
    if not has_summary:
        end = next(part.offset for part in McapFile(path).parts(Damage()) if part.opcode == DATA_END)
        path.write_bytes(path.read_bytes()[:end])
    expected = {name: topic.count for name, topic in survey(McapLog(path)).topics.items()}
    monkeypatch.setattr(surveys, "LARGE", 0)
    found, notes = surveys.survey_to_describe(open_raw_log(path))
    assert {name: topic.count for name, topic in found.topics.items()} == expected
    assert any("has no summary" in note for note in notes) != has_summary
    assert describe(path).missing == ()

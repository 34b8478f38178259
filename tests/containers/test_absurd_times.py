"""Times that no clock gives cost their message, and nothing else."""

from dataclasses import replace
from pathlib import Path

import pytest

from splatctrl_cli.containers.raw_log import RawMessage
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.sources.source import open_source
from tests.logs.make_log import make_log
from tests.logs.write_log import rewritten


def with_last_time(log: Path, path: Path, topics: tuple[str, ...]) -> Path:
    """The log with the last time that MCAP has for the first message of each topic."""
    left = set(topics)

    def late(message: RawMessage) -> RawMessage:
        if message.topic.name not in left:
            return message
        left.remove(message.topic.name)
        return replace(message, log_time_ns=2**64 - 1)

    return rewritten(log, path, late)


@pytest.mark.parametrize(("stamps", "num_frames"), [("header", 5), ("log", 4)])
def test_a_time_beyond_64_bits_costs_its_message(tmp_path: Path, stamps: str, num_frames: int) -> None:
    topics = ("/joint_states", "/cam0/color/image_raw/compressed")
    log = with_last_time(make_log(tmp_path / "log.mcap"), tmp_path / "x.mcap", topics)
    source = open_source(log, SourceOptions(stamps=stamps))
    records = list(source.records())
    assert sum(isinstance(record, RgbdFrame) for record in records) == num_frames
    assert len(records) == num_frames + 4  # joint states
    notes = [f"{topic}: a time beyond 2^63 ns" for topic in topics[: 6 - num_frames]]
    assert sorted(source.loss.notes) == sorted(notes)

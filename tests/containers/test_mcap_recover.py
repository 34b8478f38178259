"""Damaged MCAP files give at least what the format's own recovery tool keeps of them."""

from collections import Counter
from pathlib import Path

import pytest

from benchmarks.mcap_recovery import DAMAGES, LOGS, NUM_MESSAGES, counted, damaged, log
from tests.containers.mcap_recover import recover

STEP = 211


@pytest.mark.parametrize("name", LOGS)
def test_no_message_is_lost_that_the_tool_recovers_and_each_loss_is_told(tmp_path: Path, name: str) -> None:
    data = log(*LOGS[name])
    truth = Counter(recover(data).kept)
    assert truth.total() == NUM_MESSAGES == recover(data, always_decode=True).claimed
    for kind in DAMAGES:
        for number, file in enumerate(damaged(data, kind, STEP)):
            found = counted(file, truth, tmp_path / "x.mcap")
            assert not found.lacking, f"{kind} {number}: {found}"
            assert found.read == NUM_MESSAGES or found.is_told, f"{kind} {number}: {found}"

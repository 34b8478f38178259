"""The script of docs/capture.md, which another program would be, writes a capture that every command reads."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.records import JointState, RgbdFrame
from splatctrl_cli.sources.source import open_source

PAGE = Path(__file__).parents[2] / "docs" / "capture.md"


def test_the_script_of_the_page_writes_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(script) == 1
    assert len(script[0].splitlines()) <= 35
    subprocess.run([sys.executable, "-c", script[0]], cwd=tmp_path, check=True, timeout=60)
    source = open_source(tmp_path / "mine.capture")
    records = list(source.records())
    frames = [record for record in records if isinstance(record, RgbdFrame)]
    assert [frame.stamp_ns for frame in frames] == [0, 100_000_000]
    assert np.unique(frames[1].depth).tolist() == [np.float32(1.25)]
    assert frames[1].T_world_camera[0, 3] == pytest.approx(0.1)
    assert [record.position.tolist() for record in records if isinstance(record, JointState)] == [[0.0]]
    assert source.loss.damaged == 0
    assert main(["check", str(tmp_path / "mine.capture"), "--fail-on", "warning"]) == 0
    assert main(["info", str(tmp_path / "mine.capture")]) == 0
    packed, back = tmp_path / "mine.mcap", tmp_path / "back.capture"
    assert main(["capture", "pack", str(tmp_path / "mine.capture"), "-o", str(packed), "-q"]) == 0
    assert main(["capture", "unpack", str(packed), "-o", str(back), "-q"]) == 0
    assert {p.name: p.read_bytes() for p in back.rglob("*.*")} == {
        p.name: p.read_bytes() for p in (tmp_path / "mine.capture").rglob("*.*")
    }

"""What ``splatctrl ingest`` says of the clocks of cameras and robot."""

import json
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from tests.io.make_log import LogRecipe, make_log


def test_the_offset_of_the_clocks_is_said_and_kept(
    tmp_path: Path, sample_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.capture"
    assert main(["ingest", str(sample_data / "tabletop" / "log.mcap"), "--cameras", "cam0", "-o", str(out)]) == 0
    assert "note: clocks of cameras and robot: frames are stamped" in capsys.readouterr().out
    offset = json.loads((out / "run.json").read_text())["metrics"]["clock_offset"]
    assert abs(offset["offset_s"]) < offset["uncertainty_s"]


def test_a_short_log_cannot_tell_and_one_without_joints_says_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ingest", str(make_log(tmp_path / "a.mcap")), "-o", str(tmp_path / "a")]) == 0
    assert (
        "note: clocks of cameras and robot: cannot tell their offset: expected at least 10" in capsys.readouterr().out
    )
    log = make_log(tmp_path / "b.mcap", LogRecipe(has_joints=False))
    assert main(["ingest", str(log), "-o", str(tmp_path / "b")]) == 0
    assert "clocks" not in capsys.readouterr().out

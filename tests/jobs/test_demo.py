"""The demo: what its verdict rests on, and what its steps leave."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs import demo as module
from splatctrl_cli.jobs.demo import SAMPLE, DemoRequest, demo
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, simulate
from splatctrl_cli.simulate.recording import RecordingOptions
from tests.refused import expect_refusal


@pytest.mark.parametrize(("damaged", "label"), [(0, "passed"), (1, "not as expected")])
def test_the_demo_fails_where_a_step_ends_otherwise_than_it_expects(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, damaged: int, label: str
) -> None:
    arguments: list[list[str]] = []

    def perform(words: Sequence[str], folder: Path) -> str:
        arguments.append(sys.argv[1:])
        assert words in (["info", f"{folder}/a"], ["info", "b"])
        return "exit code 3" if damaged and "b" in words else "done"

    monkeypatch.setattr(module, "STEPS", {"info {out}/a": "done", "info b": "done"})
    monkeypatch.setattr(module, "_draw", lambda *_: None)
    request, before = DemoRequest(out=tmp_path / "out"), list(sys.argv)
    verdict = demo(request, perform)
    assert (verdict.label, verdict.exit_code, sys.argv) == (label, damaged, before)
    assert [reason.sentence for reason in verdict.decisive] == ["expected 'done', got 'exit code 3'"][:damaged]
    assert arguments == [["info", f"{tmp_path}/out/a"], ["info", "b"]], "what makes the same again"
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (run["command"], run["verdict"]["label"]) == ("demo", label)
    assert set(run["inputs"]) == {"log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml"}
    demo(DemoRequest(out=tmp_path / "out", force=True), perform)


def refused(words: Sequence[str], folder: Path) -> str:
    raise AssertionError("a step before the input was looked at")


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    expect_refusal(r"has no log\.mcap, truth\.json", demo, DemoRequest(data=tmp_path, out=tmp_path / "out"), refused)
    expect_refusal("is the input folder", demo, DemoRequest(out=SAMPLE), refused, error=UsageError)


def test_without_the_sample_the_demo_simulates_its_recording_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found: list[str] = []

    def perform(words: Sequence[str], folder: Path) -> str:
        found.append(" ".join(words).replace(str(folder), "FOLDER"))
        if words[0] == "simulate":
            options = RecordingOptions(duration_s=0.5, fps=10, width=32, height=24)
            simulate(SimulateRequest(out=Path(words[2]), options=options))
        return "done"

    monkeypatch.setattr(module, "SAMPLE", tmp_path / "missing")
    monkeypatch.setattr(module, "STEPS", {"info {data}/log.mcap": "done"})
    monkeypatch.setattr(module, "_draw", lambda *_: None)
    out = tmp_path / "out"
    verdict = demo(DemoRequest(out=out), perform)
    assert (verdict.label, [reason.criterion for reason in verdict.reasons]) == ("passed", ["simulate", "info"])
    run = json.loads((out / "recording" / "run.json").read_text())
    assert run["arguments"] == ["simulate", "-o", str(out / "recording")], "what makes the same again"
    assert found == ["simulate -o FOLDER/recording", "info FOLDER/recording/log.mcap"]
    assert set(module.INPUTS) <= {p.name for p in (out / "recording").iterdir()}

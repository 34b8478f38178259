"""The demo: what its verdict rests on, and what its steps leave."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.jobs import demo as module
from splatctrl_cli.jobs.demo import SAMPLE, DemoRequest, Step, demo
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, SimulateResult, simulate
from splatctrl_cli.simulate.recording import RecordingOptions


@pytest.mark.parametrize(("damaged", "label"), [(0, "passed"), (1, "not as expected")])
def test_the_demo_fails_where_a_step_ends_otherwise_than_it_expects(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, damaged: int, label: str
) -> None:
    arguments: list[list[str]] = []

    def described(num_damaged: int) -> Summary:
        arguments.append(sys.argv[1:])
        return Summary(path="x", kind="y", damaged=num_damaged)

    def steps(data: Path, folder: Path, threads: int, progress: object) -> list[Step]:
        good = Step(words=["info", f"{folder}/a"], run=lambda: described(0), expected="done")
        return [good, Step(words=["info", "b"], run=lambda: described(damaged), expected="done")]

    monkeypatch.setattr(module, "_steps", steps)
    monkeypatch.setattr(module, "_draw", lambda *_: None)
    request, told, before = DemoRequest(out=tmp_path / "out"), [], list(sys.argv)
    result = demo(request, told=lambda found, folder: told.append(found))
    assert (result.verdict.label, result.verdict.exit_code) == (label, damaged)
    assert [reason.sentence for reason in result.verdict.decisive] == ["expected 'done', got 'exit code 3'"][:damaged]
    assert len(told) == 2 and sys.argv == before
    assert arguments == [["info", f"{tmp_path}/out/a"], ["info", "b"]], "what makes the same again"
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (run["command"], run["verdict"]["label"]) == ("demo", label)
    assert set(run["inputs"]) == {"log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml"}
    demo(DemoRequest(out=tmp_path / "out", force=True))


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no log\.mcap, truth\.json"):
        demo(DemoRequest(data=tmp_path, out=tmp_path / "out"))
    with pytest.raises(UsageError, match="is the input folder"):
        demo(DemoRequest(out=SAMPLE))


def test_without_the_sample_the_demo_simulates_its_recording_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found: list[Path] = []

    def simulated(request: SimulateRequest, progress: object) -> SimulateResult:
        return simulate(replace(request, options=RecordingOptions(duration_s=0.5, fps=10, width=32, height=24)))

    def steps(data: Path, folder: Path, threads: int, progress: object) -> list[Step]:
        found.append(data.relative_to(folder))
        return [Step(words=["info", "a"], run=lambda: Summary(path="x", kind="y"), expected="done")]

    monkeypatch.setattr(module, "SAMPLE", tmp_path / "missing")
    monkeypatch.setattr(module, "simulate", simulated)
    monkeypatch.setattr(module, "_steps", steps)
    monkeypatch.setattr(module, "_draw", lambda *_: None)
    out = tmp_path / "out"
    result = demo(DemoRequest(out=out))
    assert (result.verdict.label, [reason.criterion for reason in result.verdict.reasons]) == (
        "passed",
        ["simulate", "info"],
    )
    run = json.loads((out / "recording" / "run.json").read_text())
    assert run["arguments"] == ["simulate", "-o", str(out / "recording")], "what makes the same again"
    assert found == [Path("recording")] and set(module.INPUTS) <= {p.name for p in (out / "recording").iterdir()}

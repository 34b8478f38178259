"""Sweeps over replays: what flips, what is refused, and that an interrupted sweep ends as one that was not."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.files.output import sha256, write_json
from splatctrl_cli.jobs.compare.judged_runs import read_judged
from splatctrl_cli.jobs.sweep.sweep import SweepRequest, SweepResult, sweep
from tests.jobs.sweep.entry import Told, config_of, document_of
from tests.refused import expect_refusal


def run_of(folder: Path, outcome: str = "passed", words: tuple[str, ...] = (), **told: Any) -> Path:
    """The folder of a replay of a log that says what replays of it come to."""
    for name in ("scene", "audit"):
        (folder / name).mkdir(parents=True)
    (folder / "log").write_text(json.dumps(told))
    (folder / "arm.urdf").write_text("<robot/>")
    inputs = {name: sha256(folder / name) for name in ("log", "arm.urdf")}
    options = ("--scene", folder / "scene", "--urdf", folder / "arm.urdf", *words, "-o", folder / "audit")
    arguments, config = ["replay", folder / "log", *options], config_of(period=told.get("period", 0.01))
    document = document_of(outcome, arguments=[*map(str, arguments)], inputs=inputs, config=config)
    write_json(folder / "audit" / "run.json", document)
    return folder / "audit"


def swept(run: Path, *over: str, out: str = "sweep", **more: Any) -> SweepResult:
    return sweep(SweepRequest(replay=run, over=over, out=run.parent / out, **more), Told(threads=1))


def told(run: Path) -> list[str]:
    """What was run, a line for each."""
    return (run.parent / "told.txt").read_text().splitlines()


def test_a_margin_flips_where_the_log_says_and_both_runs_are_kept_as_folders(tmp_path: Path) -> None:
    run = run_of(tmp_path, failed={"margin": [[0.0437, 9]]})
    flip = swept(run, "margin=0.02:0.1", tolerance=0.01).flips[0]
    assert flip.last.values["margin"] < 0.0437 <= flip.first.values["margin"] <= flip.last.values["margin"] + 0.0008
    assert flip.sentence.startswith("margin: SAFE up to 0.0")
    folders = [read_judged(tmp_path / "sweep" / each.folder) for each in (flip.last, flip.first)]
    assert [each.runs["replay"].outcome for each in folders] == ["passed", "failed"]
    assert len(read_judged(tmp_path / "sweep").runs) == len(flip.tried) == len(told(run))


def test_a_sweep_twice_runs_nothing_and_writes_the_same_bytes(tmp_path: Path) -> None:
    run = run_of(tmp_path, failed={"margin": [[0.0437, 9]]})
    swept(run, "margin=0.02:0.1")
    file = tmp_path / "sweep" / "sweep.json"
    before, runs = file.read_bytes(), told(run)
    assert (file.read_bytes(), told(run), swept(run, "margin=0.02:0.1").num_new) == (before, runs, 0)
    swept(run, "margin=0.02:0.1", out="other", workers=2)
    assert (tmp_path / "other" / "sweep.json").read_bytes() == before


def test_a_killed_sweep_goes_on_to_the_bytes_of_one_that_was_not(tmp_path: Path) -> None:
    run = run_of(tmp_path, failed={"margin": [[0.0437, 9]]}, sleep=0.3)
    words = [sys.executable, "-m", "tests.jobs.sweep.entry", str(run), str(tmp_path / "sweep"), "margin=0.02:0.1"]
    killed = subprocess.Popen(words)
    until = time.monotonic() + 50
    while len([*(tmp_path / "sweep").rglob("*.end")]) < 3 and time.monotonic() < until:
        time.sleep(0.02)
    killed.kill()
    killed.wait()
    assert json.loads((tmp_path / "sweep" / "sweep.json").read_text())["is_done"] is False
    done = len([*(tmp_path / "sweep").rglob("*.end")])
    assert done >= 3
    time.sleep(0.5)  # what it ran ends with it
    before = told(run)
    found = swept(run, "margin=0.02:0.1")
    assert len(told(run)) - len(before) == len(found.flips[0].tried) - done  # what was done is not run again
    swept(run, "margin=0.02:0.1", out="whole")
    assert (tmp_path / "sweep" / "sweep.json").read_bytes() == (tmp_path / "whole" / "sweep.json").read_bytes()


@pytest.mark.parametrize(
    ("spans", "first", "outcome", "words"),
    [
        ({"failed": {"latency": [[0.2, 0.3], [0.8, 9]]}}, pytest.approx(0.2, abs=1 / 64), "failed", "MARGIN BROKEN"),
        (
            {"lacking": {"latency": [[0.4, 0.7]]}, "failed": {"latency": [[0.7, 9]]}},
            pytest.approx(0.4, abs=1 / 64),
            "not evaluable",
            "beyond it also MARGIN BROKEN",
        ),
        ({}, None, "", "latency: no flip between 0 and 1 s: SAFE at all 9 values tried"),
    ],
    ids=["passes again", "not evaluable", "no flip"],
)
def test_a_latency_is_told_at_its_first_flip_with_what_comes_behind_it(
    tmp_path: Path, spans: dict[str, Any], first: Any, outcome: str, words: str
) -> None:
    flip = swept(run_of(tmp_path, **spans), "latency=0:1").flips[0]
    found = (flip.first.values["latency"], flip.first.outcome) if flip.first is not None else (None, "")
    assert found == (first, outcome)
    assert words in flip.sentence and (
        not outcome or f"{outcome.replace('failed', 'margin broken').upper()} at" in flip.sentence
    )
    assert flip.is_monotone == (outcome != "failed")
    assert (flip.start.label, flip.end.label) == ("safe", "margin broken" if spans else "safe")


def test_two_keys_together_flip_before_either_alone(tmp_path: Path) -> None:
    result = swept(run_of(tmp_path, slope={"latency": 1.25, "margin": 12.5}), "latency=0:1", "margin=0:0.1")
    alone = [flip.first.values[name] for flip, name in zip(result.flips, ("latency", "margin"), strict=True)]
    assert alone == [pytest.approx(0.8, abs=0.02), pytest.approx(0.08, abs=0.002)]
    assert result.least.length == pytest.approx(0.8 / 2**0.5, abs=0.04)
    assert (result.least.last.outcome, result.least.first.outcome) == ("passed", "failed")


@pytest.mark.parametrize(
    ("over", "words"),
    [
        ("margin=0.02", "expected KEY=A:B"),
        ("margin=0.02:x", "expected KEY=A:B"),
        ("margin=0.02:nan", "expected KEY=A:B"),
        ("margin=0.05:0.05", "both ends are 0.05"),
        ("margni=0:1", "did you mean margin?"),
        ("control.margni=0:1", "did you mean control.margin?"),
        ("control.solver=0:1", "a setting that is no number"),
        ("splats=100.5:5000", "expected whole numbers"),
        ("margin=0.02:7", "control.margin: expected"),
        ("latency=0:-1", "latency"),
        ("speed=0.1:0.5", "the arm moves as it was recorded"),
        ("obstacle-x=0:0.5", "only of a simulated recording"),
    ],
)
def test_a_range_that_is_none_is_refused_before_any_run(tmp_path: Path, over: str, words: str) -> None:
    expect_refusal(words, swept, run_of(tmp_path), over, error=UsageError)
    assert not (tmp_path / "sweep").exists()


def test_a_run_that_is_not_evaluable_has_nothing_to_flip(tmp_path: Path) -> None:
    run = run_of(tmp_path / "a", outcome="not evaluable")
    expect_refusal("there is no verdict to flip", swept, run, "margin=0.02:0.1", error=NotEvaluableError)
    lacking = run_of(tmp_path / "b", lacking={"latency": [[0, 1]]})
    expect_refusal(r"latency=0\.5: there is no verdict", swept, lacking, "latency=0.5:2", error=NotEvaluableError)


def test_a_recording_that_changed_or_moved_is_refused(tmp_path: Path) -> None:
    run = run_of(tmp_path)
    (tmp_path / "log").write_text("{} ")
    expect_refusal("log: has changed since", swept, run, "margin=0.02:0.1")
    (tmp_path / "log").rename(tmp_path / "elsewhere")
    expect_refusal("log: is not there any more", swept, run, "margin=0.02:0.1")


def test_a_run_that_has_other_settings_when_it_is_made_again_is_refused(tmp_path: Path) -> None:
    expect_refusal(
        r"made again it has other settings: control\.period; its --config",
        swept,
        run_of(tmp_path, period=0.02),
        "margin=0.03:0.1",
    )


def test_a_sweep_with_other_settings_does_not_go_on_in_the_folder(tmp_path: Path) -> None:
    run = run_of(tmp_path)
    swept(run, "latency=0:0.5")
    words = "begun with other settings: over, tolerance"
    expect_refusal(words, swept, run, "latency=0:1", tolerance=0.1, error=UsageError)
    expect_refusal("is no sweep", swept, run, "latency=0:1", out="audit", error=UsageError)


def test_a_value_that_a_command_refuses_is_a_flip_of_its_own(tmp_path: Path) -> None:
    run = run_of(tmp_path, refuses=0.6)
    flip = swept(run, "latency=0:1").flips[0]
    assert (flip.first.label, flip.first.folder) == ("refused", "")
    assert "SAFE up to 0.59375 s, REFUSED at 0.609375" in flip.sentence and "not so" in flip.first.sentence
    expect_refusal(r"latency=0\.7: is refused: replay: not so; begin at", swept, run, "latency=0.7:0", out="other")


def test_a_run_that_ends_for_another_reason_ends_the_sweep_by_name(tmp_path: Path) -> None:
    expect_refusal(
        r"latency=1: replay came to no verdict: not so; see .*\.log",
        swept,
        run_of(tmp_path, refuses=0.6, code=70),
        "latency=0:1",
    )

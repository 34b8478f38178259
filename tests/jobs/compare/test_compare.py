"""What got worse between two runs, two batches, or since a stored baseline."""

import csv
import json
import shutil
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.metrics import Better
from splatctrl_cli.evaluate.verdict import Outcome
from splatctrl_cli.jobs.compare import judged_runs
from splatctrl_cli.jobs.compare.compare import Change, CompareRequest, CompareResult, compare
from splatctrl_cli.jobs.replay.metrics import metric_scales
from splatctrl_cli.jobs.report.report import WriteReportRequest, write_report
from tests.jobs.stage import Runs
from tests.refused import expect_refusal

NEAR = {"criterion": "clearance", "outcome": "failed", "sentence": "hand[9] is 4 mm away", "time_s": 1.5}
NEAR |= {"place": [1.0, 2.0, 3.0], "cause": "near splat 7", "remedy": "stop"}

Edit = Callable[[dict[str, Any]], None]


@pytest.fixture
def audit(older: Path) -> Path:
    return older / "audit"


def changed(source: Path, target: Path, edit: Edit) -> Path:
    """A copy of a run with another run.json."""
    shutil.copytree(source, target)
    document = json.loads((target / "run.json").read_text())
    edit(document)
    (target / "run.json").write_text(json.dumps(document))
    return target


def edited(source: Path, target: Path, **metrics: float | None) -> Path:
    return changed(source, target, lambda document: document["metrics"].update(metrics))


def compared(*runs: Path, **more: Path) -> CompareResult:
    return compare(CompareRequest(runs=runs, **more))


def test_a_run_beside_itself_is_no_regression_nor_are_figures_that_left(audit: Path, tmp_path: Path) -> None:
    result = compared(audit, audit)
    assert (result.verdict.exit_code, result.verdict.label) == (0, "no regression")
    assert (result.figures, result.verdicts, dict(result.differences)) == ((), (), {})
    assert result.metrics["num_figures"] > 25
    before = edited(audit, tmp_path / "before", birrt_success=1, standstill_stopped_s=0.0)
    assert compared(before, audit).figures == ()


def test_a_figure_that_is_worse_by_more_than_its_tolerance_fails_with_recording_state_and_time(
    audit: Path, tmp_path: Path
) -> None:
    result = compared(audit, edited(audit, tmp_path / "new", min_clearance=0.0158571522 - 0.0011))
    (one,), reason = result.figures, result.verdict.decisive[0]
    assert (result.verdict.exit_code, one.metric, one.change) == (1, "min_clearance", Change.WORSE)
    assert (reason.criterion, reason.time_s, reason.who, reason.label) == ("min_clearance", 0.92, "new", "regression")
    assert reason.cause == "state 46, hand[11] near unrepresented voxel at (0.427, 0.389, 0.178)"
    assert reason.threshold == pytest.approx(0.0158571522 - 0.001)


@pytest.mark.parametrize(
    ("metrics", "change", "code"),
    [
        ({"min_clearance": 0.0158571522 - 0.0009}, None, 0),
        ({"min_clearance": 0.03}, Change.BETTER, 0),
        ({"num_in_collision": 1}, Change.WORSE, 1),
        ({"max_map_age_s": 0.5}, Change.WORSE, 1),
        ({"max_map_age_s": 0.2}, Change.BETTER, 0),
        ({"num_states": 50}, Change.OTHER, 0),
        ({"min_self_clearance": None}, Change.WORSE, 1),
    ],
)
def test_direction_and_tolerance_decide(
    audit: Path, tmp_path: Path, metrics: dict[str, float | None], change: Change | None, code: int
) -> None:
    result = compared(audit, edited(audit, tmp_path / "new", **metrics))
    found = [one.change for one in result.figures], result.verdict.exit_code
    assert found == ([] if change is None else [change], code)


def test_what_got_worse_first_is_what_left_its_tolerance_farthest_behind(audit: Path, tmp_path: Path) -> None:
    new = edited(audit, tmp_path / "new", min_clearance=0.01, min_clearance_barrier=-0.05, min_self_clearance=0.2)
    result = compared(audit, new)
    assert [one.metric for one in result.figures] == ["min_clearance_barrier", "min_clearance", "min_self_clearance"]
    assert [reason.criterion for reason in result.verdict.decisive] == ["min_clearance_barrier", "min_clearance"]


@pytest.mark.parametrize(
    ("before", "after", "change", "code"),
    [
        (("passed", "safe"), ("failed", "contact"), Change.WORSE, 1),
        (("passed", "safe"), ("not evaluable", "not evaluable"), Change.WORSE, 1),
        (("failed", "contact"), ("passed", "safe"), Change.BETTER, 0),
        (("failed", "contact"), ("failed", "limits broken"), Change.OTHER, 0),
    ],
)
def test_only_a_verdict_from_green_to_red_is_a_regression(
    audit: Path, tmp_path: Path, before: tuple[str, str], after: tuple[str, str], change: Change, code: int
) -> None:
    def judged(outcome: str, label: str) -> Edit:
        reasons = [] if outcome == "passed" else [NEAR | {"outcome": outcome}]
        return lambda document: document["verdict"].update(outcome=outcome, label=label, reasons=reasons)

    old = changed(audit, tmp_path / "old", judged(*before))
    result = compared(old, changed(audit, tmp_path / "new", judged(*after)))
    (one,) = result.verdicts
    assert (one["before"], one["after"], one["change"]) == (before[1], after[1], change)
    assert any(f"from '{before[1]}' to '{after[1]}'" in reason.sentence for reason in result.verdict.reasons)
    decisive = result.verdict.decisive
    told = [(r.time_s, r.place, r.remedy, "clearance: hand[9] is 4 mm away" in r.sentence) for r in decisive]
    assert (told, result.verdict.exit_code) == ([(1.5, (1.0, 2.0, 3.0), "stop", True)] * code, code)


def test_settings_versions_and_inputs_that_differ_are_named(audit: Path, tmp_path: Path) -> None:
    def edit(document: dict[str, Any]) -> None:
        document["config"]["control"]["margin"] = 0.03
        document["versions"]["numpy"] = "3.0"
        document["inputs"]["robot.urdf"] = "f" * 64

    result = compared(audit, changed(audit, tmp_path / "new", edit))
    assert set(result.differences) == {"control.margin", "numpy", "input robot.urdf"}
    assert (result.differences["control.margin"], result.verdict.exit_code) == (("0.02", "0.03"), 0)


def test_nothing_on_both_sides_is_not_evaluable(audit: Path, tmp_path: Path) -> None:
    old = batch_of(tmp_path / "old", audit, {"a": {}}, lambda node: node.update(state="error", outcome=None))
    result = compared(old, batch_of(tmp_path / "new", audit, {"a": {}}))
    assert (result.verdict.outcome, result.verdict.exit_code) == (Outcome.NOT_EVALUABLE, 5)


def batch_of(
    folder: Path,
    audit: Path,
    recordings: Mapping[str, Mapping[str, float | None]],
    edit: Callable[[dict[str, Any]], None] = lambda node: None,
) -> Path:
    """A batch that replayed each recording, by their metrics."""
    nodes = []
    for name, metrics in recordings.items():
        edited(audit, folder / name / "audit", **metrics)
        node = {"id": f"{name}/audit", "recording": name, "job": "audit", "command": "replay", "variant": {}}
        node |= {"state": "failed", "expect": "passed", "outcome": "failed", "label": "limits broken"}
        nodes.append(node | {"out": f"{name}/audit", "result": f"{name}/audit.json", "cause": ""})
        edit(nodes[-1])
    document = {"format": "splatctrl-batch", "version": 1, "suite": "s", "jobs": ["audit"], "nodes": nodes}
    (folder / "batch.json").write_text(json.dumps(document))
    return folder


def test_a_batch_fails_where_one_recording_got_worse_and_names_it(audit: Path, tmp_path: Path) -> None:
    old = batch_of(tmp_path / "old", audit, {"a": {}, "b": {}})
    result = compared(old, batch_of(tmp_path / "new", audit, {"a": {}, "b": {"min_clearance": 0.001}, "c": {}}))
    found = [(reason.criterion, reason.who, reason.time_s) for reason in result.verdict.decisive]
    assert (found, result.only_after) == ([("min_clearance of b/audit", "b", 0.92)], ("c/audit",))
    assert any("c/audit" in one.sentence for one in result.verdict.shown)


def test_a_node_that_ended_as_expected_and_does_no_more_is_a_regression(audit: Path, tmp_path: Path) -> None:
    sides = {
        "old": {"state": "done", "expect": "failed"},
        "new": {"outcome": "passed", "label": "safe"},
        "gone": {"state": "error", "outcome": None, "cause": "timed out"},
    }
    old, new, gone = (
        batch_of(tmp_path / name, audit, {"a": {}}, lambda node, more=more: node.update(more))
        for name, more in sides.items()
    )
    results = [compared(old, new), compared(new, old), compared(old, gone)]
    assert [result.verdict.exit_code for result in results] == [1, 0, 1]
    assert results[2].verdicts[0]["after"] == "timed out"


def test_a_node_without_run_json_is_read_from_what_it_printed(audit: Path, tmp_path: Path) -> None:
    def printed(node: dict[str, Any]) -> None:
        node.update(command="robot check", job="robot", out="a/robot.yaml", result="a/robot.json")

    sides = []
    for name, deficit in (("old", 0.001), ("new", 0.01)):
        sides.append(batch_of(tmp_path / name, audit, {"a": {}}, printed))
        verdict = {"outcome": "failed", "label": "limits broken", "reasons": [NEAR]}
        envelope = {"exit_code": 1, "verdict": verdict, "metrics": {"max_deficit": deficit}}
        (sides[-1] / "a" / "robot.json").write_text(json.dumps(envelope))
    (one,) = compared(*sides).figures
    assert (one.metric, one.after, one.change) == ("max_deficit", 0.01, Change.WORSE)


@pytest.mark.parametrize(
    ("drops", "change"),
    [
        ([0.004] * 8, Change.WORSE),
        ([-0.004] * 8, Change.BETTER),
        ([0.0005] * 8, Change.SAME),  # certain, and less than the tolerance
        ([0.02] + [0.0] * 7, Change.SAME),  # one recording of eight: the interval has 0
    ],
)
def test_over_eight_recordings_the_interval_of_the_mean_decides(
    audit: Path, tmp_path: Path, drops: list[float], change: Change
) -> None:
    base = 0.05
    old = batch_of(tmp_path / "old", audit, {f"r{i}": {"min_clearance": base} for i in range(len(drops))})
    new = batch_of(tmp_path / "new", audit, {f"r{i}": {"min_clearance": base - d} for i, d in enumerate(drops)})
    result = compared(old, new)
    (one,) = [job for job in result.jobs if job.metric == "min_clearance"]
    assert (one.change, result.verdict.exit_code) == (change, 1 if change is Change.WORSE else 0)
    assert one.harm.low <= one.harm.mean <= one.harm.high
    assert compared(old, new) == result, "seeded"
    assert any("r0/audit" in note.sentence for note in result.verdict.shown) == (drops[0] == 0.02)
    decisive = [(reason.who, "95 % interval 0.004 to 0.004" in reason.sentence) for reason in result.verdict.decisive]
    assert decisive[:1] == [("r0", True)] * (change is Change.WORSE)


def test_a_figure_that_one_recording_lost_is_a_regression_whatever_the_mean(audit: Path, tmp_path: Path) -> None:
    recordings: dict[str, dict[str, float | None]] = {f"r{i}": {} for i in range(9)}
    old = batch_of(tmp_path / "old", audit, recordings)
    result = compared(old, batch_of(tmp_path / "new", audit, recordings | {"r8": {"min_clearance": None}}))
    (reason,) = result.verdict.decisive
    assert (reason.criterion, reason.who) == ("min_clearance of r8/audit", "r8")
    assert [one.harm.num_pairs for one in result.jobs if one.metric == "min_clearance"] == [8]


def test_over_seven_recordings_each_is_judged_alone(audit: Path, tmp_path: Path) -> None:
    old = batch_of(tmp_path / "old", audit, {f"r{i}": {} for i in range(7)})
    new = batch_of(
        tmp_path / "new", audit, {f"r{i}": {"min_clearance": 0.0 if i == 3 else 0.0158571522} for i in range(7)}
    )
    result = compared(old, new)
    assert (result.jobs, result.verdict.exit_code, result.verdict.decisive[0].who) == ((), 1, "r3")


def test_a_baseline_reads_back_as_what_it_was_made_of(audit: Path, tmp_path: Path) -> None:
    file = tmp_path / "base.toml"
    assert compared(audit, update_baseline=file).baseline == file
    text = file.read_text()
    stored = tomllib.loads(text)["run"]["replay"]["metrics"]
    assert stored["min_clearance"] == pytest.approx(0.0158571522, rel=1e-8)
    assert "num_states" not in stored, "it has no direction"
    assert [*stored] == sorted(stored)
    worse = edited(audit, tmp_path / "new", min_clearance=0.01)
    given = ({}, {"update_baseline": file}, {})
    runs = (audit, worse, worse)
    codes = [compared(run, against=file, **more).verdict.exit_code for run, more in zip(runs, given, strict=True)]
    assert codes == [0, 1, 0]
    assert set(text.splitlines()) ^ set(file.read_text().splitlines()) == {
        'recording = "audit"',
        'recording = "new"',
        "min_clearance = 0.0158571522",
        "min_clearance = 0.01",
    }


@pytest.mark.parametrize("is_stored", [False, True])
def test_a_shard_of_a_batch_is_compared_and_the_others_are_named(
    audit: Path, tmp_path: Path, is_stored: bool
) -> None:
    """A recording that was taken out of the suite is one, too."""
    old = batch_of(tmp_path / "old", audit, {name: {} for name in "abc"})
    new = batch_of(tmp_path / "new", audit, {"b": {"num_in_collision": 3}, "d": {}})
    same = batch_of(tmp_path / "same", audit, {"b": {}})
    compared(old, update_baseline=tmp_path / "base.toml")
    assert compared(old, against=tmp_path / "base.toml").metrics["num_runs"] == 3
    before = tmp_path / "base.toml" if is_stored else old

    def since(folder: Path) -> CompareResult:
        return compared(folder, against=before) if is_stored else compared(before, folder)

    assert since(same).verdict.sentence.endswith(f"; not compared, only in {before}: a/audit, c/audit")
    result = since(new)
    assert (result.only_before, result.only_after) == (("a/audit", "c/audit"), ("d/audit",))
    assert result.verdict.decisive[0].criterion == "num_in_collision of b/audit"
    assert f"only in {before}: a/audit, c/audit" in [note.sentence for note in result.verdict.shown]
    page = tmp_path / "page.html"
    write_report(WriteReportRequest(path=same, out=page, against=before))
    assert "a/audit, c/audit" in page.read_text()


def test_what_cannot_be_compared_is_refused_by_name(audit: Path, tmp_path: Path) -> None:
    partial = shutil.copytree(audit, tmp_path / "a.partial")
    one, two = batch_of(tmp_path / "1", audit, {"a": {}}), batch_of(tmp_path / "2", audit, {"b": {}})
    other = batch_of(tmp_path / "3", audit, {"a": {}}, lambda node: node.update(command="score"))
    for words, *runs in (
        ("scene: expected a run of replay, as .*audit is, got one of reconstruct", audit, audit.parent / "scene"),
        (r"tabletop\.capture: a run of ingest, which judges nothing", audit, audit.parent / "tabletop.capture"),
        ("missing: expected the output folder .* no such folder", audit, audit.parent / "missing"),
        (r"a\.partial: is still being written", audit, partial),
        ("a: is still being written", audit, tmp_path / "a"),
        (r"1: expected some of the runs of .*2 \(b/audit\), got a/audit", two, one),
        ("expected a run like .*audit, got a batch", audit, one),
        ("a/audit: expected a run of replay, got one of score", one, other),
    ):
        expect_refusal(words, compared, *runs)
    expect_refusal("expected two runs, or one and --against, got 1", compared, audit, error=UsageError)
    expect_refusal("got 2", compared, audit, audit, error=UsageError, against=tmp_path / "base.toml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("version = 1", "version = 2", "a baseline of version 2, this splatctrl reads 1; update splatctrl"),
        ("min_clearance =", "min_clearence =", "replay: no figures of replay: min_clearence; write it anew"),
        ("min_clearance =", "min_clearance_true =", "has figures that this run has not: min_clearance_true"),
        ('format = "splatctrl-baseline"', 'format = "x"', "expected a baseline, got another TOML file"),
        ("max_residual = ", "max_residual = [", "expected a baseline in TOML"),
        ("is_green =", "is_grun =", "damaged"),
    ],
)
def test_a_baseline_of_other_figures_or_a_newer_version_is_refused(
    audit: Path, tmp_path: Path, old: str, new: str, words: str
) -> None:
    file = tmp_path / "base.toml"
    without = changed(audit, tmp_path / "audit", lambda document: document["metrics"].pop("min_clearance_true"))
    compared(without, update_baseline=file)
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    expect_refusal(words, compared, without, against=file)


def test_another_file_is_never_replaced_by_a_baseline(audit: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.toml").write_text("mine = 1\n")
    file = tmp_path / "notes.toml"
    expect_refusal("exists, and is no baseline", compared, audit, error=UsageError, update_baseline=file)
    assert (tmp_path / "notes.toml").read_text() == "mine = 1\n"


def test_every_figure_of_a_replay_is_declared_with_a_direction_or_without_one() -> None:
    declared = judged_runs.scales()["replay"]
    modes, fields = ("audit", "open-loop", "closed-loop"), ("exact", "barrier", "certified")
    assert all({*metric_scales(mode, fields, has_truth=True, has_twists=True)} <= {*declared} for mode in modes)
    better = [declared[name].better for name in ("min_clearance", "num_in_collision")]
    assert better == [Better.HIGHER, Better.LOWER]
    assert all(scale.absolute >= 0 and scale.relative >= 0 for scale in declared.values())


def test_a_margin_that_was_taken_away_is_found_with_the_state_where_it_shows(run: Runs) -> None:
    before, after = run("before", "closed-loop"), run("after", "closed-loop", "--set", "control.margin=0.002")
    result = compared(before, after)
    assert (result.verdict.exit_code, result.differences["control.margin"]) == (1, ("0.02", "0.002"))
    worst = next(one for one in result.figures if one.metric == "min_clearance")
    assert worst.change is Change.WORSE and worst.where is not None and "ball" not in worst.where.sphere
    with (after / "steps.csv").open() as stream:
        least = min(csv.DictReader(stream), key=lambda row: float(row["clearance_exact"]))
    assert worst.where.time_s == pytest.approx(float(least["time_s"]))
    back = compared(after, before)
    assert not [one for one in back.figures if one.metric == "min_clearance" and one.change is Change.WORSE]

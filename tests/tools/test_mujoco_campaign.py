"""The campaign on recordings with exact truth: its comparison, table and report. A fake recorder, no MuJoCo."""

import csv
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.robot.shapes import written
from tools.mujoco.campaign import (
    BATCH,
    Machinery,
    Request,
    campaign,
    choose_indices,
    hash_sources,
    judge,
    write_suite,
)
from tools.mujoco.judge import EPOCH_NS, Node, read_answer, read_motion, read_recording, read_truth
from tools.mujoco.report import choose_worst, has_grave_error, report, write_worst
from tools.mujoco.table import Row, merge_rows, read_rows, write_rows

CLEAR = Row(
    seed=1, index=0, mode="audit", family="still", robot="panda", depth="ideal", num_cams=3, log="mcap",
    outcome="safe", label="safe", said_mm=58.0, true_mm=60.0, collision_mm=59.0, median_mm=3.0, p95_mm=9.0,
    over_share=0.0, over_mm=1.0, num_states=100, worst_s=1.0, worst_link="link5", worst_splat="object splat",
    worst_true_mm=61.0, true_link="link5", true_object="near", seconds=9.0,
)  # fmt: skip
RED = replace(CLEAR, outcome="contact", label="contact", said_mm=-60.0, reason="clearance: link5[0] is 60 mm deep")
UNSURE = replace(CLEAR, outcome="not evaluable", label="not evaluable", reason="known space: unseen")
REFUSED = replace(
    CLEAR, mode="driven", outcome="refused", label="", reason="start: expected a free posture, got deep"
)


def line_of(rows: list[Row], start: str) -> list[str]:
    """The cells of the report's first line that begins so, without that beginning."""
    lines = [line.strip() for line in report(rows)]
    return next(re.split(r"\s{2,}", line.removeprefix(start).strip()) for line in lines if line.startswith(start))


@pytest.mark.parametrize(
    ("start", "right", "wrong"),
    [
        ("false green in contact (true < 0 mm)", replace(RED, true_mm=-1.0), replace(CLEAR, true_mm=-1.0)),
        ("false green in the margin (true < 15 mm)", replace(RED, true_mm=14.0), replace(CLEAR, true_mm=14.0)),
        ("false red (true > 35 mm)", CLEAR, RED),
        ("false red (true > 35 mm)", replace(RED, label="goal not reached"), replace(RED, label="margin broken")),
        ("red for a false reason (true there > 35 mm)", replace(RED, true_mm=-1.0, worst_true_mm=-1.0),
         replace(RED, true_mm=-1.0)),
        ("useless caution (true >= 40 mm)", CLEAR, UNSURE),
        ("useless caution (true >= 40 mm)", CLEAR, REFUSED),
        ("closed loop that refuses to start", replace(CLEAR, mode="driven"), REFUSED),
        ("closed loop called safe that truly touches", replace(CLEAR, mode="driven"),
         replace(CLEAR, mode="driven", true_mm=-0.1)),
    ],
)  # fmt: skip
def test_the_report_counts_an_error_and_only_that(start: str, right: Row, wrong: Row) -> None:
    assert line_of([right], start)[1:] in (["0", "0.0 %"], ["0", "-"])
    assert line_of([right, wrong], start)[1] == "1"


@pytest.mark.parametrize(
    ("start", "row", "bound"),
    [
        ("false green in the margin (true < 15 mm)", CLEAR, 15.0),
        ("false red (true > 35 mm)", RED, 35.0),
        ("useless caution (true >= 40 mm)", replace(UNSURE, num_cams=2), 40.0),
        ("useless caution (true >= 40 mm)", UNSURE, 39.9),
    ],
)
def test_an_error_at_its_bound_is_none(start: str, row: Row, bound: float) -> None:
    at_bound = replace(row, true_mm=bound)
    assert line_of([at_bound], start)[:2] == ["0", "0"]
    assert not (at_bound.is_false_green or at_bound.is_false_red or at_bound.is_useless_caution)


@pytest.mark.parametrize(
    ("rows", "is_grave"),
    [
        ([CLEAR, replace(CLEAR, true_mm=-0.1)], True),
        ([replace(CLEAR, true_mm=0.1), replace(RED, true_mm=-5.0)], False),
    ],
)
def test_only_a_green_in_true_contact_is_grave(rows: list[Row], is_grave: bool) -> None:
    assert has_grave_error(rows) == is_grave


def test_families_robots_and_depths_are_counted_by_outcome_and_truth() -> None:
    rows = [CLEAR, replace(RED, index=1, true_mm=-2.0), replace(UNSURE, index=2, true_mm=10.0, family="arrive")]
    rows += [Row(seed=1, index=3, mode="record", reason="no mesh", family="arrive")]
    counts = {
        "still   contact": "1 0 0 1 0 0 0",
        "still   clear": "1 1 0 0 0 0 0",
        "arrive  margin": "1 0 0 0 1 0 0",
        "arrive  unknown": "1 0 0 0 0 0 1",
        "panda  clear": "1 1 0 0 0 0 0",
        "ideal  clear": "1 1 0 0 0 0 0",
    }
    assert {start: " ".join(line_of(rows, start)) for start in counts} == counts
    assert any("no mesh" in line for line in report(rows))
    assert "| still | clear | 1 | 1 | 0 | 0 | 0 | 0 | 0 |" in report(rows, markdown=True)


def test_errors_of_audits_are_by_depth_and_over_estimates_by_state() -> None:
    rough = replace(CLEAR, index=1, depth="real", median_mm=7.0, p95_mm=20.0, over_share=0.5, num_states=300)
    rows = [CLEAR, rough, replace(rough, index=2, mode="driven", median_mm=99.0)]
    assert line_of(rows, "real   1       300") == ["7.0", "7.0", "20.0", "20.0", "50.0 %", "0", "0"]
    assert line_of(rows, "all    2       400") == ["5.0", "7.0", "14.5", "20.0", "37.5 %", "0", "0"]


def test_causes_are_weighed_and_a_map_without_a_true_surface_there_is_named() -> None:
    near = replace(RED, index=1, said_mm=15.0, label="margin broken", outcome="failed")
    other = replace(RED, index=2, reason="self-clearance: link1 overlaps")
    audit = replace(REFUSED, mode="audit", reason="no depth", index=4)
    rows = [RED, replace(RED, index=3), near, other, UNSURE, REFUSED, audit]
    shares = {
        "clearance: object splat, more than 50 mm from": ["a true surface", "2", "50 %"],
        "clearance: object splat, perhaps at": ["a true surface", "1", "25 %"],
        "self-clearance": ["1", "25 %"],
        "audit: not evaluable: known space": ["1", "33 %"],
        "driven: refused: start: expected a free posture": ["1", "33 %"],
        "start: expected a free posture": ["1", "100 %"],
    }
    assert {start: line_of(rows, start) for start in shares} == shares


def test_the_worst_are_the_largest_false_reds_then_the_largest_over_estimates(tmp_path: Path) -> None:
    reds = [replace(RED, index=k, said_mm=-10.0 * k) for k in range(8)]
    overs = [replace(CLEAR, index=20 + k, over_mm=float(k)) for k in range(8)]
    assert [row.index for row in choose_worst([*reds, *overs])] == [7, 6, 5, 4, 3, 27, 26, 25, 24, 23]
    folder = tmp_path / BATCH / "1-7" / "audit"
    folder.mkdir(parents=True)
    (folder / "worst_1.png").write_bytes(b"picture")
    write_worst(tmp_path, [*reds, *overs], tmp_path / BATCH)
    for line in ("1. false red by 131 mm: 1-7 audit", "6. over by 7 mm: 1-27 audit"):
        assert line in (tmp_path / "worst" / "worst.md").read_text()
    assert (tmp_path / "worst" / "1_1-7_audit_worst_1.png").read_bytes() == b"picture"


def test_rows_come_back_from_the_table_and_replace_those_of_their_recording(tmp_path: Path) -> None:
    crash = Row(seed=1, index=5, mode="record", reason="a, b")
    write_rows(tmp_path / "t.csv", merge_rows([], [crash, CLEAR]))
    assert repr(read_rows(tmp_path / "t.csv")) == repr([CLEAR, crash])
    again = [replace(CLEAR, index=5, mode=mode) for mode in ("audit", "driven")]
    assert merge_rows([CLEAR, crash], again) == [CLEAR, *again]


def test_reports_of_tables_alone_count_a_recording_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_rows(tmp_path / "a.csv", [CLEAR])
    write_rows(tmp_path / "b.csv", [replace(CLEAR, true_mm=-1.0), replace(CLEAR, index=1)])
    assert campaign(["--report", str(tmp_path / "a.csv")]) == 0
    assert campaign(["--report", str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]) == 1
    assert "1-0 audit (still, panda, ideal): SAFE" in capsys.readouterr().out


def test_shards_have_every_recording_once() -> None:
    assert [[*choose_indices(10, 7, (part, 3))] for part in (1, 2, 3)] == [[10, 13, 16], [11, 14], [12, 15]]


def test_a_shard_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        campaign(["--shard", "3/2"])
    assert "expected K/M with K from 1 to M, got '3/2'" in capsys.readouterr().err


VERDICT = {
    "outcome": "failed",
    "label": "contact",
    "reasons": [
        {"criterion": "calibration", "outcome": "not evaluable", "sentence": "8 mm behind"},
        {"criterion": "clearance", "outcome": "failed", "sentence": "link5[5] is 85.5 mm deep"},
    ],
}


@pytest.mark.parametrize(
    ("exit_code", "cause", "document", "expected"),
    [
        (1, "", {"verdict": VERDICT}, ("contact", "clearance: link5[5] is 85.5 mm deep")),
        (1, "", {"verdict": VERDICT | {"label": "margin broken"}}, ("failed", "clearance: link5[5] is 85.5 mm deep")),
        (5, "", {"verdict": VERDICT | {"outcome": "not evaluable", "label": "not evaluable"}},
         ("not evaluable", "calibration: 8 mm behind")),
        (0, "", {"verdict": {"outcome": "passed", "label": "safe", "reasons": []}}, ("safe", "")),
        (5, "", {"error": {"message": "start: deep"}}, ("refused", "start: deep")),
        (70, "", {"error": {"message": "bug"}}, ("crash", "bug")),
        (2, "", {}, ("crash", "last line")),
        (None, "timeout after 30 min", {"verdict": VERDICT}, ("crash", "timeout after 30 min")),
    ],
)  # fmt: skip
def test_an_answer_is_a_verdict_a_refusal_or_a_crash(
    tmp_path: Path, exit_code: int | None, cause: str, document: dict[str, Any], expected: tuple[str, str]
) -> None:
    node = Node(state="failed", exit_code=exit_code, cause=cause, sentence="last line", seconds=1.0)
    answer = read_answer(node, written(tmp_path, json.dumps(document), "audit.json"))
    assert (answer.outcome, answer.reason) == expected


# Below: whole campaigns. The truth of recording k: 100 mm falling to 50 - 30 k at 1 s.

JOINTS = ("joint1", "joint2")


def record(seed: int, index: int, folder: Path) -> None:
    """A recorder without a picture; the third recording fails, the fourth ends its process."""
    if index == 2:
        raise ValueError("no pose is free")
    if index == 3:
        os._exit(9)
    with (folder.parent.parent / "made.txt").open("a") as stream:
        stream.write(f"{index}\n")
    paths = {"log": "log.mcap", "urdf": "/robots/arm.urdf"}
    what = {"family": "still", "seed": seed, "index": index, "robot": "arm", "depth": "ideal", "cams": list("abc")}
    (folder / "truth.json").write_text(json.dumps({**paths, **what, "joints": JOINTS}))
    (folder / "log.mcap").touch()
    t = np.linspace(0, 1, 101)
    visual = 0.1 - (0.05 + 0.03 * index) * t
    names = {"link": np.full(101, "link2"), "object": np.where(t < 0.5, "table", "box")}
    np.savez(folder / "truth.npz", t=t, visual=visual, collision=visual - 0.002, **names)


def drive(folder: Path, t: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The truth of a driven motion: what its first joint says; the collision surface 1 mm nearer."""
    return q[:, 0], q[:, 0] - 0.001


def fit(urdf: Path, spheres: Path) -> str:
    """Spheres that are made once."""
    spheres.parent.mkdir()
    spheres.write_text(urdf.name)
    return ""


@dataclass
class FakeBatch:
    """Answers every recording: audits and closed loops by the same states; no closed loop or no scene on request."""

    is_driven: bool = True
    has_scene: bool = True
    suites: list[str] = field(default_factory=list)

    def __call__(self, suite: Path, workers: int) -> Mapping[str, Node]:
        self.suites.append(suite.read_text())
        nodes = {}
        for folder in sorted((suite.parent / "recordings").iterdir()):
            if not (folder / "truth.json").is_file():
                continue
            place = suite.parent / BATCH / folder.name
            for mode in ("audit", "driven"):
                (place / mode).mkdir(parents=True, exist_ok=True)
                write_steps(place / mode / "steps.csv")
                (place / f"{mode}.json").write_text(json.dumps({"verdict": VERDICT}))
            (place / "scene.json").write_text(json.dumps({"error": {"message": "no depth"}}))
            node = Node(state="failed", exit_code=1, cause="", sentence="", seconds=2.0)
            nodes |= {f"{folder.name}/{job}": node for job in ("scene", "audit", "driven")}
            if not self.is_driven:
                (place / "driven.json").write_text(json.dumps({"error": {"message": "start: deep"}}))
                nodes[f"{folder.name}/driven"] = replace(node, exit_code=5)
            if not self.has_scene:
                nodes[f"{folder.name}/scene"] = replace(node, exit_code=4)
                skipped = replace(node, state="skipped", exit_code=None, cause="needs the scene")
                nodes |= {f"{folder.name}/{mode}": skipped for mode in ("audit", "driven")}
        return nodes


def write_steps(path: Path) -> None:
    """States at 0, 0.25, ... 1 s: the truth of recording 0 and 50 mm, none, then the truth and 10 mm."""
    with path.open("w", newline="") as stream:
        names = ["stamp_ns", "q_joint2", "q_joint1", "q_finger", "clearance_exact", "nearest_exact", "obstacle"]
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        for k, said in enumerate((0.15, "", 0.085, 0.0725, 0.06)):
            stamp = EPOCH_NS + k * 250_000_000
            values = [stamp, 7.0, 0.031 - 0.005 * k, 0.0, said, f"link{k}[3]", f"object splat {k} at (0, 0, 0)"]
            writer.writerow(dict(zip(names, values, strict=True)))


def request(folder: Path, *indices: int) -> Request:
    return Request(seed=4, indices=indices, out=folder, jobs=1)


def machinery(batch: FakeBatch) -> Machinery:
    return Machinery(record=record, clearances=drive, fit_spheres=fit, run_batch=batch)


def test_an_audit_is_compared_at_its_own_stamps_and_a_closed_loop_with_its_own_motion(tmp_path: Path) -> None:
    audit, driven = judge(request(tmp_path, 0), machinery(FakeBatch()))
    assert (audit.name, audit.mode, audit.family, audit.num_cams, audit.log) == ("4-0", "audit", "still", 3, "mcap")
    assert (audit.outcome, audit.label, audit.seconds) == ("contact", "contact", 2.0)
    assert [audit.said_mm, audit.true_mm, audit.collision_mm] == pytest.approx([60.0, 50.0, 48.0])
    assert [audit.median_mm, audit.p95_mm, audit.over_share, audit.over_mm] == pytest.approx([10, 44, 1, 10])
    assert (audit.num_states, audit.num_said_below, audit.num_true_below) == (5, 0, 0)
    assert (audit.worst_s, audit.worst_link, audit.worst_splat) == (1.0, "link4", "object splat")
    assert (audit.worst_true_mm, audit.true_link, audit.true_object) == (pytest.approx(50.0), "link2", "box")
    assert [driven.true_mm, driven.collision_mm, driven.num_true_below] == pytest.approx([11.0, 10.0, 2])


def test_a_replay_that_refuses_has_its_reason_or_that_of_the_scene(tmp_path: Path) -> None:
    _, driven = judge(request(tmp_path / "a", 0), machinery(FakeBatch(is_driven=False)))
    assert (driven.outcome, driven.reason, driven.true_mm) == ("refused", "start: deep", pytest.approx(100.0))
    rows = judge(request(tmp_path / "b", 0), machinery(FakeBatch(has_scene=False)))
    assert [(row.outcome, row.reason) for row in rows] == [("refused", "reconstruct: no depth")] * 2


def test_a_second_call_makes_no_recording_anew_until_the_recorder_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = FakeBatch()
    first = judge(request(tmp_path, 0, 1), machinery(batch))
    assert judge(request(tmp_path, 0, 1), machinery(batch)) == first
    assert (tmp_path / "made.txt").read_text() == "0\n1\n"
    assert batch.suites[0] == batch.suites[1]
    monkeypatch.setattr("tools.mujoco.campaign.hash_sources", lambda folder: "other")
    judge(request(tmp_path, 0), machinery(batch))
    assert (tmp_path / "made.txt").read_text() == "0\n1\n0\n"


def test_recordings_that_fail_are_rows_and_the_others_are_judged(tmp_path: Path) -> None:
    rows = judge(request(tmp_path, 0, 2, 3), machinery(FakeBatch()))
    assert [(row.index, row.mode, row.outcome) for row in rows] == [
        (0, "audit", "contact"), (0, "driven", "contact"), (2, "record", "crash"), (3, "record", "crash"),
    ]  # fmt: skip
    assert [row.reason for row in rows[2:]] == ["ValueError: no pose is free", "the recorder's process died"]


def test_spheres_are_fitted_once_a_robot_and_without_them_a_recording_is_a_row(tmp_path: Path) -> None:
    batch = FakeBatch()
    judge(request(tmp_path, 0, 1), machinery(batch))
    assert (tmp_path / "spheres" / "arm.yaml").read_text() == "arm.urdf"
    assert batch.suites[0].count(str(tmp_path / "spheres" / "arm.yaml")) == 6
    (tmp_path / "spheres" / "arm.yaml").unlink()
    refusing = replace(machinery(batch), fit_spheres=lambda urdf, spheres: "no mesh")
    assert [(row.mode, row.reason) for row in judge(request(tmp_path, 0), refusing)] == [("record", "no mesh")]


def test_only_sources_that_make_a_recording_are_hashed(tmp_path: Path) -> None:
    for name in ("scene.py", "report.py"):
        (tmp_path / name).write_text("x = 1\n")
    before = hash_sources(tmp_path)
    (tmp_path / "report.py").write_text("x = 2\n")
    assert hash_sources(tmp_path) == before
    (tmp_path / "scene.py").write_text("x = 2\n")
    assert hash_sources(tmp_path) != before


def test_the_truth_of_the_recordings_at_hand_is_read_and_named_in_a_suite(real_data: Path, tmp_path: Path) -> None:
    folder = real_data / "mujoco"
    cases = sorted(path.parent for path in folder.glob("*/truth.json"))
    if not cases:
        pytest.skip(f"no recordings of MuJoCo in {folder}")
    for case in cases:
        document = json.loads((case / "truth.json").read_text())
        spheres = folder / f"example-robot-data/robots/{document['robot']}_spheres.yaml"
        paths = {"log": str(case / "log.mcap"), "urdf": str(folder / document["urdf"]), "spheres": str(spheres)}
        text = json.dumps({**document, **paths, "family": "shared", "index": 0})
        own = written(tmp_path / case.name, text, "truth.json").parent
        (own / "truth.npz").symlink_to(case / "truth.npz")
        recording = read_recording(own, own)
        truth = read_truth(own, None)
        assert truth.visual.min() == pytest.approx(1e3 * document["min_visual"])
        assert truth.collision.min() == pytest.approx(1e3 * document["min_collision"])
        worst = read_truth(own, np.array([document["at"]]))
        assert worst.visual[0] == pytest.approx(1e3 * document["min_visual"], abs=0.01)
        assert (worst.links, worst.objects) == ([document["link"]], [document["object"]])
        assert all(path.exists() for path in (recording.log, recording.urdf, recording.spheres))
        assert str(spheres) in write_suite([recording], num_threads=1)


def test_an_empty_clearance_is_none_and_joints_are_by_name(tmp_path: Path) -> None:
    write_steps(tmp_path / "steps.csv")
    motion = read_motion(tmp_path / "steps.csv", JOINTS)
    assert np.isnan(motion.said).tolist() == [False, True, False, False, False]
    assert motion.q[0].tolist() == [0.031, 7.0]

"""The hunt's table; and, once each, runs that were false greens and the runs nearest to the border."""

import re
from pathlib import Path

import pytest

from tools.hunt.body import Body, draw_body
from tools.hunt.clearance import TOLERANCE, TrueArm, least_clearance
from tools.hunt.observability import Observable
from tools.hunt.table import Row, border_of, merge_rows, read_rows, report, upper_limit
from tools.hunt.trial import draw, family_of, run, true_robot
from tools.hunt.world import DURATION_S, at_s

STEREO_SEED = 211
BORDER = re.findall(r"^(\d+)/(\d+)", Path(__file__).with_name("border.txt").read_text(), flags=re.MULTILINE)


def row(**changes: object) -> Row:
    values = {
        "seed": 0, "index": 1, "family": "benign", "kind": "none", "strength": 0.5, "mode": "audit",
        "outcome": "safe", "clearance": 0.1, "observable": True, "rule": "seen before", "reason": "",
    }  # fmt: skip
    return Row(**(values | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("clearance", "outcome", "is_false_green"),
    [
        (-0.001, "safe", True),
        (0.014, "safe", True),
        (0.016, "safe", False),
        (-0.001, "contact", False),
        (-0.001, "not evaluable", False),
    ],
)
def test_a_false_green_is_safe_in_contact_or_five_millimetres_under_the_margin(
    clearance: float, outcome: str, is_false_green: bool
) -> None:
    assert row(clearance=clearance, outcome=outcome).is_false_green == is_false_green


def test_rows_come_back_from_the_table_as_they_were(tmp_path: Path) -> None:
    rows = [row(), row(index=2, outcome="contact", reason="a, b", clearance=-0.0125, observable=False)]
    for more in (rows[:1], rows[1:], rows):
        merge_rows(tmp_path / "t.csv", more)
    assert read_rows(tmp_path / "t.csv") == rows


def test_rows_of_a_table_from_before_stereo_depth_still_load(tmp_path: Path) -> None:
    head = "seed,index,family,kind,strength,mode,outcome,clearance,observable,rule,reason"
    (tmp_path / "t.csv").write_text(f"{head}\n0,1,benign,none,0.5,audit,safe,0.1,True,seen before,\n")
    assert read_rows(tmp_path / "t.csv") == [row()]
    slim = row(index=2, robot="slim cable", spread=0.05, fattening=2.5)
    merge_rows(tmp_path / "t.csv", [slim])
    assert read_rows(tmp_path / "t.csv") == [row(), slim]
    assert "slim cable" in "\n".join(report([row(), slim]))


def test_the_upper_limit_of_no_failure_in_two_thousand_is_fifteen_in_ten_thousand() -> None:
    assert (upper_limit(0, 2000), upper_limit(5, 5)) == (pytest.approx(0.0015, abs=1e-5), 1.0)


def test_the_report_names_false_greens_and_counts_the_benign() -> None:
    rows = [row(), row(index=2, clearance=-0.01), row(index=3, outcome="contact", reason="clearance 0.001 m")]
    for words in ("false green, contact, observable: 1 of 3 runs", "0/2 benign", "1 of 2 safe (50.0 %)"):
        assert words in "\n".join(report(rows))


def test_the_report_says_what_each_limit_alone_catches_and_costs() -> None:
    stopped = [row(index=i, outcome="not evaluable", only="unseen", clearance=c) for i, c in enumerate((-0.01, 0.1))]
    (line,) = (line for line in report([row(), *stopped]) if line.startswith("unseen "))
    assert line.split() == ["unseen", "1", "0", "1"]


def test_the_border_is_safe_by_least_and_broken_by_least() -> None:
    safe = [row(index=i, clearance=0.02 + 0.01 * i) for i in range(30)]
    broken = [row(index=100 + i, outcome="failed", clearance=0.014 - 0.001 * i) for i in range(30)]
    chosen = border_of([*safe, *broken, row(index=200, clearance=0.0), row(index=201, observable=False)])
    assert [r.index for r in chosen] == [*range(12), *range(100, 112)]


FOUND = {  # runs that were once called safe, by what was wrong with that
    "an-object-in-space-that-no-camera-saw": (0, 57),
    "a-map-of-82-splats": (0, 76),
    "a-rod-whose-splats-were-labelled-robot": (0, 2),
    "an-arm-that-comes-to-a-side-that-two-long-lenses-never-saw": (7, 57),
    "a-thing-that-returns-no-depth": (0, 21),
    "a-thing-that-came-before-the-last-frame-set": (0, 575),
    "a-hidden-side-of-a-thing-that-a-lone-camera-saw": (31, 202),
    "a-thing-that-came-while-no-camera-gave-depth": (47, 280),
    "edges-behind-which-the-arm-passes": (0, 936),
    "a-dark-ball-of-which-patches-alone-return-depth": (89, 36),
    "depth-of-its-own-time-that-a-late-map-did-not-have": (101, 219),
    "the-unseen-side-of-a-box-that-the-arm-touches-from-the-start": (103, 320),
    "the-side-of-a-box-that-a-lone-camera-never-saw": (101, 309),
    "a-thing-in-the-hand-that-a-wide-tolerance-took-for-the-robot": (101, 359),
    "a-thing-that-came-and-went-between-two-maps": (109, 283),
    "a-voxel-without-an-answer-whose-face-is-nearer-than-its-centre": (47, 6),
    "a-shiny-cylinder-that-every-camera-measures-behind-its-place": (505, 45),
}


@pytest.mark.parametrize(("seed", "index"), [*FOUND.values(), *BORDER], ids=[*FOUND, *map("-".join, BORDER)])
def test_what_was_once_a_false_green_and_what_is_near_the_border_is_none(
    monkeypatch: pytest.MonkeyPatch, seed: int | str, index: int | str
) -> None:
    """Every run counts as observable, whatever its images show."""
    monkeypatch.setattr("tools.hunt.trial._evidence", lambda *_: Observable(holds=True, rule=""))
    found = run(int(seed), int(index))
    assert not found.is_false_green, found


def test_the_truth_of_a_run_with_stereo_depth_is_that_of_what_is_seen(tmp_path: Path) -> None:
    model = true_robot(tmp_path)
    chosen = (index for index in range(60) if draw_body(STEREO_SEED, index, family_of(STEREO_SEED, index)).parts)
    trial = next(t for t in (draw(STEREO_SEED, index, model) for index in chosen) if t.mode == "audit")
    found, world = run(STEREO_SEED, trial.index), trial.world
    arms = (TrueArm(model, world.tool, body) for body in (world.body, Body()))
    seen, collides = (
        least_clearance(arm, world.primitives, world.positions, at_s(0), at_s(DURATION_S))[0] for arm in arms
    )
    assert (found.robot, found.clearance) == (f"slim {world.body.parts[0]}", pytest.approx(seen, abs=TOLERANCE))
    assert found.spread > 0 and seen != pytest.approx(collides, abs=1e-3)

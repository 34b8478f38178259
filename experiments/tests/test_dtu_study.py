"""The study of IV-A: budgets beside 3D Gaussian splatting, on the scans of a tree or on a simulated one."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from experiments import dtu
from experiments.dtu import GIVEN, METHODS, SIMULATED, Fit, notes, problems, sections, trials_of
from experiments.problems import ProblemRequest
from splatctrl_cli.config import Config
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import Stopwatch
from tests.refused import expect_refusal

SAMPLE = Path(__file__).parents[2] / "sample_data" / "dtu"
GOOD = Fit(environment=GIVEN, number=24, method="5k", psnr=24.0, psnr_seen=25.0, ssim=0.9, depth=0.003, splats=4900)


def asked(problem: str, root: Path | None, methods: Sequence[str]) -> ProblemRequest:
    return ProblemRequest(problem=problem, out=Path(), problems=root, methods=tuple(methods), threads=1)


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, count in (("ITERATIONS", 8), ("FIRST", 4), ("BUDGETS", {"5k": 300, "10k": 600, "20k": 900})):
        monkeypatch.setattr(dtu, name, count)


def tree(folder: Path, *scans: str) -> Path:
    for scan in scans:
        (folder / "Rectified" / scan).mkdir(parents=True)
    return folder


@pytest.mark.parametrize(
    ("scans", "expected"),
    [
        (("scan1_train", "scan24_train", "scan37_train"), [24, 37]),  # those of the published means
        (("scan1_train", "scan2_train"), [1, 2]),  # a tree that has none of them
    ],
)
def test_the_scans_of_a_tree_are_its_problems(tmp_path: Path, scans: tuple[str, ...], expected: list[int]) -> None:
    assert problems(None, tree(tmp_path, *scans)) == [(GIVEN, n) for n in expected]
    assert problems(1, tree(tmp_path)) == [(GIVEN, expected[0])]


def test_without_a_tree_the_simulated_scan_is_fitted_by_several_seeds(tmp_path: Path) -> None:
    assert problems(2, None) == [(SIMULATED, 0), (SIMULATED, 1)]
    expect_refusal("expected a DTU folder", problems, None, tmp_path)


@pytest.mark.usefixtures("fast")
def test_a_scan_of_a_tree_goes_through_budgets_and_baseline() -> None:
    rows = list(trials_of(asked("dtu-0001", SAMPLE, METHODS), Config(), Stopwatch()))
    assert [row.method for row in rows] == list(METHODS)
    assert [row.splats for row in rows[:2]] < [row.splats for row in rows[1:3]]
    assert all(row.success and row.psnr is not None and row.psnr > 5 for row in rows)
    expect_refusal("has no scan 7", list, trials_of(asked("dtu-0007", SAMPLE, METHODS), Config(), Stopwatch()))


def test_a_scan_of_a_tree_is_not_the_simulated_one() -> None:
    expect_refusal("is of a DTU tree", list, trials_of(asked("dtu-0024", None, METHODS), Config(), Stopwatch()))


@pytest.mark.usefixtures("fast")
def test_a_method_that_fails_is_a_row_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> Fit:
        raise InputError("no depth")

    monkeypatch.setattr(dtu, "_fit", refused)
    rows = list(trials_of(asked("dtu-0001", SAMPLE, ["5k", "3dgs"]), Config(), Stopwatch()))
    assert [row.error for row in rows] == ["no depth"] * 2 and not rows[0].success
    assert sum("no depth" in note for note in notes(rows)) == 2


def test_a_budget_is_held_against_the_baseline_scan_by_scan() -> None:
    rows = [
        replace(GOOD, number=n, method=method, psnr=24.0 + n + gain)
        for n in range(3)
        for method, gain in (("5k", -1.0), ("10k", 0.5), ("3dgs", 0.0))
    ]
    (title, header, means), (_, _, pairs) = sections(rows)
    assert "3 scans" in title
    shown = {row[0]: dict(zip(header, row, strict=True)) for row in means}
    assert shown["ours, 5,000 splats"]["PSNR [dB]"] == "24.00" and shown["3D-GS (the paper)"]["PSNR [dB]"] == "23.27"
    assert [row[2:] for row in pairs] == [("-1.00", "-1.00 to -1.00"), ("+0.50", "+0.50 to +0.50")]

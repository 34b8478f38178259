"""What each mechanism is worth: a recording with it off, and the table of what that changes."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from experiments import ablation
from experiments.ablation import (
    ALL,
    OF_MOTION,
    OFF,
    SCAN,
    TABLE,
    Measured,
    measured,
    notes,
    problems,
    sections,
)
from experiments.problems import ProblemRequest
from splatctrl_cli.blocks import RecordingOptions, SimulateRequest
from splatctrl_cli.config import Config, load_config
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import Stopwatch
from tests.conftest import ROOT

GOOD = Measured(
    environment=TABLE, number=0, method=ALL, psnr=25.0, depth=0.005, in_front=0.05, splats=4900, fit_s=6.0,
    audit="safe", map_clearance=0.046, true_clearance=0.043, loop="safe", reached=True, loop_clearance=0.022,
    loop_s=4.0, margin=0.02,
)  # fmt: skip


def asked(problem: str, methods: Sequence[str], width: int) -> ProblemRequest:
    return ProblemRequest(problem=problem, out=Path(), methods=tuple(methods), width=width, threads=1)


FAST = (
    *("scene.first_iterations=10", "scene.iterations_per_step=1", "scene.refine_iterations=10"),
    *("scene.max_splats=800", "control.max_time=0.1", "control.solver=daqp"),
)


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablation, "OFF", {name: (*FAST, *settings) for name, settings in OFF.items()})


def trials(*, numbers: int = 4, **without: dict[str, float | str]) -> list[Measured]:
    """The same good row for each recording, and beside it those without a mechanism, changed so."""
    rows = [replace(GOOD, number=n, psnr=25.0 + n) for n in range(numbers)]
    return rows + [
        replace(row, method=name.replace("_", "-"), **changed)  # type: ignore[arg-type]
        for name, changed in without.items()
        for row in rows
    ]


@pytest.mark.parametrize("method", [name for name in OFF if name != ALL])
def test_without_a_mechanism_the_settings_differ(method: str) -> None:
    assert load_config(None, OFF[method]) != Config()


@pytest.mark.parametrize("name", ["table-99x", "foo-0001", "table", "table-", "-3"])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"--problem {name}: expected ENVIRONMENT-NUMBER"):
        list(measured(asked(name, [ALL], 48), Config(), Stopwatch()))


def test_the_problems_are_drawn_and_still() -> None:
    assert problems(2, archive=None) == [(TABLE, 0), (TABLE, 1), (SCAN, 0), (SCAN, 1)]
    assert len(problems(None, archive=None)) == 25


@pytest.mark.usefixtures("fast")
def test_a_recording_goes_through_the_mechanisms_that_it_can_show(monkeypatch: pytest.MonkeyPatch) -> None:
    def copied(request: SimulateRequest) -> None:
        """The scan that a simulation writes, whatever its size."""
        assert request.dtu
        shutil.copytree(ROOT / "sample_data" / "dtu", request.out / "dtu")

    monkeypatch.setattr(ablation, "simulate", copied)
    rows = list(measured(asked("scan-0001", [ALL, "scale", "second-look"], 48), Config(), Stopwatch()))
    assert [row.method for row in rows] == [ALL, "scale"] and all(row.number == 1 for row in rows)
    assert all(row.psnr is not None and row.psnr > 8 and row.audit == "" for row in rows)
    assert rows[0].psnr != rows[1].psnr

    def refused(*_: object) -> Measured:
        raise InputError("no depth")

    monkeypatch.setattr(ablation, "_run", refused)
    (row,) = measured(asked("scan-0001", [ALL], 48), Config(), Stopwatch())
    assert row.error == "no depth" and not row.success and row.cause == "no depth"


@pytest.mark.usefixtures("fast")
def test_a_map_serves_all_that_changes_the_motion_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        ablation, "RecordingOptions", partial(RecordingOptions, duration_s=2.0, fps=2.0, color_rays=0)
    )
    methods = [ALL, "distance-rate"]
    whole, without = measured(asked("table-0003", methods, 64), Config(), Stopwatch())
    assert (whole.method, without.method) == (ALL, "distance-rate") and "distance-rate" in OF_MOTION
    assert whole.psnr is not None and without.psnr is None
    assert (without.map_clearance, without.true_clearance) == (whole.map_clearance, whole.true_clearance)
    assert whole.loop_clearance is not None and whole.audit and whole.loop


@pytest.mark.parametrize(
    ("changed", "greens", "collisions"),
    [
        ({}, 0, 0),
        ({"true_clearance": 0.014}, 1, 0),
        ({"true_clearance": 0.016}, 0, 0),
        ({"true_clearance": 0.014, "loop_clearance": -0.01}, 2, 0),
        ({"audit": "margin broken"}, 0, 1),
        ({"audit": "contact", "true_clearance": 0.019}, 0, 0),
        ({"audit": "contact", "loop": "contact"}, 0, 2),
        ({"audit": "not evaluable"}, 0, 0),
    ],
)
def test_verdicts_are_held_against_the_truth(changed: dict[str, float | str], greens: int, collisions: int) -> None:
    row = replace(GOOD, **changed)  # type: ignore[arg-type]
    assert (row.false_greens(), row.false_collisions()) == (greens, collisions)
    assert row.is_false_green == (greens > 0)
    assert not replace(row, method="noise").is_false_green  # what is off may fail


def test_differences_are_paired_and_what_gives_nothing_is_said() -> None:
    rows = trials(
        noise={}, hole_term={"true_clearance": 0.01}, gap_filling={"loop": "contact"}, shell={"loop_s": 5.0}
    )
    ((title, header, table),) = sections(rows)
    assert "4 of 20" in title
    shown = {line[0]: dict(zip(header, line, strict=True)) for line in table}
    assert (shown[ALL]["dB"], shown["noise"]["dB"]) == ("26.50", "+0.00 [+0.00, +0.00]")
    assert shown["hole-term"]["false greens"] == "4" and shown["gap-filling"]["audit: false collisions"] == "4"
    assert shown["shell"]["loop time [s]"] == "+1.00 [+1.00, +1.00]"
    assert "Nothing changes beyond chance without: noise." in list(notes(rows))

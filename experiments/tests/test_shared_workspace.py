"""The study of a shared workspace: its differences are paired, its baseline follows the path, its labels are late."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import shared_workspace as shared
from experiments.judge import measured
from experiments.problem_run import TRIALS, read_trials
from experiments.problems import ProblemRequest, simulated_arm
from experiments.study import FIGURE, StudyRequest, run_study
from experiments.workspace_drives import (
    LABEL_ERROR,
    STOP_BOX,
    Drive,
    LateLabels,
    TruthField,
    held,
)
from experiments.workspace_trial import (
    CONTROLLER,
    METHODS,
    NAMES,
    PAPER,
    PERSON_TOUCHED,
    STANDSTILL,
    Setting,
    Visit,
    judged,
    notes,
    problems,
    sections,
    visits_of,
)
from splatctrl_cli.config import Config
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import Outcome
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.records import Intrinsics, RgbdFrame
from splatctrl_cli.simulate.recording import START_NS, Recording, RecordingOptions


def visit(place: str, number: int, method: str, duration: float, distance: float) -> Visit:
    return Visit(
        place=place,
        number=number,
        method=method,
        success=True,
        cause="",
        verdict="safe",
        is_false_green=False,
        reason="",
        duration_s=duration,
        alone_s=7.9,
        visit_s=5.0,
        mean_human=distance,
        least_human=distance / 2,
        true_clearance=0.03,
        num_stops=1,
        stopped_s=2.0,
        interventions=3,
        relaxed=0.0,
    )


def visits() -> list[Visit]:
    """Every method is a second faster than the one before; by place, one is nearer or farther than the standstill."""
    found = []
    for number, place in ((0, "near-pickup"), (0, "near-goal"), (1, "near-goal")):
        for index, method in enumerate(METHODS):
            found.append(visit(place, number, method, 14.0 - index, 0.2 + 0.01 * index * (-1) ** number))
    return found


def rows(title: str, found: list[Visit]) -> list[tuple[str, ...]]:
    """Of the section that begins with a title."""
    (chosen,) = [section for name, _, section in sections(found) if name.startswith(title)]
    return [tuple(row) for row in chosen]


def test_differences_are_taken_within_a_visit() -> None:
    time, distance, _ = (row for row in rows("Differences", visits()) if row[0] == NAMES[CONTROLLER])
    assert time[2:] == ("-2.00", "-2.00 to -2.00", "0/3", "nan")
    assert (distance[2], distance[4]) == ("+0.67", "2/3")


def test_a_visit_without_the_standstill_is_in_no_pair() -> None:
    found = [v for v in visits() if v.method != STANDSTILL or v.number == 0]
    assert {row[4].split("/")[1] for row in rows("Differences", found)} == {"2"}


def test_collisions_and_what_came_near_are_counted_beside_the_verdicts() -> None:
    found = visits()
    found[2] = replace(found[2], success=False, cause=PERSON_TOUCHED, true_clearance=-0.01, is_false_green=True)
    (row,) = [row for row in rows("Judged", found) if row[0] == NAMES[CONTROLLER]]
    assert row[1:] == ("3", "3", "1", "0", "1", "1")
    assert [row[1] for row in rows("Both", found) if row[0] == NAMES[CONTROLLER]] == ["2/3"]


def test_the_visits_are_as_many_as_the_papers_trials_and_a_part_says_so() -> None:
    assert len(problems(None, archive=None)) == 32
    assert problems(1, archive=None) == [("near-pickup", 0), ("near-goal", 0)]
    said = list(notes(visits()))
    assert PAPER in said and "Sampled: 3 of 32 visits." in said


def test_the_truth_has_the_slope_of_its_distance_as_gradient() -> None:
    field, step = TruthField(shared.things("near-goal", 0)), 1e-6
    points = np.random.default_rng(0).uniform([0.2, -0.6, 0.15], [0.9, 0.6, 0.5], (60, 3))
    slope = [(field.query(points + step * e)[0] - field.query(points - step * e)[0]) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(field.query(points)[1], np.stack(slope, axis=1), atol=1e-5)


def test_the_baseline_takes_the_path_of_the_arm_alone_and_waits_for_the_person() -> None:
    share = np.linspace(0, 1, 301)[:, None]
    alone = Drive(
        position=np.array(shared.HOME) + share * (np.array(shared.PICKUP) - shared.HOME),
        is_stopped=np.zeros(301, dtype=bool),
        is_complete=True,
    )
    there = shared.visit_of("near-goal", 0)
    assert there.start_s < 3.0
    run = held(simulated_arm(), Config(), alone, shared.human_arm(there, START_NS), STOP_BOX)
    assert run.is_complete and run.is_stopped.any()
    assert 0.8 * (there.end_s - there.start_s) < 0.01 * len(run.position) - 3.0 < there.end_s - there.start_s
    gap = np.min(np.linalg.norm(run.position[:, None] - alone.position[None], axis=2), axis=1)
    assert gap.max() < 0.01
    np.testing.assert_allclose(run.position[-1], alone.position[-1], atol=1e-6)


def test_the_distance_to_the_person_counts_until_the_person_is_gone() -> None:
    config, place = Config(), "near-goal"
    options = RecordingOptions(seed=0, duration_s=60.0, width=32, height=24, color_rays=0)
    alone = Drive(position=np.tile(shared.HOME, (2, 1)), is_stopped=np.ones(2, bool), is_complete=True)
    setting = Setting(
        place=place,
        number=0,
        recording=Recording(options, simulated_arm(), shared.scene_of(place, 0)),
        config=config,
        alone=alone,
    )
    robot = measured(setting.model, config)
    waiting = replace(alone, position=np.tile(shared.HOME, (1500, 1)), is_stopped=np.ones(1500, bool))
    short, long = (judged(setting, robot, STANDSTILL, drive) for drive in (alone, waiting))
    assert short.mean_human == pytest.approx(long.mean_human, rel=1e-9) and short.mean_human > short.least_human
    assert not short.verdict and short.success and (short.duration_s, long.duration_s) == (0.01, 14.99)


def test_labels_are_those_of_the_frame_before_and_off_along_the_outline() -> None:
    late, masks = LateLabels(seed=0), []
    lens = Intrinsics(fx=40, fy=40, cx=20, cy=15, width=40, height=30)
    for index in range(12):
        human = np.zeros((30, 40), np.uint8)
        human[10:20, index + 8 : index + 18] = 1
        frame = RgbdFrame(
            stamp_ns=index,
            camera="cam0",
            color=np.zeros((30, 40, 3), np.uint8),
            depth=np.ones((30, 40), np.float32),
            intrinsics=lens,
            T_world_camera=np.eye(4),
            human=human,
        )
        found = late.on(frame).human
        assert found is not None
        masks.append(found)
    assert not masks[0].any()
    for index, mask in enumerate(masks[1:], start=1):
        there, columns = np.nonzero(mask)
        off = 10 - there.min()
        assert abs(off) == LABEL_ERROR and columns.min() == 8 + index - 1 - off
    assert len({int(mask.sum()) for mask in masks[1:]}) > 1  # grown and shrunk


def test_a_study_leaves_its_figure_and_its_visits_as_rows(tmp_path: Path) -> None:
    out = tmp_path / "shared"
    asked = StudyRequest(study="shared-workspace", out=out, trials=1, methods=(STANDSTILL,), width=32)
    result = run_study(asked)
    assert read_trials(out / TRIALS, Visit) == list(result.trials) and len(result.trials) == 2
    assert (out / FIGURE).is_file() and result.verdict.outcome is Outcome.PASSED
    for row in result.trials:
        assert row.success and not row.verdict and row.duration_s > row.alone_s + 0.5 * row.visit_s
        assert row.least_human < row.mean_human and row.stopped_s > 0.5 * row.visit_s


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="expected PLACE-NUMBER"):
        list(
            visits_of(
                ProblemRequest(problem="kitchen-0000", out=Path(), methods=METHODS, width=32), Config(), Stopwatch()
            )
        )

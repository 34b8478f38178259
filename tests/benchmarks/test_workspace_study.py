"""The study of a shared workspace: its rows read back, its differences are paired, its baseline follows the path."""

import numpy as np

from benchmarks.workspace import METHODS, report
from benchmarks.workspace_trial import STOP_BOX, Drive, Row, TruthField, held
from splatctrl_cli.config import Config
from splatctrl_cli.simulate import shared_workspace as shared
from splatctrl_cli.simulate.recording import START_NS


def row(place: str, seed: int, method: str, duration: float, distance: float) -> Row:
    return Row(
        place=place, seed=seed, method=method, completed=True, duration=duration, visit=5.0, mean_human=distance,
        least_human=distance / 2, least_any=0.03, num_stops=1, stopped=2.0, interventions=3, relaxed=0.0,
    )  # fmt: skip


def rows() -> list[Row]:
    found = []
    for seed, place in ((0, "near-pickup"), (0, "near-goal"), (1, "near-goal")):
        for index, method in enumerate(("alone", *METHODS)):
            found.append(row(place, seed, method, 14.0 - index, 0.2 + 0.01 * index * (-1) ** seed))
    return found


def test_differences_are_taken_within_a_trial() -> None:
    lines = [line for line in report(rows()) if line.startswith("controller ")]
    time, distance = lines[-2:]
    assert time.split()[3:] == ["-2.0", "-2.0", "0/3", "nan"]
    assert "2/3" in distance


def test_the_truth_has_the_slope_of_its_distance_as_gradient() -> None:
    field, step = TruthField(shared.things("near-goal", 0)), 1e-6
    points = np.random.default_rng(0).uniform([0.2, -0.6, 0.15], [0.9, 0.6, 0.5], (60, 3))
    slope = [(field.query(points + step * e)[0] - field.query(points - step * e)[0]) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(field.query(points)[1], np.stack(slope, axis=1), atol=1e-5)


def test_the_baseline_takes_the_path_of_the_arm_alone_and_waits_for_the_person() -> None:
    share = np.linspace(0, 1, 301)[:, None]
    alone = Drive(
        position=np.array(shared.HOME) + share * (np.array(shared.PICKUP) - shared.HOME),
        is_stopped=np.zeros(301, dtype=bool), is_complete=True,
    )  # fmt: skip
    visit = shared.visit_of("near-goal", 0)
    assert visit.start_s < 3.0
    run = held(Config(), alone, shared.human_arm(visit, START_NS), STOP_BOX)
    assert run.is_complete and run.is_stopped.any()
    assert 0.8 * (visit.end_s - visit.start_s) < 0.01 * len(run.position) - 3.0 < visit.end_s - visit.start_s
    gap = np.min(np.linalg.norm(run.position[:, None] - alone.position[None], axis=2), axis=1)
    assert gap.max() < 0.01
    np.testing.assert_allclose(run.position[-1], alone.position[-1], atol=1e-6)

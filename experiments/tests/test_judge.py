"""What a motion comes to: everywhere on the way and not at samples, by cause, and greens that were not to be."""

from dataclasses import replace

import numpy as np
import pytest

from experiments import judge, trial
from experiments.maps import Map
from experiments.problem_run import FALSE_GREEN, SETTINGS, verdict_on_trials
from experiments.problems import Problem, Views, read_problem, views_of
from experiments.tests.conftest import HOME, blind
from experiments.trial import OURS, Attempt, Rig, Trial, trial_of
from splatctrl_cli.config import Config
from splatctrl_cli.evaluate.verdict import Outcome, Verdict, held, verdict_of
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.replay import evidence_criteria
from splatctrl_cli.jobs.replay.evidence_criteria import LIMITS
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.records import Float64


def test_a_way_that_touches_a_thing_between_two_states_alone_has_collided(problem: Problem, views: Views) -> None:
    position = np.array([problem.start, problem.goal])
    assert Clearance.of(problem.model, problem.solids).at(position).min() > 0.04  # at the states nothing is near
    execution = judge.against_truth(problem, position, views)
    assert execution.has_collided and execution.clearance <= 0.0
    alone = judge.against_truth(replace(problem, things=()), position, views)
    assert not alone.cause and alone.clearance > 0.0


def test_a_thing_that_no_camera_measured_is_an_unseen_one(problem: Problem, views: Views) -> None:
    position = np.array([problem.start, HOME, problem.goal])
    assert judge.against_truth(problem, position, views).cause == judge.HIT_SEEN
    assert judge.against_truth(problem, position, blind(views)).cause == judge.HIT_UNSEEN


@pytest.mark.parametrize(("joint", "angle", "cause"), [(6, 0.0, ""), (6, np.radians(1.1), judge.GOAL_MISSED)])
def test_the_goal_is_reached_within_3_cm_and_1_degree(
    problem: Problem, views: Views, joint: int, angle: float, cause: str
) -> None:
    end = problem.goal.copy()
    end[joint] += angle
    free = replace(problem, things=())
    assert judge.against_truth(free, np.array([problem.start, end]), views).cause == cause


def test_an_arm_that_folds_into_itself_has_hit_itself(problem: Problem, views: Views) -> None:
    folded = np.array([0.0, 0.0, 0.0, -3.07, 0.0, -0.01, 0.785])
    free = replace(problem, things=())
    assert judge.against_truth(free, np.array([problem.start, folded]), views).cause == judge.HIT_SELF


def test_the_back_of_a_thing_that_the_arm_at_rest_hid_from_all_cameras_is_not_safe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Once driven and judged safe: 9 mm from a cylinder of which the map has the far side, 70 mm away."""
    hidden_back = read_problem("tabletop-0388", None)
    views = views_of(hidden_back, 2, width=320, num_steps=5)
    rig = Rig(problem=hidden_back, views=views, config=SETTINGS, threads=1, stopwatch=Stopwatch())
    known, robot = rig.splats.known, judge.measured(hidden_back.model, SETTINGS)
    end = np.array([-0.109873, 0.725588, -0.770394, -1.776587, -0.111532, 2.114366, 2.058994])
    way = np.linspace(hidden_back.start, end, 116)
    assert judge.against_truth(hidden_back, way, views).clearance < 0.01
    assert known is not None
    assert judge.verdict_on(robot, way, rig.task.stamp_ns, known, SETTINGS).label == "not evaluable"
    without = [limit for limit in LIMITS if limit.column != "blind_to_surface"]
    monkeypatch.setattr(evidence_criteria, "LIMITS", without)
    assert judge.verdict_on(robot, way, rig.task.stamp_ns, known, SETTINGS).label == "safe"  # it would still pass


def passed(*_: object) -> Verdict:
    return verdict_of("replay", [held("kept", 0.1, 0.02, "m", 2)], passed="safe")


def through_the_post(problem: Problem) -> Float64:
    return np.array([problem.start, problem.goal])


def test_a_green_verdict_on_a_motion_that_collides_is_counted_as_false(
    problem: Problem, views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = Map(scene=problem.solids, known=object(), num_parts=1)  # type: ignore[arg-type]
    driven = Attempt(position=through_the_post(problem), outcome="solved")
    monkeypatch.setattr(trial, "MAKERS", {OURS: (lambda rig: known, lambda rig, known: driven)})
    monkeypatch.setattr(judge, "verdict_on", passed)
    rig = Rig(problem=problem, views=views, config=Config(), threads=1, stopwatch=Stopwatch())
    row = trial_of(rig, OURS, 2, None)  # type: ignore[arg-type]
    assert (row.verdict, row.success, row.is_false_green) == ("safe", False, True)
    verdict = verdict_on_trials([row])
    assert verdict.outcome is Outcome.FAILED and verdict.label == FALSE_GREEN
    assert "tabletop 0, 2 cameras, ours: judged safe, and there was a collision with" in verdict.sentence
    honest = replace(row, is_false_green=False)
    assert verdict_on_trials([honest]).outcome is Outcome.PASSED


def test_what_a_method_cannot_do_is_a_failed_trial_with_its_reason(problem: Problem, views: Views) -> None:
    rig = Rig(problem=problem, views=blind(views), config=Config(), threads=1, stopwatch=Stopwatch())
    row = trial_of(rig, "occupancy", 2, None)  # type: ignore[arg-type]
    assert not row.success and row.cause == judge.NOT_EVALUABLE and "no voxel is occupied" in row.reason
    assert isinstance(row, Trial)

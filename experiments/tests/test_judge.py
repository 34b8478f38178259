"""Outcomes of motions, measured between samples too, with causes and false greens; pictures of failed trials."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from experiments import failures, judge, trial
from experiments.maps import Map
from experiments.pictures import COLORS, TOUCHED, UNSEEN
from experiments.problem_run import FALSE_GREEN, SETTINGS, verdict_on_trials
from experiments.problems import Problem, Views, read_problem, views_of
from experiments.tests.conftest import HOME, blind
from experiments.trial import OURS, Attempt, Rig, Trial, trial_of
from splatctrl_cli.config import Config
from splatctrl_cli.evaluate.verdict import Outcome, Verdict, passed_reason, verdict_of
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.replay import evidence_criteria
from splatctrl_cli.jobs.replay.evidence_criteria import LIMITS
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.sphere_files import sphere_names


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
    without = [limit for limit in LIMITS if limit.on != "blind_to_surface"]
    monkeypatch.setattr(evidence_criteria, "LIMITS", without)
    assert judge.verdict_on(robot, way, rig.task.stamp_ns, known, SETTINGS).label == "safe"  # it would still pass


def passed(*_: object) -> Verdict:
    return verdict_of("replay", [passed_reason("kept", 0.1, 0.02, "m", 2)], passed="safe")


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


MOST = 150_000  # bytes


def pictured(
    problem: Problem,
    views: Views,
    attempt: Attempt,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[str, Path]:
    """The cause of a trial with a map of one ball at the post, and where its picture is to be."""
    ball = problem.things[0].T_world_shape[:3, 3] if problem.things else np.zeros(3)
    known = Map(scene=problem.solids, things=(ball[None].astype(np.float32), np.full(1, 0.05, np.float32)))
    monkeypatch.setattr(trial, "MAKERS", {OURS: (lambda rig: known, lambda rig, known: attempt)})
    rig = Rig(problem=problem, views=views, config=Config(), threads=1, stopwatch=Stopwatch(), out=folder)
    row = trial_of(rig, OURS, 2, None)  # type: ignore[arg-type]
    return row.cause, folder / "failure-ours-2.png"


def num_pixels(path: Path, name: str) -> int:
    """Pixels with the hue of a named colour, in both views."""
    image = cv2.imread(str(path))[80:530, :, ::-1].astype(np.float64)
    brightest = image.max(axis=2, keepdims=True)
    color = np.array(to_rgb(COLORS[name]))
    is_near = np.abs(image / np.maximum(brightest, 1) - color / color.max()).max(axis=2) < 0.06
    return int(np.sum(is_near & (brightest[..., 0] > 60)))


@pytest.mark.usefixtures("painted")
@pytest.mark.parametrize("is_blind", [False, True])
def test_a_collision_is_shown_where_it_is_deepest_and_whether_that_was_seen(
    problem: Problem, views: Views, is_blind: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    position = np.array([problem.start, HOME, problem.goal])
    seen_by = blind(views) if is_blind else views
    cause, path = pictured(problem, seen_by, Attempt(position=position), tmp_path, monkeypatch)
    assert cause == (judge.HIT_UNSEEN if is_blind else judge.HIT_SEEN)
    assert cause.encode() in path.read_bytes()
    assert path.stat().st_size < MOST
    assert num_pixels(path, TOUCHED) > 100
    assert num_pixels(path, UNSEEN) > 2000 if is_blind else num_pixels(path, UNSEEN) < 1500  # its back is unseen


@pytest.mark.usefixtures("painted")
def test_what_blocks_is_shown_where_there_is_no_plan(
    problem: Problem, views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt = Attempt(position=None, cause=judge.GOAL_BLOCKED)
    cause, path = pictured(replace(problem, goal=HOME), views, attempt, tmp_path, monkeypatch)
    assert cause == judge.GOAL_BLOCKED
    assert b"at the goal" in path.read_bytes()
    assert num_pixels(path, TOUCHED) > 100
    pictured(replace(problem, start=HOME), views, replace(attempt, cause=judge.START_BLOCKED), tmp_path, monkeypatch)
    assert b"at the start" in path.read_bytes()


def test_a_sphere_is_named_whether_a_joint_moves_it_or_not(problem: Problem, views: Views) -> None:
    failure = failures.Failure(
        problem=problem, views=views, told="", cause="", verdict="", reason="", position=None, scene=None, things=None
    )
    named = sphere_names(problem.model.sphere_set)
    for sphere in (0, len(named) - 1):
        at = judge.Contact(q=HOME, sphere=sphere, point=np.zeros(3), when="")
        assert f"sphere {named[sphere]} at" in failures._caption(failure, at)


def test_of_a_map_of_many_things_some_within_reach_are_shown(problem: Problem) -> None:
    middle, reach = problem.model.base_position, problem.model.reach()
    far = np.random.default_rng(0).normal(size=(5 * failures.BALLS, 3))
    centers = (middle + reach * far).astype(np.float32)
    shown, radii = failures._shown(problem, centers, np.arange(len(far), dtype=np.float32))
    assert failures.BALLS / 2 < len(shown) <= failures.BALLS
    assert (np.linalg.norm(shown - middle, axis=1) < reach).all()
    np.testing.assert_array_equal(shown, centers[radii.astype(int)])
    few = failures._shown(problem, shown[:10], radii[:10])
    assert len(few[0]) == 10


def test_a_success_leaves_no_picture(
    problem: Problem, views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    position = np.array([problem.start, problem.goal])
    cause, path = pictured(replace(problem, things=()), views, Attempt(position=position), tmp_path, monkeypatch)
    assert not cause and not path.exists()

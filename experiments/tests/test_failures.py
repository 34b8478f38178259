"""A trial without success leaves a picture of why; one that succeeds leaves none."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from experiments import failures, judge, trial
from experiments.maps import Map
from experiments.pictures import COLORS, TOUCHED, UNSEEN
from experiments.problems import Problem, Views
from experiments.tests.conftest import HOME, blind
from experiments.trial import OURS, Attempt, Rig, trial_of
from splatctrl_cli.config import Config
from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.files.output import Stopwatch

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
    """How many have the hue of a colour, in both views."""
    image = cv2.imread(str(path))[80:530, :, ::-1].astype(np.float64)
    brightest = image.max(axis=2, keepdims=True)
    color = np.array(to_rgb(COLORS[name]))
    is_near = np.abs(image / np.maximum(brightest, 1) - color / color.max()).max(axis=2) < 0.06
    return int(np.sum(is_near & (brightest[..., 0] > 60)))


@pytest.mark.parametrize("is_blind", [False, True])
def test_a_collision_is_shown_where_it_is_deepest_and_whether_that_was_seen(
    problem: Problem, views: Views, is_blind: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    position = np.array([problem.start, HOME, problem.goal])
    seen_by = blind(views) if is_blind else views
    cause, path = pictured(problem, seen_by, Attempt(position=position), tmp_path, monkeypatch)
    assert cause == (judge.HIT_UNSEEN if is_blind else judge.HIT_SEEN)
    assert cause.encode() in path.read_bytes() and path.stat().st_size < MOST
    assert num_pixels(path, TOUCHED) > 100
    assert num_pixels(path, UNSEEN) > 2000 if is_blind else num_pixels(path, UNSEEN) < 1500  # its back is unseen


def test_what_blocks_is_shown_where_there_is_no_plan(
    problem: Problem, views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt = Attempt(position=None, cause=judge.GOAL_BLOCKED)
    cause, path = pictured(replace(problem, goal=HOME), views, attempt, tmp_path, monkeypatch)
    assert cause == judge.GOAL_BLOCKED and b"at the goal" in path.read_bytes()
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

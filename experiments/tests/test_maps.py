"""Maps of one simulated problem, and which of their ways a planner takes."""

from functools import partial

import numpy as np
import pytest

from experiments import judge, maps, trial
from experiments.densify import GaussianSettings
from experiments.gaussian_fitter import GaussianFitter
from experiments.maps import Map
from experiments.problems import Problem, Views, read_problem, views_of
from experiments.trial import Rig
from experiments.ways import Way, Ways
from splatctrl_cli.config import Config
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.replay.known_scene import Certified
from splatctrl_cli.records import SplatSet
from splatctrl_cli.scene.posture import posture_of
from splatctrl_cli.scene.self_mask import self_mask
from splatctrl_cli.simulate.truth import distance_to


@pytest.fixture(scope="module")
def problem() -> Problem:
    return read_problem("tabletop-0003", None)


@pytest.fixture(scope="module")
def views(problem: Problem) -> Views:
    return views_of(problem, 2, width=96, num_steps=3)


def rig(problem: Problem, views: Views) -> Rig:
    return Rig(problem=problem, views=views, config=Config(), threads=1, stopwatch=Stopwatch())


def ways_of(*clear: float) -> Ways:
    """Ways in which everything is so far [m] from everything; the first is in known space."""
    known = (True, False)
    return lambda: (
        Way(scene=Certified(distance=lambda points, d=d: np.full(len(points), d)), margin=0.02, in_known_space=k)
        for d, k in zip(clear, known, strict=True)
    )


def test_the_first_way_that_leads_to_the_goal_is_taken(problem: Problem, views: Views) -> None:
    asked = rig(problem, views)
    taken = [
        trial.by_planner(asked, Map(scene=problem.solids, ways=ways_of(*clear)))
        for clear in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0))
    ]
    assert [attempt.in_known_space for attempt in taken] == [True, False, False]
    assert [attempt.position is not None for attempt in taken] == [True, True, False]
    assert taken[2].cause == judge.GOAL_BLOCKED


def test_a_controller_keeps_from_the_map_but_where_the_arm_stands_and_is_to_go(problem: Problem) -> None:
    """A ball in the hand at the start, one 5 mm from it at the goal, one in free space."""
    model, config = problem.model, Config()
    here, there = (model.sphere_centers(q)[model.moving_spheres][-1] for q in (problem.start, problem.goal))
    body = model.sphere_centers(problem.goal)[model.moving_spheres]
    out = (there - body.mean(axis=0)) / np.linalg.norm(there - body.mean(axis=0))
    reach = model.sphere_set.radii[model.moving_spheres][-1]
    centers = np.array([here, there + out * (reach + 0.005), here + np.array([0.0, 0.0, 0.6])], np.float32)
    spheres = SplatSet(
        centers=centers,
        radii=np.full(3, 0.02, np.float32),
        opacities=np.ones(3, np.float32),
        colors=np.zeros((3, 3), np.float32),
        labels=np.zeros(3, np.uint8),
        density=np.ones(3, np.float32),
    )
    distance = maps.barrier_of(problem, spheres, config, threads=1).query(centers.astype(np.float64))[0]
    assert distance[0] > 0.1
    np.testing.assert_allclose(distance[1:], [0.0, -0.02], atol=1e-5)


def test_the_gaussians_of_the_baseline_lie_on_the_things_and_not_on_the_arm(
    problem: Problem, views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = partial(GaussianFitter, settings=GaussianSettings(iterations=60))
    monkeypatch.setattr(maps, "GaussianFitter", quick)
    made = maps.gaussian_map(problem, views, Config(), threads=1)
    on_table = np.array([[0.6, y, 0.0] for y in np.linspace(-0.6, 0.6, 41)])
    others = [p for p in problem.things if p.name != "table_0"]
    clear = on_table[distance_to(others, on_table, 0) > 0.1]
    assert np.median(made.scene.distance(clear)) < 0.02
    middle = problem.model.sphere_centers(problem.start)[problem.model.moving_spheres]
    radii = problem.model.sphere_set.radii[problem.model.moving_spheres]
    assert (made.scene.distance(middle) > radii).all()  # the arm itself is in no map
    assert made.num_parts > 500


def test_no_pixel_of_the_arm_counts_for_a_baseline(problem: Problem, views: Views) -> None:
    plain = [frame for step in views.steps for frame in step]
    robot = posture_of(problem.model, problem.start, {frame.stamp_ns: problem.start for frame in plain})
    for frame, without in zip(plain, maps.without_robot(problem, views, Config()), strict=True):
        shows_arm = self_mask(frame, robot, Config().occupancy).robot_depth > 0
        assert without.valid is not None and (without.depth[~without.valid] == 0).all()
        assert 0 < (~without.valid).sum() < 0.2 * without.valid.size
        is_dark = frame.depth == 0
        assert (shows_arm & is_dark).any() and not without.valid[shows_arm & is_dark].any()
        assert without.valid[~shows_arm & is_dark].all()  # what else has no depth may be seen


def test_the_tsdfs_surfaces_are_those_of_the_things_without_the_arm(problem: Problem) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    made = maps.tsdf_map(problem, views_of(problem, 2, width=320, num_steps=5), Config())
    on_table = np.array([[0.6, y, 0.0] for y in np.linspace(-0.6, 0.6, 41)])
    others = [p for p in problem.things if p.name != "table_0"]
    clear = on_table[distance_to(others, on_table, 0) > 0.1]
    assert len(clear) > 5 and np.median(made.scene.distance(clear)) < 0.012
    middle = problem.model.sphere_centers(problem.start)[problem.model.moving_spheres]
    assert np.median(made.scene.distance(middle)) > 0.03  # the arm itself is in no TSDF

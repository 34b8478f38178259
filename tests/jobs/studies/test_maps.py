"""Maps of one simulated problem: unseen space is kept out of first, the arm's own pixels do not block its start."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from splatctrl_cli.config import Config
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.studies import maps, trial
from splatctrl_cli.jobs.studies.maps import Asked, Map
from splatctrl_cli.jobs.studies.problems import Problem, read_problem
from splatctrl_cli.jobs.studies.trial import Rig
from splatctrl_cli.jobs.studies.views import Views, views_of
from splatctrl_cli.records import Float64, SplatSet
from splatctrl_cli.simulate.truth import distance_to
from splatctrl_cli.voxels import Balls, OccupancyGrid, VoxelState


@pytest.fixture(scope="module")
def problem() -> Problem:
    return read_problem("tabletop-0003", None)


@pytest.fixture(scope="module")
def views(problem: Problem) -> Views:
    return views_of(problem, 2, width=96, num_steps=3)


def splats_at(centers: Float64, radius: float) -> SplatSet:
    num = len(centers)
    return SplatSet(
        centers=np.asarray(centers, np.float32),
        radii=np.full(num, radius, np.float32),
        colors=np.zeros((num, 3), np.float32),
        opacities=np.ones(num, np.float32),
        labels=np.zeros(num, np.uint8),
        density=np.zeros(num, np.float32),
    )


def test_what_reaches_into_the_arm_at_its_start_is_not_in_the_planners_way(problem: Problem) -> None:
    hand = problem.model.sphere_centers(problem.start)[problem.model.moving_spheres][-1]
    far = hand + np.array([0.0, 0.0, 0.4])
    nothing = Balls(centers=np.empty((0, 3), np.float32), radius=0.01, labels=np.empty(0, np.uint8))
    fitter = SimpleNamespace(splats=lambda: splats_at(np.array([hand, far]), 0.01), unrepresented=nothing)
    field = maps._beside_the_start(problem, fitter, 1)  # type: ignore[arg-type]
    assert field.query(far[None])[0][0] == pytest.approx(-0.01, abs=1e-6)  # another thing stays
    assert field.query(hand[None])[0][0] > 0.3


def test_unseen_voxels_are_balls_but_beside_the_arms_start_and_goal(problem: Problem) -> None:
    states = np.full((90, 90, 90), VoxelState.FREE, np.uint8)
    hand = problem.model.sphere_centers(problem.start)[-1]
    origin = hand - 0.02 * np.array([45.0, 45.0, 45.0])
    states[45, 45, 45] = states[45, 45, 85] = VoxelState.NEVER_SEEN  # in the hand, and 80 cm above it
    grid = OccupancyGrid.from_states(origin, 0.02, states)
    unseen = maps.unseen_distance(problem, grid, Config())
    assert unseen is not None
    above = hand + np.array([0.0, 0.0, 0.8])
    found = unseen(np.array([above, above - [0.0, 0.0, 0.1], hand]))
    np.testing.assert_allclose(found, [-0.01, 0.09, 0.79], atol=1e-5)
    assert maps.unseen_distance(problem, OccupancyGrid.from_states(origin, 0.02, 0 * states + 1), Config()) is None


def rig(problem: Problem, views: Views) -> Rig:
    return Rig(problem=problem, views=views, config=Config(), threads=1, stopwatch=Stopwatch())


def test_a_way_through_seen_space_is_taken_where_there_is_one(problem: Problem, views: Views) -> None:
    asked = rig(problem, views)
    free = Map(scene=problem.solids, unseen=lambda points: np.full(len(points), 1.0))
    assert trial.by_planner(asked, free).in_known_space is True
    none = Map(scene=problem.solids, unseen=lambda points: np.full(len(points), -1.0))
    attempt = trial.by_planner(asked, none)
    assert attempt.in_known_space is False and attempt.position is not None
    blocked = replace(none, scene=Asked(distance=lambda points: np.full(len(points), -1.0)))
    assert trial.by_planner(asked, blocked).position is None


def test_the_tsdfs_surfaces_are_those_of_the_things_without_the_arm(problem: Problem) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    made = maps.tsdf_map(problem, views_of(problem, 2, width=320, num_steps=5), Config())
    on_table = np.array([[0.6, y, 0.0] for y in np.linspace(-0.6, 0.6, 41)])
    others = [p for p in problem.things if p.name != "table_0"]
    clear = on_table[distance_to(others, on_table, 0) > 0.1]
    assert len(clear) > 5
    assert np.median(made.scene.distance(clear)) < 0.012
    middle = problem.model.sphere_centers(problem.start)[problem.model.moving_spheres]
    assert np.median(made.scene.distance(middle)) > 0.03  # the arm itself is in no TSDF

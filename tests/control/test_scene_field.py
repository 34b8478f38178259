"""The scene as the controller takes it; what must hold before it runs, and what comes near fixed links."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import DistanceFunction
from splatctrl_cli.control.barriers import PeopleGrown, SceneStep, distance_rate, guard_people
from splatctrl_cli.control.preconditions import FixedParts, check_free, static_violations
from splatctrl_cli.control.replay import ReplayTask, closed_loop
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.records import Bool, Float64, SphereSet
from tests.control.fakes import Balls, Nowhere, PlanarArm, Plane, ThinArm, scene_of, steps_towards
from tests.refused import expect_refusal

THING, PERSON = (0.6, 0.5, 0.0), (0.9, -0.4, 0.0)
POINTS = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.0]])


def balls(*middles: tuple[float, float, float]) -> Balls:
    """Balls of 5 cm."""
    return Balls(middles, [0.05] * len(middles))


def moved(speed: float, seconds: float = 0.2) -> SceneStep:
    """A wall ahead that came nearer by `speed`."""
    older, newer = (Plane([-1.0, 0.0, 0.0], offset) for offset in (-2.0, -2.0 + speed * seconds))
    return SceneStep(newer=newer, older=older, seconds=seconds)


@pytest.mark.parametrize(("speed", "rate"), [(0.3, -0.3), (-0.3, 0.0), (5.0, -1.6)])
def test_a_wall_that_recedes_loosens_nothing_and_one_that_jumps_is_clipped(speed: float, rate: float) -> None:
    """One that comes nearer has the rate of its speed; without two scenes and their distances there is none."""
    np.testing.assert_allclose(distance_rate(moved(speed), POINTS, 1.6), rate)
    np.testing.assert_array_equal(distance_rate(replace(moved(speed), older=Nowhere()), POINTS, 1.6), 0.0)
    assert distance_rate(None, POINTS, 1.6) == 0.0


@pytest.mark.parametrize("name", ["none", "snapshots"])
def test_a_scene_that_comes_nearer_is_met_with_more_distance_where_its_rate_is_known(name: str) -> None:
    """Each scene is 4 cm nearer than the last, which takes a static row by surprise."""
    arm, start = PlanarArm(), np.array([0.6, 0.6])
    fields = [Balls([[0.95 - 0.04 * k, 0.655, 0.0]], [0.1]) for k in range(8)]
    asked: list[int] = []

    def step_at(stamp_ns: int) -> SceneStep | None:
        asked.append(stamp_ns)
        k = stamp_ns // 100_000_000
        return None if k == 0 else SceneStep(newer=fields[k], older=fields[k - 1], seconds=0.1)

    config = replace(ControlConfig(), distance_rate=name, max_time=0.8, goal_position=0.002)
    out_of_plane = arm.frame_pose(start, "tip")
    out_of_plane[2, 3] += 0.005  # where the arm is and stays, and yet no goal that it reaches
    task = ReplayTask(start=start, T_world_goal=out_of_plane, frame="tip")
    trace = closed_loop(arm, config, task, lambda t: fields[t // 100_000_000], scene_step_at=step_at)
    assert (min(step.clearance for step in trace.steps) > 0.0) is (name == "snapshots")
    assert asked[-1:] == ([trace.stamp_ns[-1]] if name == "snapshots" else [])


def test_people_reach_as_much_farther_and_things_do_not() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    distance, _ = PeopleGrown(balls(THING, PERSON), balls(PERSON), 0.1).query(points)
    to_thing, to_person = balls(THING).query(points)[0], balls(PERSON).query(points)[0]
    np.testing.assert_allclose(distance, np.minimum(to_thing, to_person - 0.1), atol=1e-12)
    assert 50 < np.count_nonzero(to_person - 0.1 < to_thing) < 450


def test_its_gradient_is_the_slope_of_its_distance() -> None:
    field, steps = PeopleGrown(balls(THING, PERSON), balls(PERSON), 0.1), 1e-6 * np.eye(3)
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3))
    slopes = [(field.query(points + step)[0] - field.query(points - step)[0]) / 2e-6 for step in steps]
    np.testing.assert_allclose(field.query(points)[1], np.stack(slopes, axis=1), atol=1e-6)


@pytest.mark.parametrize(
    ("has_people", "changes", "is_guarded"),
    [
        (False, {"human_margin": 0.3}, False),
        (True, {}, False),
        (True, {"margin": 0.05, "human_margin": 0.05}, False),
        (True, {"human_margin": 0.3}, True),
    ],
)
def test_without_people_or_a_larger_margin_the_scene_is_what_counts(
    has_people: bool, changes: dict[str, float], is_guarded: bool
) -> None:
    scene, people = balls(THING), balls(PERSON) if has_people else None
    assert (guard_people(scene, people, ControlConfig(**changes)) is not scene) == is_guarded  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("human_margin", "is_person", "nearest"), [(0.12, False, 0.02), (0.12, True, 0.12), (0.0, True, 0.02)]
)
def test_the_controller_stays_farther_from_a_person_than_from_a_thing(
    human_margin: float, is_person: bool, nearest: float
) -> None:
    """The goal is in a ball, which is a person or a thing."""
    arm, ball, config = PlanarArm(), balls((0.81, 0.39, 0.0)), ControlConfig(human_margin=human_margin)
    field = guard_people(ball, ball if is_person else None, config)
    controller = QpIkController(arm, config, field, frame="tip")
    goal = arm.frame_pose(np.array([0.4, 0.1]), "tip")
    _, postures = steps_towards(controller, np.array([-0.9, 0.3]), goal, 400)
    gaps = [ball.query(arm.sphere_centers(q)[1:])[0].min() - 0.04 for q in postures]
    assert abs(min(gaps) - nearest) < 2e-3


Q = np.array([0.0, 0.0])


def test_the_deepest_sphere_is_named_and_a_free_start_passes() -> None:
    """A sphere without a distance hides none that collides, and the base is moved by no joint."""
    arm, deep = PlanarArm(), Balls([[0.9, 0.0, 0.0], [0.25, 0.05, 0.0]], [0.1, 0.02])

    def partly_blank(points: Float64) -> tuple[Float64, Float64]:
        distance, gradient = deep.query(points)
        return np.where(points[:, 0] < 0.3, np.nan, distance), gradient

    for field in (deep, SimpleNamespace(query=partly_blank)):
        expect_refusal(r"got sphere fore\[1\] 0\.1400 m deep", check_free, arm, field, Q, error=NotEvaluableError)
    for center in ([0.9, 0.2, 0.0], [0.0, 0.0, 0.0]):
        check_free(arm, Balls([center], [0.1]), Q)


def test_only_spheres_that_no_joint_moves_are_static() -> None:
    arm, balls = PlanarArm(), Balls([[0.0, 0.1, 0.0]], [0.03])
    (violation,) = static_violations(arm, balls, Q, 0.02)
    assert (violation.sphere, violation.clearance) == ("base[0]", pytest.approx(0.01))
    assert static_violations(arm, balls, Q, 0.01 - 1e-9) == ()


def test_a_start_is_free_where_the_links_own_surface_is() -> None:
    """A ball 1 cm deep in a sphere alone, and one as deep in the surface."""
    for radius, depth in ((0.07, "0.0100"), (0.09, "0.0300")):
        centers, radii = [[0.9, 0.1, 0.0]], [radius]
        deep = ThinArm(), Balls(centers, radii), Q
        expect_refusal(f"sphere fore[1] {depth} m deep", check_free, *deep, error=NotEvaluableError)
    scene = scene_of(centers, radii)
    expect_refusal("sphere fore[1] 0.0100 m deep", check_free, *deep, scene, error=NotEvaluableError)
    check_free(ThinArm(), Balls(centers, [0.07]), Q, scene_of(centers, [0.07]))


@pytest.mark.parametrize(
    ("distance", "later", "broken"),
    [
        pytest.param([0.010, 0.000], [0.009, 0.015], [False, False], id="together they gain"),
        pytest.param([0.010, 0.000], [0.001, 0.001], [True, False], id="together they lose"),
        pytest.param([0.010, 0.100, 0.000], [0.009, 0.050, 0.015], [True, True, False], id="one is beyond"),
        pytest.param([0.010, 0.050], [0.019, 0.0195], [False, True], id="one comes within"),
        pytest.param([0.010, 0.100], [0.010, 0.100], [False, False], id="none moves"),
        pytest.param([0.100], [np.nan], [True], id="no distance"),
    ],
)
def test_rows_within_their_margins_may_lose_to_one_another_but_excuse_no_other_row(
    distance: list[float], later: list[float], broken: list[bool]
) -> None:
    """Of rows with a margin of 20 mm that promise not to lose anything."""
    none = np.zeros(len(distance))
    rows: Any = SimpleNamespace(distance=np.array(distance), margin=none + 0.02, h=none, spread=lambda slack: slack)
    controller: Any = SimpleNamespace(_config=ControlConfig())
    choice: Any = SimpleNamespace(slack=none)
    assert QpIkController._broken(controller, choice, rows, np.array(later)).tolist() == broken


FREE = [0.0, 0.5, 0.0]  # a ball far from the base


def everywhere(places: Float64) -> Bool:
    return np.ones(len(places), bool)


def looked(*scenes: DistanceFunction, arm: PlanarArm | None = None) -> dict[str, tuple[float, float]]:
    parts = FixedParts(arm or ThinArm(), 0.04)
    for scene in scenes:
        parts.look(scene, Q, everywhere)
    return parts.clearances


def beside(gap: float) -> DistanceFunction:
    """A scene with a ball of 1 cm, `gap` from the base's sphere."""
    return scene_of([FREE, [0.0, 0.06 + 0.01 + gap, 0.0]], [0.01, 0.01])


@pytest.mark.parametrize(
    ("gap", "later", "has_come"),
    [(0.1, 0.092, False), (0.1, 0.05, True), (0.03, 0.001, False), (0.03, -0.002, False), (0.03, -0.022, True)],
)
def test_what_moves_by_more_than_a_map_does_has_come(gap: float, later: float, has_come: bool) -> None:
    """By a centimetre, or by three beside a sphere at its mount. The surface is 2 cm within the sphere."""
    found = looked(beside(gap), beside(later), beside(later))["base[0]"]
    assert found == pytest.approx((gap, later + 0.02 if has_come else gap))


def test_spheres_say_how_near_a_link_without_triangles_is() -> None:
    class BallArm(PlanarArm):
        def surface_gaps(self, *_: object) -> dict[str, Float64]:
            return {}

    assert looked(beside(0.1), beside(0.0), beside(0.0), arm=BallArm())["base[0]"][1] == pytest.approx(0.0)


def test_what_is_seen_for_the_first_time_did_not_come_and_stands_there_from_then_on() -> None:
    parts, after = FixedParts(ThinArm(), 0.04), beside(0.0)
    parts.look(beside(0.4), Q, None)
    for seen in (lambda places: places[:, 1] > 0.3, everywhere, everywhere):
        parts.look(after, Q, seen)
    assert parts.clearances["base[0]"][1] == pytest.approx(0.4, abs=0.05)


def test_what_one_scene_alone_has_is_noise() -> None:
    """A thing that comes by 5 cm a scene is there in each; one that is elsewhere in the next was nowhere."""
    assert looked(beside(0.1), beside(0.0), beside(0.1), beside(0.0))["base[0]"][1] == pytest.approx(0.1)
    assert looked(*map(beside, (0.1, 0.06, 0.035, 0.01)))["base[0]"][1] == pytest.approx(0.03)


def test_each_sphere_has_what_is_nearest_to_it() -> None:
    """The base with a second sphere 30 cm away: what comes to one says nothing of the other."""
    arm = ThinArm()
    spheres = arm.sphere_set
    arm.sphere_set = SphereSet(
        links=("base", *spheres.links),
        centers=np.concatenate([[[-0.3, 0.0, 0.0]], spheres.centers]),
        radii=np.append(0.06, spheres.radii),
    )
    arm.moving_spheres = np.append(False, arm.moving_spheres)
    arm.sphere_centers = lambda q: np.concatenate([[[-0.3, 0.0, 0.0]], PlanarArm().sphere_centers(q)])  # type: ignore[method-assign]
    scene = scene_of([FREE, [0.0, 0.1, 0.0], [-0.3, 0.11, 0.0]], [0.01, 0.01, 0.01])
    found = looked(scene_of([FREE], [0.01]), scene, scene, arm=arm)
    assert [least for _, least in found.values()] == pytest.approx([0.06, 0.05])


def test_a_scene_of_no_balls_is_measured_from_the_spheres() -> None:
    far, near = (lambda points, d=d: np.full(len(points), d) for d in (0.2, 0.05))
    assert looked(far, near, arm=PlanarArm())["base[0]"] == (pytest.approx(0.14), pytest.approx(-0.01))

"""The scene as the controller takes it; what must hold before it runs, and what comes near fixed links."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import DistanceFunction
from splatctrl_cli.control.fixed_parts import FixedParts
from splatctrl_cli.control.preconditions import check_free, static_violations
from splatctrl_cli.control.replay import ReplayTask, SceneChange, closed_loop
from splatctrl_cli.control.scene_field import PeopleGrown, SceneStep, distance_rate, guarded
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.records import Float64, SphereSet
from tests.control.fakes import Balls, PlanarArm, Plane, ThinArm, scene_of

THING, PERSON = (0.6, 0.5, 0.0), (0.9, -0.4, 0.0)
POINTS = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.0]])


def balls(*middles: tuple[float, float, float]) -> Balls:
    """Balls of 5 cm."""
    return Balls(middles, [0.05] * len(middles))


def moved(speed: float, seconds: float = 0.2) -> SceneStep:
    """A wall ahead that came nearer by `speed`."""
    older, newer = (Plane([-1.0, 0.0, 0.0], offset) for offset in (-2.0, -2.0 + speed * seconds))
    return SceneStep(newer=newer, older=older, seconds=seconds)


def test_the_rate_of_a_wall_is_its_speed_towards_the_arm() -> None:
    np.testing.assert_allclose(distance_rate(moved(0.3), POINTS, 1.6), -0.3)


def test_a_wall_that_recedes_loosens_nothing_and_one_that_jumps_is_clipped() -> None:
    np.testing.assert_array_equal(distance_rate(moved(-0.3), POINTS, 1.6), 0.0)
    np.testing.assert_allclose(distance_rate(moved(5.0), POINTS, 1.6), -1.6)


def test_there_is_no_rate_without_two_scenes_or_without_a_distance() -> None:
    assert distance_rate(None, POINTS, 1.6) == 0.0

    class Nowhere:
        def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.full(len(points), np.nan), np.zeros_like(points)

    blind = SceneStep(newer=moved(0.3).newer, older=Nowhere(), seconds=0.2)
    np.testing.assert_array_equal(distance_rate(blind, POINTS, 1.6), 0.0)


@pytest.mark.parametrize("name", ["none", "snapshots"])
def test_a_scene_that_comes_nearer_is_met_with_more_distance_where_its_rate_is_known(name: str) -> None:
    arm, seconds = PlanarArm(), 0.1
    start = np.array([0.6, 0.6])
    fields = [Balls([[0.95 - 0.04 * k, 0.655, 0.0]], [0.1]) for k in range(8)]
    asked: list[int] = []

    def index(stamp_ns: int) -> int:
        return min(stamp_ns // 100_000_000, 7)

    def step_at(stamp_ns: int) -> SceneStep | None:
        asked.append(stamp_ns)
        k = index(stamp_ns)
        return None if k == 0 else SceneStep(newer=fields[k], older=fields[k - 1], seconds=seconds)

    config = replace(ControlConfig(), distance_rate=name, max_time=0.8, goal_position=0.002)
    out_of_plane = arm.frame_pose(start, "tip")
    out_of_plane[2, 3] += 0.005  # where the arm is and stays, and yet no goal that it reaches
    task = ReplayTask(start=start, T_world_goal=out_of_plane, frame="tip")
    trace = closed_loop(arm, config, task, lambda t: fields[index(t)], scene_step_at=step_at)
    least = min(step.clearance for step in trace.steps)
    assert bool(asked) is (name == "snapshots")
    if name == "none":
        assert least < 0.0  # each scene is 4 cm nearer than the last, which takes a static row by surprise
    else:
        assert least > 0.0 and max(asked) == trace.stamp_ns[-1]


def test_people_reach_as_much_farther_and_things_do_not() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    distance, _ = PeopleGrown(balls(THING, PERSON), balls(PERSON), 0.1).query(points)
    to_thing, to_person = balls(THING).query(points)[0], balls(PERSON).query(points)[0]
    np.testing.assert_allclose(distance, np.minimum(to_thing, to_person - 0.1), atol=1e-12)
    assert 50 < np.count_nonzero(to_person - 0.1 < to_thing) < 450


def test_its_gradient_is_the_slope_of_its_distance() -> None:
    field, step = PeopleGrown(balls(THING, PERSON), balls(PERSON), 0.1), 1e-6
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3))
    slope = np.stack(
        [(field.query(points + step * e)[0] - field.query(points - step * e)[0]) / (2 * step) for e in np.eye(3)],
        axis=1,
    )
    np.testing.assert_allclose(field.query(points)[1], slope, atol=1e-6)


def test_without_people_or_a_larger_margin_the_scene_is_what_counts() -> None:
    scene, people = balls(THING), balls(PERSON)
    assert guarded(scene, None, ControlConfig(human_margin=0.3)) is scene
    assert guarded(scene, people, ControlConfig()) is scene
    assert guarded(scene, people, ControlConfig(margin=0.05, human_margin=0.05)) is scene
    assert guarded(scene, people, ControlConfig(human_margin=0.3)) is not scene


def closest_way(margins: ControlConfig, who: str) -> float:
    """How near the arm's surface comes to a ball at its goal, which is a person or a thing."""
    arm, ball = PlanarArm(), balls((0.81, 0.39, 0.0))
    people = ball if who == "person" else None
    controller = QpIkController(arm, margins, guarded(ball, people, margins), frame="tip")
    q, goal, least = np.array([-0.9, 0.3]), arm.frame_pose(np.array([0.4, 0.1]), "tip"), np.inf
    for _ in range(400):
        q = q + margins.period * controller.step(q, goal).velocity
        least = min(least, float(np.min(ball.query(arm.sphere_centers(q)[1:])[0] - 0.04)))
    return least


def test_the_controller_stays_farther_from_a_person_than_from_a_thing() -> None:
    margins = ControlConfig(human_margin=0.12)
    assert abs(closest_way(margins, "thing") - 0.02) < 2e-3
    assert abs(closest_way(margins, "person") - 0.12) < 2e-3
    assert abs(closest_way(ControlConfig(), "person") - 0.02) < 2e-3


Q = np.array([0.0, 0.0])


class PartlyBlank:
    """Balls whose distance is not known at x < 0.3, where the spheres that come first are."""

    def __init__(self, balls: Balls) -> None:
        self._balls = balls

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance, gradient = self._balls.query(points)
        return np.where(points[:, 0] < 0.3, np.nan, distance), gradient


def test_a_sphere_without_a_distance_hides_no_sphere_that_collides() -> None:
    with pytest.raises(NotEvaluableError, match=r"got sphere fore\[1\] 0\.0800 m deep"):
        check_free(PlanarArm(), PartlyBlank(Balls([[0.9, 0.0, 0.0]], [0.04])), Q)


def test_the_deepest_sphere_is_named_and_a_free_start_passes() -> None:
    deep = Balls([[0.9, 0.0, 0.0], [0.25, 0.05, 0.0]], [0.1, 0.02])
    with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0\.1400 m deep"):
        check_free(PlanarArm(), deep, Q)
    check_free(PlanarArm(), Balls([[0.9, 0.2, 0.0]], [0.1]), Q)
    check_free(PlanarArm(), Balls([[0.0, 0.0, 0.0]], [0.1]), Q)  # in the base, which no joint moves


def test_only_spheres_that_no_joint_moves_are_static() -> None:
    arm, balls = PlanarArm(), Balls([[0.0, 0.1, 0.0]], [0.03])
    (violation,) = static_violations(arm, balls, Q, 0.02)
    assert (violation.sphere, violation.clearance) == ("base[0]", pytest.approx(0.01))
    assert static_violations(arm, balls, Q, 0.01 - 1e-9) == ()


def test_a_start_is_free_where_the_links_own_surface_is() -> None:
    for radius, is_free in ((0.07, True), (0.09, False)):  # 1 cm deep in a sphere and in its surface
        centers, radii = [[0.9, 0.1, 0.0]], [radius]
        balls, scene = Balls(centers, radii), scene_of(centers, radii)
        with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0\.0[13]00 m deep"):
            check_free(ThinArm(), balls, Q)
        if is_free:
            check_free(ThinArm(), balls, Q, scene)
            continue
        with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0\.0100 m deep"):
            check_free(ThinArm(), balls, Q, scene)


@pytest.mark.parametrize(
    ("before", "after", "is_hit"),
    [(0.1, -0.01, True), (0.0, -1e-6, True), (-0.01, -0.02, False), (0.1, 0.0, False), (-0.02, 0.01, False)],
)
def test_only_a_scene_that_newly_comes_into_the_arm_is_a_hit(before: float, after: float, is_hit: bool) -> None:
    assert SceneChange(stamp_ns=0, before=before, after=after).is_hit == is_hit


def broken_rows(distance: list[float], later: list[float]) -> list[bool]:
    """Of rows with a margin of 20 mm that promise not to lose anything."""
    num = len(distance)
    rows = SimpleNamespace(
        distance=np.array(distance), margin=np.full(num, 0.02), h=np.zeros(num), spread=lambda slack: np.zeros(num)
    )
    controller: Any = SimpleNamespace(_config=ControlConfig())
    choice: Any = SimpleNamespace(slack=np.zeros(num))
    return QpIkController._broken(controller, choice, rows, np.array(later)).tolist()  # type: ignore[arg-type]


def test_rows_within_their_margins_may_lose_to_one_another_but_excuse_no_other_row() -> None:
    assert broken_rows([0.010, 0.000], [0.009, 0.015]) == [False, False]  # together they gain
    assert broken_rows([0.010, 0.000], [0.001, 0.001]) == [True, False]  # together they lose
    assert broken_rows([0.010, 0.100, 0.000], [0.009, 0.050, 0.015]) == [
        True,
        True,
        False,
    ]  # one is beyond
    assert broken_rows([0.010, 0.100], [0.010, 0.100]) == [False, False]
    assert broken_rows([0.100], [float("nan")]) == [True]


FREE = [0.0, 0.5, 0.0]  # a ball far from the base


def looked(*scenes: DistanceFunction, arm: PlanarArm | None = None) -> dict[str, tuple[float, float]]:
    parts = FixedParts(arm or ThinArm(), 0.04)
    for scene in scenes:
        parts.look(scene, Q, lambda places: np.ones(len(places), bool))
    return parts.found


def beside(gap: float) -> DistanceFunction:
    """A scene with a ball of 1 cm, `gap` from the base's sphere."""
    return scene_of([FREE, [0.0, 0.06 + 0.01 + gap, 0.0]], [0.01, 0.01])


@pytest.mark.parametrize(
    ("gap", "later", "has_come"),
    [(0.1, 0.092, False), (0.1, 0.05, True), (0.03, 0.001, False), (0.03, -0.002, False), (0.03, -0.022, True)],
)
def test_what_moves_by_more_than_a_map_does_has_come(gap: float, later: float, has_come: bool) -> None:
    """By a centimetre, or by three beside a sphere at its mount. The surface is 2 cm within the sphere."""
    found = looked(beside(gap), beside(later), beside(later))
    first, least = found["base[0]"]
    assert first == pytest.approx(gap)
    assert least == pytest.approx(later + 0.02 if has_come else gap)


def test_spheres_say_how_near_a_link_without_triangles_is() -> None:
    class BallArm(PlanarArm):
        def surface_gaps(self, *_: object) -> dict[str, Float64]:
            return {}

    assert looked(beside(0.1), beside(0.0), beside(0.0), arm=BallArm())["base[0]"][1] == pytest.approx(0.0)


def test_what_is_seen_for_the_first_time_did_not_come_and_stands_there_from_then_on() -> None:
    parts, before, after = FixedParts(ThinArm(), 0.04), beside(0.4), beside(0.0)
    parts.look(before, Q, None)
    parts.look(after, Q, lambda places: places[:, 1] > 0.3)
    for _ in range(2):
        parts.look(after, Q, lambda places: np.ones(len(places), bool))
    assert parts.found["base[0]"][1] == pytest.approx(0.4, abs=0.05)


def test_what_one_scene_alone_has_is_noise() -> None:
    """A thing that comes by 5 cm a scene is there in each; one that is elsewhere in the next was nowhere."""
    assert looked(beside(0.1), beside(0.0), beside(0.1), beside(0.0))["base[0]"][1] == pytest.approx(0.1)
    coming = [beside(gap) for gap in (0.1, 0.06, 0.035, 0.01)]
    assert looked(*coming)["base[0]"][1] == pytest.approx(0.03)


def test_each_sphere_has_what_is_nearest_to_it() -> None:
    """The base with a second sphere 30 cm away: what comes to one says nothing of the other."""
    arm, second = ThinArm(), [-0.3, 0.0, 0.0]
    spheres, own = arm.sphere_set, arm.sphere_centers
    arm.sphere_set = SphereSet(
        links=("base", *spheres.links),
        centers=np.concatenate([[second], spheres.centers]),
        radii=np.append(0.06, spheres.radii),
    )
    arm.moving_spheres = np.append(False, arm.moving_spheres)

    def centers_at(q: Float64) -> Float64:
        arm.sphere_set, both = spheres, arm.sphere_set
        centers = np.concatenate([[second], own(q)])
        arm.sphere_set = both
        return centers

    arm.sphere_centers = centers_at  # type: ignore[method-assign]
    scene = scene_of([FREE, [0.0, 0.1, 0.0], [-0.3, 0.11, 0.0]], [0.01, 0.01, 0.01])
    found = looked(scene_of([FREE], [0.01]), scene, scene, arm=arm)
    assert [least for _, least in found.values()] == pytest.approx([0.06, 0.05])


def test_a_scene_of_no_balls_is_measured_from_the_spheres() -> None:
    far, near = (lambda points, d=d: np.full(len(points), d) for d in (0.2, 0.05))
    assert looked(far, near, arm=PlanarArm())["base[0]"] == (pytest.approx(0.14), pytest.approx(-0.01))

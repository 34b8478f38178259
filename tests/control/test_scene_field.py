"""The scene as the controller takes it: its rate is of the past alone and only tightens, and people reach farther."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.replay import ReplayTask, closed_loop
from splatctrl_cli.control.scene_field import PeopleGrown, SceneStep, distance_rate, guarded
from splatctrl_cli.control.step import QpIkController
from tests.control.fakes import Balls, PlanarArm, Plane

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

"""A larger margin for people: the grown field, and the controller in it."""

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.people import PeopleGrown, guarded
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm


class Balls:
    """The distance to balls of 5 cm."""

    def __init__(self, *middles: tuple[float, float, float]) -> None:
        self._middles = np.array(middles)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        away = points[:, None] - self._middles
        gap = np.linalg.norm(away, axis=2)
        nearest, rows = np.argmin(gap, axis=1), np.arange(len(points))
        return gap[rows, nearest] - 0.05, away[rows, nearest] / gap[rows, nearest, None]


THING, PERSON = (0.6, 0.5, 0.0), (0.9, -0.4, 0.0)


def test_people_reach_as_much_farther_and_things_do_not() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    distance, _ = PeopleGrown(Balls(THING, PERSON), Balls(PERSON), 0.1).query(points)
    to_thing, to_person = Balls(THING).query(points)[0], Balls(PERSON).query(points)[0]
    np.testing.assert_allclose(distance, np.minimum(to_thing, to_person - 0.1), atol=1e-12)
    assert 50 < np.count_nonzero(to_person - 0.1 < to_thing) < 450


def test_its_gradient_is_the_slope_of_its_distance() -> None:
    field, step = PeopleGrown(Balls(THING, PERSON), Balls(PERSON), 0.1), 1e-6
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3))
    slope = np.stack(
        [(field.query(points + step * e)[0] - field.query(points - step * e)[0]) / (2 * step) for e in np.eye(3)],
        axis=1,
    )
    np.testing.assert_allclose(field.query(points)[1], slope, atol=1e-6)


def test_without_people_or_a_larger_margin_the_scene_is_what_counts() -> None:
    scene, people = Balls(THING), Balls(PERSON)
    assert guarded(scene, None, ControlConfig(human_margin=0.3)) is scene
    assert guarded(scene, people, ControlConfig()) is scene
    assert guarded(scene, people, ControlConfig(margin=0.05, human_margin=0.05)) is scene
    assert guarded(scene, people, ControlConfig(human_margin=0.3)) is not scene


def closest_way(margins: ControlConfig, who: str) -> float:
    """How near the arm's surface comes to a ball at its goal, which is a person or a thing."""
    arm, ball = PlanarArm(), Balls((0.81, 0.39, 0.0))
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

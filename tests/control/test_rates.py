"""dd/dt from snapshots: from the past alone, and only ever tightening."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.rates import SceneStep, distance_rate
from splatctrl_cli.control.replay import ReplayTask, closed_loop
from tests.control.fakes import Balls, PlanarArm, Plane

POINTS = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.0]])


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

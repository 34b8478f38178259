"""Lengths of a path, a least clearance proved between its waypoints, and that it comes to its end where followed."""

import numpy as np
import pytest

from experiments.paths import effector_length, joint_length, least_clearance
from experiments.tracking import follow_joints, follow_with_controller
from splatctrl_cli.config import ControlConfig, PlannerConfig
from splatctrl_cli.control.goals import pose_error
from splatctrl_cli.control.replay import is_at_goal
from splatctrl_cli.planner.birrt import plan
from splatctrl_cli.planner.planned import resample, time_path
from tests.control.fakes import Balls, PlanarArm
from tests.planner.walls import clearance, one_wall, thin_post

PATH = np.array([[0.7, 0.2], [0.9, 2.0], [-0.4, 1.5], [-0.42, 1.5]])
ARM = PlanarArm()


def test_a_path_is_followed_to_its_end_by_the_joints() -> None:
    room = clearance(one_wall(), margin=0.02)
    planned = plan(room, np.array([0.7, 0.2]), np.array([-0.7, -0.2]), PlannerConfig())
    path = time_path(planned.waypoints, ARM.velocity_limit, 7.5)
    position = follow_joints(path, ARM, ControlConfig())
    np.testing.assert_allclose(position[-1], planned.waypoints[-1], atol=1e-3)
    assert joint_length(position) == pytest.approx(joint_length(planned.waypoints), rel=1e-3)
    assert ControlConfig().period * (len(position) - 1) == pytest.approx(path.duration, abs=0.011)
    assert np.min(room.at(position)) >= least_clearance(room, planned.waypoints).lower - 1e-3


def test_a_path_is_followed_to_its_end_by_the_controller() -> None:
    room = clearance(thin_post(), margin=0.03)  # more than the controller's own margin, which may not give way
    field = Balls([[0.62, 0.31, 0.0]], [0.002])
    planned = plan(room, np.array([1.2, 0.3]), np.array([-0.4, 0.5]), PlannerConfig())
    path = time_path(planned.waypoints, ARM.velocity_limit / 3, 3.0)
    config = ControlConfig()
    position, steps = follow_with_controller(path, ARM, lambda stamp_ns: field, "tip", PlannerConfig(), config)
    arrived = pose_error(ARM.frame_pose(position[-1], "tip"), ARM.frame_pose(path.waypoints[-1], "tip"))
    assert is_at_goal(arrived, config) and len(steps) == len(position) - 1
    assert np.min(room.at(position)) > -0.01 - 1e-3  # of 0.03: the controller keeps 0.02


def test_lengths_are_those_of_an_arc() -> None:
    turn = resample(np.array([[-0.5, 0.0], [0.5, 0.0]]), 0.01)
    assert joint_length(turn) == pytest.approx(1.0)
    moved, turned = effector_length(ARM, turn, "tip")
    assert moved == pytest.approx(0.9, rel=1e-4)
    assert turned == pytest.approx(np.degrees(1.0))


@pytest.mark.parametrize("room", [one_wall(), thin_post()], ids=["wall", "needle"])
def test_the_least_clearance_lies_between_its_bounds(room: object) -> None:
    free = clearance(room)  # type: ignore[arg-type]
    proved = least_clearance(free, PATH, tolerance=1e-4)
    dense = float(np.min(free.at(resample(PATH, 1e-4))))
    assert proved.lower <= dense <= proved.upper + 1e-6 and proved.upper - proved.lower <= 1e-4
    assert proved.num_checks < 2000

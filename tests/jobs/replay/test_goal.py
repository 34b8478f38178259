"""A goal configuration: the joints that the controller drives, with a gripper's fingers or without."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.jobs.replay.goal import goal_waypoints
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.model import RobotModel
from tests.robot.test_fingers import ARM, FRANKA, robot

END = np.array([0.01, 0.02, 0.03, 0.04])  # of shoulder, wrist and two fingers


def goal(folder: Path, moved: list[str], *values: float) -> Float64:
    urdf = robot(folder, *ARM, *FRANKA)
    spheres = SphereSet(links=("l",), centers=np.zeros((1, 3)), radii=np.full(1, 0.01))
    model = RobotModel.from_urdf(urdf, spheres).moved_by(moved)
    request = ReplayRequest(log=urdf, urdf=urdf, out=urdf, mode="closed-loop", goal_joints=values)
    (waypoint,) = goal_waypoints(request, model, "hand", END[: model.num_joints])
    assert waypoint.posture is not None
    assert waypoint.T_world_goal.tolist() == model.frame_pose(waypoint.posture, "hand").tolist()
    return waypoint.posture


def test_fingers_that_the_log_does_not_move_take_no_value(tmp_path: Path) -> None:
    assert goal(tmp_path, ["shoulder", "wrist"], 0.03, 0.04).tolist() == [0.03, 0.04]


def test_fingers_that_the_log_knows_stay_as_logged_at_the_end_or_take_values(tmp_path: Path) -> None:
    moved = ["shoulder", "wrist", "left", "right"]
    assert goal(tmp_path, moved, 0.03, 0.04).tolist() == [0.03, 0.04, 0.03, 0.04]
    assert goal(tmp_path, moved, 0.03, 0.04, 0.0, 0.01).tolist() == [0.03, 0.04, 0.0, 0.01]


def test_another_number_of_values_is_refused_with_the_joints(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--goal-joints: expected 2 joints \(shoulder, wrist\), got shape \(4,\)"):
        goal(tmp_path, ["shoulder", "wrist"], 0, 0, 0, 0)

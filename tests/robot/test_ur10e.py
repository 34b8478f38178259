"""The UR10e: kinematics against the product of its Denavit-Hartenberg matrices, cuRobo's spheres, a closed loop."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.replay import Outcome, ReplayTask, closed_loop
from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import self_collision_pairs
from splatctrl_cli.robot.sphere_files import read_sphere_file
from tests.control.fakes import Balls
from tests.robot.shapes import flange, ur10e_urdf, written

READY = np.array([0.0, -2.2, 1.9, -1.383, -1.57, 0.0])  # cuRobo's default posture


@pytest.fixture
def spheres(real_data: Path) -> Path:
    return real_data / "robot_spheres" / "curobo" / "curobo" / "content" / "configs" / "robot" / "ur10e.yml"


def test_the_flange_is_where_the_published_parameters_say(tmp_path: Path) -> None:
    point = SphereSet(links=("tool0",), centers=np.array([[0.1, 0.0, 0.2]]), radii=np.array([0.01]))
    model = RobotModel.from_urdf(written(tmp_path, ur10e_urdf()), point)
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (50, 6)):
        np.testing.assert_allclose(model.frame_pose(q, "tool0"), flange(q), atol=1e-12)
        np.testing.assert_allclose(model.sphere_centers(q)[0], (flange(q) @ [0.1, 0.0, 0.2, 1.0])[:3], atol=1e-12)
    np.testing.assert_allclose(model.velocity_limit, [2.0944] * 2 + [3.1416] * 4)


def test_curobos_spheres_fit_its_links(tmp_path: Path, spheres: Path) -> None:
    model = RobotModel.from_urdf(written(tmp_path, ur10e_urdf()), spheres)
    assert (len(model.sphere_set.radii), read_sphere_file(spheres).num_off) == (19, 1)
    assert model.left_out == ("camera_mount",) and not model.are_links_renamed
    still = [link for link, moves in zip(model.sphere_set.links, model.moving_spheres, strict=True) if not moves]
    assert still == ["shoulder_link"]  # its sphere is centred on the first axis
    found = {pair.links: pair.left_out for pair in self_collision_pairs(model, num_postures=200).link_pairs}
    assert found["wrist_1_link", "wrist_2_link"] == "adjacent" and found["upper_arm_link", "wrist_3_link"] is None


def test_a_closed_loop_keeps_its_margin(tmp_path: Path, spheres: Path) -> None:
    model = RobotModel.from_urdf(written(tmp_path, ur10e_urdf()), spheres)
    goal = model.frame_pose(READY + np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0]), "tool0")
    start, end = model.frame_pose(READY, "tool0")[:3, 3], goal[:3, 3]
    ball = Balls([(start + end) / 2 - [0.0, 0.0, 0.17]], [0.06])
    task = ReplayTask(start=READY, T_world_goal=goal, frame="tool0", home=READY)
    trace = closed_loop(model, ControlConfig(solver="daqp", max_acceleration=10.0), task, lambda stamp: ball)
    assert trace.outcome is Outcome.GOAL_REACHED and min(step.clearance for step in trace.steps) >= 0.02 - 2e-4
    assert any(step.intervening for step in trace.steps)
    velocity = np.array([np.zeros(6), *(step.velocity for step in trace.steps)])
    assert np.abs(np.diff(velocity, axis=0)).max() <= 0.1 + 1e-9


def test_a_robot_without_meshes_is_shown_and_cannot_be_measured(
    tmp_path: Path, spheres: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = ["--urdf", str(written(tmp_path, ur10e_urdf())), "--spheres", str(spheres)]
    assert main(["robot", "info", *robot]) == 0
    told = capsys.readouterr().out
    assert "6 joints, in rad, m and s; 19 spheres" in told and "spheres of camera_mount are left out" in told
    assert main(["robot", "check", *robot]) == 4
    assert "expected collision geometry, got none" in capsys.readouterr().err

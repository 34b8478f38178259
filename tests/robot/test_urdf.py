"""What the URDF reader takes from joints: limits, mimics, rigid bodies, locks by value and by followers."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import read_urdf, visual_urdf
from tests.refused import expect_refusal
from tests.robot.shapes import BALL, BOX, ROD, arm_of, written

LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
NO_SPHERES = SphereSet(links=(), centers=np.zeros((0, 3)), radii=np.zeros(0))


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("", "revolute: expected limits, got none; write <limit lower"),
        ('<limit effort="1" velocity="1"/>', "limits: expected lower < upper, got 0 and 0"),
        ('<limit lower="1" upper="-1" velocity="1"/>', "limits: expected lower < upper, got 1 and -1"),
        ('<limit lower="-1" upper="1"/>', "limits: expected velocity, got none"),
        ('<limit lower="-1" upper="1" velocity="1"/>', "limits: expected effort, got none"),
        ('<limit lower="-1" upper="1" velocity="0" effort="1"/>', "limits: expected a velocity above 0, got 0"),
        ('<limit lower="a" upper="1" velocity="1"/>', "limit lower: expected 1 number, got 'a'"),
        ('<limit lower="-1" upper="nan" velocity="1"/>', "limit upper: expected 1 number, got 'nan'"),
    ],
)
def test_joints_without_proper_limits_are_refused(tmp_path: Path, limit: str, message: str) -> None:
    expect_refusal(
        f"robot.urdf: joint 'hinge': {message}",
        read_urdf,
        written(tmp_path, arm_of(BALL, BALL).replace(LIMIT, limit)),
    )


def test_a_joint_that_mimics_is_locked_with_its_leader(tmp_path: Path) -> None:
    text = arm_of(BALL, BALL).replace(
        "</robot>",
        '<link name="finger"/><joint name="follower" type="prismatic"><parent link="tip"/><child link="finger"/>'
        '<axis xyz="1 0 0"/><limit lower="-9" upper="9" velocity="1" effort="1"/>'
        '<mimic joint="slide" multiplier="-2" offset="0.5"/></joint>'
        '<link name="thumb"/><joint name="slide" type="prismatic"><parent link="tip"/><child link="thumb"/>'
        '<axis xyz="1 0 0"/><limit lower="-9" upper="9" velocity="1" effort="1"/></joint></robot>',
    )
    path = written(tmp_path, text)
    assert read_urdf(path).add_followers({"slide": 0.1}) == {"follower": pytest.approx(0.3), "slide": 0.1}
    assert read_urdf(path).add_followers({"slide": 0.1, "follower": 0.0})["follower"] == 0.0
    model = RobotModel.from_urdf(path, locked={"slide": 0.1})
    assert model.joint_names == ("hinge",) and model.frame_pose(np.zeros(1), "finger")[0, 3] == pytest.approx(0.3)
    assert model.frame_pose(np.zeros(1), "thumb")[0, 3] == pytest.approx(0.1)


def test_a_robot_loads_with_a_set_of_spheres_or_none_at_all(tmp_path: Path) -> None:
    path = written(tmp_path, arm_of(BOX, BALL))
    assert RobotModel.from_urdf(path, NO_SPHERES).bare_links == ("base", "tip")
    model = RobotModel.from_urdf(
        path, SphereSet(links=("tip",), centers=np.array([[0, 0, 0.1]]), radii=np.array([0.1]))
    )
    np.testing.assert_allclose(model.sphere_centers(np.array([np.pi / 2])), [[0.1, 0, 0.3]], atol=1e-12)
    expect_refusal(
        "sphere set: none of its links is in",
        RobotModel.from_urdf,
        path,
        SphereSet(links=("wing",), centers=np.zeros((1, 3)), radii=np.ones(1)),
    )


@pytest.mark.parametrize(
    ("name", "locked", "num_meshes"),
    [
        ("vamp_panda/resources/panda/panda.urdf", {}, 11),
        ("franka_description/expanded/fr3.urdf", {}, 8),
        ("franka_description/expanded/fr3_hand.urdf", {"fr3_finger_joint1": 0.04}, 9),
    ],
)
def test_real_arms_load_with_seven_joints(
    real_data: Path, name: str, locked: dict[str, float], num_meshes: int
) -> None:
    model = RobotModel.from_urdf(real_data / name, NO_SPHERES, locked=locked)
    assert model.num_joints == 7 and len(model.urdf.meshes) == num_meshes and np.all(model.lower < model.upper)


def test_the_hand_of_a_real_arm_moves_with_its_last_link(real_data: Path) -> None:
    bodies = read_urdf(real_data / "franka_description/expanded/fr3_hand.urdf").rigid_bodies()
    leader, T = bodies["fr3_hand"]
    assert leader == "fr3_link7"
    np.testing.assert_allclose(T[:3, 3], [0, 0, 0.107], atol=1e-12)
    assert T[0, 0] == pytest.approx(np.cos(np.pi / 4))
    assert bodies["fr3_leftfinger"][0] == "fr3_leftfinger"


def test_a_robot_is_seen_by_its_visual_geometry_and_where_it_has_none_by_what_collides(tmp_path: Path) -> None:
    visual = f'<link name="base"><visual><geometry>{ROD}</geometry></visual>'
    urdf = read_urdf(written(tmp_path, arm_of(BOX, BALL).replace('<link name="base">', visual)))
    assert [(s.link, s.kind) for s in urdf.shapes] == [("base", "box"), ("tip", "sphere")]
    assert [(s.link, s.kind) for s in visual_urdf(urdf).shapes] == [("base", "cylinder"), ("tip", "sphere")]

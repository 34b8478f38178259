"""Which joints are a gripper's, and where they stand when a log does not move them."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import read_urdf
from tests.refused import expect_refusal
from tests.robot.shapes import written

ARM = (("shoulder", "revolute", "base", "upper", ""), ("wrist", "revolute", "upper", "hand", ""))
FRANKA = (("left", "prismatic", "hand", "l", ""), ("right", "prismatic", "hand", "r", '<mimic joint="left"/>'))
WSG = (("left", "prismatic", "hand", "l", ""), ("right", "prismatic", "hand", "r", ""))
ROBOTIQ = (
    ("knuckle", "revolute", "hand", "l", ""),
    ("other", "revolute", "hand", "r", '<mimic joint="knuckle" multiplier="-1"/>'),
    ("tip", "revolute", "l", "tip", '<mimic joint="knuckle" multiplier="0.5" offset="0.1"/>'),
)
SCARA = (("lift", "prismatic", "hand", "l", ""),)
GANTRY = (  # two carriages on one rail, an arm on either
    ("a", "prismatic", "rail", "carriage_a", ""),
    ("b", "prismatic", "rail", "carriage_b", ""),
    ("arm_a", "revolute", "carriage_a", "tool_a", ""),
    ("arm_b", "revolute", "carriage_b", "tool_b", ""),
)
TWO_ARMS = (("left", "revolute", "hand", "l", ""), ("right", "revolute", "hand", "r", ""))


def robot(folder: Path, *joints: tuple[str, str, str, str, str]) -> Path:
    links = dict.fromkeys(link for _, _, parent, child, _ in joints for link in (parent, child))
    parts = [f'<link name="{link}"/>' for link in links]
    parts += [
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 0.1"/>'
        f'<axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="1" effort="1"/>{more}</joint>'
        for name, kind, parent, child, more in joints
    ]
    return written(folder, f'<robot name="r">{"".join(parts)}</robot>')


@pytest.mark.parametrize(
    ("joints", "moved", "fingers"),
    [
        ((*ARM, *FRANKA), ["shoulder", "wrist"], ("left", "right")),
        ((*ARM, *WSG), ["shoulder", "wrist"], ("left", "right")),
        ((*ARM, *ROBOTIQ), ["shoulder", "wrist"], ("knuckle", "other", "tip")),
        ((*ARM, *SCARA), ["shoulder", "wrist"], ()),
        ((*ARM, *TWO_ARMS), ["shoulder", "wrist"], ()),
        (GANTRY, ["a", "arm_a"], ()),
        ((*ARM, *FRANKA), ["shoulder", "wrist", "left"], ()),
        ((*ARM, *FRANKA), ["shoulder", "wrist", "right"], ()),
        ((*ARM, *FRANKA), [], ()),
        ((*ARM, *FRANKA), ["left"], ()),
    ],
)
def test_fingers_are_what_a_log_leaves_that_moves_the_arm_and_nothing_else(
    tmp_path: Path, joints: tuple[tuple[str, str, str, str, str], ...], moved: list[str], fingers: tuple[str, ...]
) -> None:
    assert read_urdf(robot(tmp_path, *joints)).fingers(moved) == fingers


def test_fingers_are_locked_in_their_middle_and_what_mimics_them_follows(tmp_path: Path) -> None:
    spheres = SphereSet(links=("l", "r", "tip"), centers=np.zeros((3, 3)), radii=np.full(3, 0.01))
    whole = RobotModel.from_urdf(robot(tmp_path, *ARM, *ROBOTIQ), spheres)
    held = whole.moved_by(["wrist", "shoulder"])
    assert held.joint_names == ("shoulder", "wrist")
    assert held.locked == {"knuckle": 0.02, "other": -0.02, "tip": pytest.approx(0.11)}
    (said,) = held.doubts
    assert said.startswith("fingers without logged states are locked halfway: ")
    assert "knuckle = 0.02" in said and "--lock" in said
    q = {"shoulder": 0.01, "wrist": 0.03, **held.locked}
    same = whole.sphere_centers(np.array([q[name] for name in whole.joint_names]))
    np.testing.assert_allclose(held.sphere_centers(np.array([0.01, 0.03])), same, atol=1e-12)
    assert whole.moved_by(whole.joint_names) is whole


def test_a_joint_of_the_arm_that_the_log_lacks_is_not_locked(tmp_path: Path) -> None:
    spheres = SphereSet(links=("l",), centers=np.zeros((1, 3)), radii=np.full(1, 0.01))
    model = RobotModel.from_urdf(robot(tmp_path, *ARM, *FRANKA), spheres).moved_by(["shoulder"])
    expect_refusal("joints not in the log: wrist; the log has: shoulder", model.joint_columns, ["shoulder"])

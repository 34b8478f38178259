"""Logged states against a robot: degrees, and end-effector poses beside forward kinematics."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.checks.check_states import PoseVerdict, check_angles, pose_agreement, robot_findings
from splatctrl_cli.checks.finding import Severity
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.records import Float64, JointState
from splatctrl_cli.robot.model import RobotModel

SAMPLE = Path(__file__).parents[2] / "sample_data" / "tabletop"
TOOL = transform_from([0.01, -0.02, 0.1], [0.0, 0.0, np.sin(0.4), np.cos(0.4)])


@pytest.fixture(scope="module")
def model() -> RobotModel:
    T_world_base = transform_from([0.1, 0.2, 0.3], [0.0, 0.0, np.sin(0.3), np.cos(0.3)])
    return RobotModel.from_urdf(SAMPLE / "robot.urdf", SAMPLE / "robot_spheres.yaml", T_world_base=T_world_base)


def motion(model: RobotModel, num: int = 60, amplitude: float = 0.5) -> Float64:
    """Postures (T, J) about the middle of the limits, every joint at its own rate."""
    phase = np.linspace(0, 3, num)[:, None] * np.arange(1, model.num_joints + 1)
    return np.asarray(model.middle + amplitude * np.sin(phase))


def states_with(q: Float64, T_base_ee: Callable[[Float64], Float64 | None]) -> list[JointState]:
    return [
        JointState(stamp_ns=i, position=row, velocity=np.zeros(len(row)), T_base_ee=T_base_ee(row))
        for i, row in enumerate(q)
    ]


def in_base(model: RobotModel, q: Float64, link: str) -> Float64:
    return np.asarray(np.linalg.inv(model.T_world_base) @ model.frame_pose(q, link))


def test_no_logged_pose_says_nothing(model: RobotModel) -> None:
    states = [JointState(stamp_ns=0, position=model.middle, velocity=np.zeros(model.num_joints))]
    assert pose_agreement(model, states) is None


def test_poses_of_a_link_agree_with_it(model: RobotModel) -> None:
    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: in_base(model, q, link)))
    assert found is not None
    assert found.verdict is PoseVerdict.AGREE
    assert found.link == link
    assert found.num_poses == 60
    assert found.difference.max_position < 1e-9
    assert found.difference.max_rotation < 1e-6


def test_world_poses_are_not_moved_by_the_base(model: RobotModel) -> None:
    link = model.frame_names[-1]
    states = [
        JointState(stamp_ns=i, position=q, velocity=q, T_world_ee=model.frame_pose(q, link))
        for i, q in enumerate(motion(model))
    ]
    found = pose_agreement(model, states)
    assert found is not None
    assert found.verdict is PoseVerdict.AGREE


def test_a_constant_transform_in_the_hand_is_a_tool(model: RobotModel) -> None:
    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: in_base(model, q, link) @ TOOL))
    assert found is not None
    assert found.verdict is PoseVerdict.TOOL
    in_link = np.linalg.inv(model.frame_pose(model.middle, found.link)) @ model.frame_pose(model.middle, link) @ TOOL
    assert found.offset == pytest.approx(in_link, abs=1e-6)
    assert found.rest.max_position < 1e-6
    assert "a flange or tool transform" in found.sentence


def test_a_constant_transform_in_the_world_is_a_wrong_base(model: RobotModel) -> None:
    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: TOOL @ in_base(model, q, link)))
    assert found is not None
    assert found.verdict is PoseVerdict.BASE
    in_world = model.T_world_base @ TOOL @ np.linalg.inv(model.T_world_base)
    assert found.offset == pytest.approx(in_world, abs=1e-6)
    assert "is --base right?" in found.sentence


@pytest.mark.parametrize("fault", ["order", "degrees", "zero"])
def test_what_no_constant_transform_explains_is_another_robot(model: RobotModel, fault: str) -> None:
    def wrong(q: Float64) -> Float64:
        return {"order": q[::-1], "degrees": np.degrees(q), "zero": q * np.where(np.arange(len(q)) == 2, -1, 1)}[
            fault
        ]

    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: in_base(model, wrong(q), link)))
    assert found is not None
    assert found.verdict is PoseVerdict.DISAGREE
    assert found.rest.max_position > 0.02
    assert "wrong URDF, joint order, or units?" in found.sentence


def test_a_robot_that_stands_still_does_not_tell_a_tool_from_another_robot(model: RobotModel) -> None:
    link = model.frame_names[-1]
    q = motion(model, amplitude=1e-4)
    found = pose_agreement(model, states_with(q, lambda q: in_base(model, q, link) @ TOOL))
    assert found is not None
    assert found.verdict is PoseVerdict.STILL


def test_degrees_are_refused_and_radians_are_not(model: RobotModel) -> None:
    q = motion(model)
    zero = np.zeros(model.num_joints)

    def states(positions: Float64) -> list[JointState]:
        return [JointState(stamp_ns=i, position=row, velocity=zero) for i, row in enumerate(positions)]

    check_angles(model, states(q), "log")
    check_angles(model, states(q + 1.0), "log")  # beyond limits is for the audit to say
    check_angles(model, states(q[:, ::-1]), "log")  # another joint order
    check_angles(model, states(np.degrees(q) * 100), "log")  # degrees of no posture of this robot either
    with pytest.raises(InputError, match=r"log: joint .* which would fit as degrees") as caught:
        check_angles(model, states(np.degrees(q)), "log")
    assert 'unit = "deg"' in caught.value.remedy


def test_states_beyond_the_limits_are_a_warning_with_the_joint(model: RobotModel) -> None:
    q = motion(model)
    assert robot_findings(model, states_with(q, lambda _: None), "joint states") == []
    q[7, 3] = model.upper[3] + 0.2
    (finding,) = robot_findings(model, states_with(q, lambda _: None), "joint states")
    assert (finding.code, finding.severity, finding.stamp_ns) == ("joints-limits", Severity.WARNING, 7)
    assert finding.value == pytest.approx(0.2)
    assert f"1 of 60 states are beyond the URDF's limits, {model.joint_names[3]}" in finding.what


def test_end_effector_poses_of_another_robot_are_an_error(model: RobotModel) -> None:
    q = motion(model)
    (good,) = robot_findings(model, states_with(q, lambda q: in_base(model, q, "hand")), "joint states")
    assert (good.code, good.severity, good.value) == ("end-effector", Severity.NOTE, pytest.approx(0, abs=0.01))
    poses = iter([in_base(model, row, "hand") for row in q[::-1]])
    (other,) = robot_findings(model, states_with(q, lambda _: next(poses)), "joint states")
    assert (other.code, other.severity) == ("end-effector", Severity.ERROR)
    assert other.value is not None and other.value > 100
    assert other.remedy == "give the URDF of this very robot, and its --base"

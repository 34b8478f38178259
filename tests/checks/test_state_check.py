"""Logged states against a robot: degrees, poses beside forward kinematics, and the offset of two clocks."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.checks.check_states import check_angles, pose_agreement, robot_findings
from splatctrl_cli.checks.clock_offset import (
    CameraMotion,
    ClockOffset,
    ImageMotion,
    RobotPoints,
    estimate_clock_offset,
    select_states,
    silhouettes,
)
from splatctrl_cli.checks.finding import Severity
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.records import Float64, Intrinsics, JointState
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.recording import Recording, RecordingOptions
from tests.refused import expect_refusal

TOOL = transform_from([0.01, -0.02, 0.1], [0.0, 0.0, np.sin(0.4), np.cos(0.4)])


@pytest.fixture(scope="module")
def model(plain_arm: Path) -> RobotModel:
    T_world_base = transform_from([0.1, 0.2, 0.3], [0.0, 0.0, np.sin(0.3), np.cos(0.3)])
    arm = plain_arm / "tabletop"
    return RobotModel.from_urdf(arm / "robot.urdf", arm / "robot_spheres.yaml", T_world_base=T_world_base)


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


def test_poses_of_a_link_agree_with_it_and_those_of_the_world_are_not_moved_by_the_base(model: RobotModel) -> None:
    link, q = model.frame_names[-1], motion(model)
    assert pose_agreement(model, states_with(q, lambda _: None)) is None
    found = pose_agreement(model, states_with(q, lambda q: in_base(model, q, link)))
    assert (found.verdict, found.link, found.num_poses) == ("agree", link, 60)
    assert found.difference.max_position < 1e-9 and found.difference.max_rotation < 1e-6
    states = [replace(s, T_world_ee=model.frame_pose(s.position, link)) for s in states_with(q, lambda _: None)]
    assert pose_agreement(model, states).verdict == "agree"


def test_a_constant_transform_in_the_hand_is_a_tool(model: RobotModel) -> None:
    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: in_base(model, q, link) @ TOOL))
    in_link = np.linalg.inv(model.frame_pose(model.middle, found.link)) @ model.frame_pose(model.middle, link) @ TOOL
    assert (found.verdict, found.offset) == ("tool", pytest.approx(in_link, abs=1e-6))
    assert found.rest.max_position < 1e-6 and "a flange or tool transform" in found.sentence


def test_a_constant_transform_in_the_world_is_a_wrong_base(model: RobotModel) -> None:
    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: TOOL @ in_base(model, q, link)))
    in_world = model.T_world_base @ TOOL @ np.linalg.inv(model.T_world_base)
    assert (found.verdict, found.offset) == ("base", pytest.approx(in_world, abs=1e-6))
    assert "is --base right?" in found.sentence


SIGNS = np.where(np.arange(7) == 2, -1, 1)


@pytest.mark.parametrize(
    "wrong", [lambda q: q[::-1], np.degrees, lambda q: q * SIGNS], ids=["order", "degrees", "zero"]
)
def test_what_no_constant_transform_explains_is_another_robot(
    model: RobotModel, wrong: Callable[[Float64], Float64]
) -> None:
    link = model.frame_names[-1]
    found = pose_agreement(model, states_with(motion(model), lambda q: in_base(model, wrong(q), link)))
    assert found.verdict == "disagree" and found.rest.max_position > 0.02
    assert "wrong URDF, joint order, or units?" in found.sentence
    still = pose_agreement(
        model, states_with(motion(model, amplitude=1e-4), lambda q: in_base(model, q, link) @ TOOL)
    )
    assert still.verdict == "still"


def test_degrees_are_refused_and_radians_are_not(model: RobotModel) -> None:
    q = motion(model)
    one = np.degrees(q) * 100
    one[:, 0] = np.degrees(q[:, 0])
    for radians in (
        q,
        q + 1.0,  # beyond limits is for the audit to say
        q[:, ::-1],  # another joint order
        np.degrees(q) * 100,  # degrees of no posture of this robot either
        one,  # a joint that fits does not make degrees of the others
    ):
        check_angles(model, states_with(radians, lambda _: None), "log")
    words = 'log: joint .* which would fit as degrees.*; .*unit = "deg"'
    expect_refusal(words, check_angles, model, states_with(np.degrees(q), lambda _: None), "log")


def test_states_beyond_the_limits_are_a_warning_with_the_joint(model: RobotModel) -> None:
    q = motion(model)
    assert robot_findings(model, states_with(q, lambda _: None)) == []
    q[7, 3] = model.upper[3] + 0.2
    (finding,) = robot_findings(model, states_with(q, lambda _: None))
    found = finding.code, finding.severity, finding.stamp_ns, finding.value
    assert found == ("joints-limits", Severity.WARNING, 7, pytest.approx(0.2))
    assert f"1 of 60 states are beyond the URDF's limits, {model.joint_names[3]}" in finding.what


def test_end_effector_poses_of_another_robot_are_an_error(model: RobotModel) -> None:
    q = motion(model)
    (good,) = robot_findings(model, states_with(q, lambda q: in_base(model, q, "hand")))
    assert (good.code, good.severity, good.value) == ("end-effector", Severity.NOTE, pytest.approx(0, abs=0.01))
    poses = iter([in_base(model, row, "hand") for row in q[::-1]])
    (other,) = robot_findings(model, states_with(q, lambda _: next(poses)))
    remedy = "give the URDF of this very robot, and its --base"
    assert (other.code, other.severity, other.remedy) == (
        "end-effector",
        Severity.ERROR,
        remedy,
    ) and other.value > 100


INTERVAL = 0.2  # [s] between the frames of the sample


@pytest.fixture(scope="module")
def sample(plain_arm: Path) -> tuple[list[JointState], ImageMotion, RobotPoints]:
    arm = plain_arm / "tabletop"
    model = RobotModel.from_urdf(arm / "robot.urdf", arm / "robot_spheres.yaml")
    states, motion = [], ImageMotion()
    for record in Recording(RecordingOptions(width=160, height=120, color_rays=0), model).records():
        if isinstance(record, JointState):
            states.append(record)
        elif record.camera in ("cam0", "cam1"):
            motion.add(record)
    moving = model.moving_spheres
    q = np.array([state.position for state in states])
    points = (model.sphere_centers_batch(q)[:, moving], model.sphere_set.radii[moving])
    return states, motion, points


def shifted(states: Sequence[JointState], seconds: float) -> list[JointState]:
    """The states of a robot clock that is behind the cameras' by this."""
    return [replace(state, stamp_ns=state.stamp_ns - round(seconds * 1e9)) for state in states]


@pytest.mark.parametrize("seconds", [0.137, -0.5])
def test_silhouettes_find_the_offset_to_a_fraction_of_the_time_between_frames(
    sample: tuple[list[JointState], ImageMotion, RobotPoints], seconds: float
) -> None:
    states, motion, points = sample
    found = estimate_clock_offset(shifted(states, seconds), motion, points)
    assert abs(found.offset_s - seconds) < min(0.15 * INTERVAL, 2 * found.uncertainty_s)
    assert "frames are stamped" in found.sentence


@pytest.mark.parametrize("seconds", [0.0, 0.7])
def test_whole_images_find_it_to_the_time_between_frames(
    sample: tuple[list[JointState], ImageMotion, RobotPoints], seconds: float
) -> None:
    states, motion, _ = sample
    assert abs(estimate_clock_offset(shifted(states, seconds), motion).offset_s - seconds) < INTERVAL


@pytest.mark.parametrize("has_robot", [True, False])
def test_the_offset_is_found_from_few_states_of_a_dense_log(
    sample: tuple[list[JointState], ImageMotion, RobotPoints], has_robot: bool
) -> None:
    """Of a log at 200 Hz that goes on for minutes after its frames, with a pause between two of them."""
    states, motion, points = sample
    pause = 60 * 10**9
    cameras = {}
    for name, camera in motion.cameras.items():
        half = len(camera.stamps_ns) // 2
        stamps = [stamp + pause * (i >= half) for i, stamp in enumerate(camera.stamps_ns)]
        cameras[name] = replace(camera, stamps_ns=stamps)
    long = ImageMotion(cameras=cameras)
    middle = sorted(motion.cameras["cam0"].stamps_ns)[len(motion.cameras["cam0"].stamps_ns) // 2]
    known = np.array([s.stamp_ns + pause * (s.stamp_ns >= middle) for s in states])
    stamps = np.arange(known[0], known[-1] + 120 * 10**9, 5_000_000)
    q = np.array([state.position for state in states])
    position = np.column_stack([np.interp(stamps, known, q[:, j]) for j in range(q.shape[1])])
    centers = np.array(points[0][np.searchsorted(known, stamps, side="right") - 1][:, :8])

    def found_from(index: np.ndarray) -> ClockOffset:
        some = [
            JointState(stamp_ns=int(stamps[i]), position=position[i], velocity=np.zeros(q.shape[1])) for i in index
        ]
        robot = (centers[index], points[1][:8]) if has_robot else None
        return estimate_clock_offset(some, long, robot)

    asked = select_states(stamps, long)
    assert len(asked) < len(stamps) // 2
    assert found_from(asked) == found_from(np.arange(len(stamps)))


def refused(found: ClockOffset) -> str:
    assert found.offset_s is None
    assert "cannot tell" in found.sentence
    return found.reason


def test_nothing_is_told_where_images_show_something_else(
    sample: tuple[list[JointState], ImageMotion, RobotPoints],
) -> None:
    states, motion, points = sample
    rng = np.random.default_rng(1)
    noise = {
        name: replace(camera, changes=[rng.random(camera.changes[0].shape, dtype=np.float32) for _ in camera.changes])
        for name, camera in motion.cameras.items()
    }
    assert "do not move alike" in refused(estimate_clock_offset(states, ImageMotion(cameras=noise), points))
    assert "do not move alike" in refused(estimate_clock_offset(states, ImageMotion(cameras=noise)))


def test_nothing_is_told_of_a_motion_that_repeats() -> None:
    stamps = np.arange(0, 20.0, 0.1)
    camera = CameraMotion(
        intrinsics=Intrinsics(fx=1, fy=1, cx=0, cy=0, width=1, height=1),
        T_world_camera=np.eye(4),
        stamps_ns=[round(t * 1e9) for t in stamps],
        changes=[np.full((1, 1), abs(np.sin(4 * np.pi * (t + 0.05))), np.float32) for t in stamps[:-1]],
    )
    seconds = np.arange(0, 20.0, 0.01)
    states = [
        JointState(stamp_ns=round(t * 1e9), position=np.array([np.cos(4 * np.pi * t)]), velocity=np.zeros(1))
        for t in seconds
    ]
    assert "the motion repeats" in refused(estimate_clock_offset(states, ImageMotion(cameras={"c": camera})))


def test_too_little_to_judge_is_said(sample: tuple[list[JointState], ImageMotion, RobotPoints]) -> None:
    states, motion, _ = sample
    still = [replace(state, position=states[0].position) for state in states]
    assert refused(estimate_clock_offset(still, motion)) == "no joint moves"
    assert "expected at least" in refused(estimate_clock_offset(states, ImageMotion()))
    assert "expected at least" in refused(estimate_clock_offset(states[:2], motion))
    assert refused(estimate_clock_offset(states[:30], motion)) in {"the log is too short", "no joint moves"}
    other_clock = shifted(states, 1e6)
    assert refused(estimate_clock_offset(other_clock, motion)) == "no joint states within 2 s of the frames"


def test_a_silhouette_is_the_sphere_that_is_nearest() -> None:
    camera = CameraMotion(
        intrinsics=Intrinsics(fx=20, fy=20, cx=10, cy=10, width=21, height=21), T_world_camera=np.eye(4)
    )
    centers = np.array([[[0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.5, 0.0, 2.0], [0.0, 0.0, -2.0]]])
    depth = silhouettes(centers, np.array([0.25, 1.0, 0.1, 0.5]), camera)[0]
    assert (depth[10, 10], depth[10, 15]) == (pytest.approx(1.75), pytest.approx(1.9))
    assert depth[10, 6] == pytest.approx(3 - np.sqrt(1 - 0.6**2))
    assert depth[0, 0] == 0

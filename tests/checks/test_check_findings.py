"""Findings of `check` that need more than one wrong message: parts, clocks, files, options, a robot."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.checks.check_states import robot_findings
from splatctrl_cli.checks.check_times import file_findings
from splatctrl_cli.checks.finding import Finding, Severity
from splatctrl_cli.containers.bag_log import open_raw_log
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.records import JointState
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.sources.source import open_logs
from tests.checks.test_check_log import COLOR, DEPTH, GOOD, INFO, above_note, checked, one
from tests.files.break_log import Message, broken_log, set_stamp, stamp_of
from tests.logs.make_log import FRAME_NS, START_NS, LogRecipe, make_log

SECOND = 1_000_000_000


def noted(findings: list[Finding], code: str) -> Finding:
    """The only finding of a code."""
    (found,) = [finding for finding in findings if finding.code == code]
    return found


def without(*topics: str, first: int = 0, last: int = 10**6) -> Any:
    """A change that leaves frames `first` to `last` of these topics out."""

    def left_out(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic not in topics or not first <= (log_time - START_NS) // FRAME_NS <= last:
            yield log_time, topic, kind, message

    return left_out


def test_a_file_that_was_cut_is_a_warning_and_the_rest_is_judged(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", GOOD)
    log.write_bytes(log.read_bytes()[: 2 * log.stat().st_size // 3])
    report = checked(log)
    damaged = [finding for finding in above_note(report) if finding.code == "damaged"]
    assert damaged
    assert all(f.severity is Severity.WARNING and f.remedy.startswith("copy the file again") for f in damaged)
    assert next(rate for rate in report.rates if rate.topic == COLOR).messages > 10


def test_depth_that_is_no_number_is_counted(tmp_path: Path) -> None:
    report = checked(make_log(tmp_path / "log.mcap", replace(GOOD, depth_encoding="32FC1")))
    assert noted(list(report.findings), "depth-invalid").value == 30
    good = checked(make_log(tmp_path / "good.mcap", GOOD))
    assert "depth-invalid" not in [finding.code for finding in good.findings]


def test_joints_that_never_move_are_noted(tmp_path: Path) -> None:
    def still(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/joint_states":
            message.position[:] = 0.3
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", still))
    assert noted(list(report.findings), "joints-still").where == "/joint_states"


def test_joint_states_without_joints_are_none(tmp_path: Path) -> None:
    def empty(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/joint_states":
            message.name, message.position, message.velocity = [], np.zeros(0), np.zeros(0)
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", empty))
    assert [need.command for need in report.needs if report.lacks(need)] == ["replay"]


def test_damage_of_one_kind_is_one_finding(tmp_path: Path) -> None:
    def cut(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/joint_states":
            message.position = np.zeros(0)
        yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", cut)))
    assert (finding.code, finding.value) == ("damaged", 30)
    assert finding.what == "a JointState with 2 names, 0 positions and 2 velocities (30 times)"


@pytest.fixture(scope="module")
def arm(sample_data: Path) -> RobotModel:
    tabletop = sample_data / "tabletop"
    return RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml")


def swing(model: RobotModel, link: str | None = None) -> list[JointState]:
    """States between the limits, with poses of a link."""
    middle, half = 0.5 * (model.lower + model.upper), 0.5 * (model.upper - model.lower)
    states = []
    for index in range(20):
        q = middle + 0.4 * half * np.sin(0.3 * index + np.arange(model.num_joints))
        pose = None if link is None else model.frame_pose(q, link)
        states.append(JointState(stamp_ns=index, position=q, velocity=np.zeros_like(q), T_base_ee=pose))
    return states


def test_states_beyond_the_limits_are_a_warning_with_the_joint(arm: RobotModel) -> None:
    states = swing(arm)
    assert robot_findings(arm, states, "joint states") == []
    beyond = states[7].position.copy()
    beyond[3] = arm.upper[3] + 0.2
    states[7] = replace(states[7], position=beyond)
    finding = noted(robot_findings(arm, states, "joint states"), "joints-limits")
    assert (finding.severity, finding.value, finding.stamp_ns) == (Severity.WARNING, pytest.approx(0.2), 7)
    assert f"1 of 20 states are beyond the URDF's limits, {arm.joint_names[3]}" in finding.what


def test_end_effector_poses_of_another_robot_are_an_error(arm: RobotModel) -> None:
    good = noted(robot_findings(arm, swing(arm, "hand"), "joint states"), "end-effector")
    assert (good.severity, good.value) == (Severity.NOTE, pytest.approx(0, abs=0.01))
    poses = [state.T_base_ee for state in swing(arm, "hand")]
    other = [replace(s, T_base_ee=T) for s, T in zip(swing(arm), reversed(poses), strict=True)]
    finding = noted(robot_findings(arm, other, "joint states"), "end-effector")
    assert finding.severity is Severity.ERROR
    assert finding.value is not None
    assert finding.value > 100
    assert finding.remedy == "give the URDF of this very robot, and its --base"


def test_topics_that_pause_together_are_one_finding(tmp_path: Path) -> None:
    change = without(COLOR, DEPTH, "/joint_states", "/tf", first=10, last=14)
    finding = one(checked(broken_log(tmp_path / "log.mcap", change)))
    assert (finding.code, finding.value) == ("gap", pytest.approx(0.6))
    assert finding.what.startswith("4 pause together; ")


def test_a_topic_that_begins_late_is_found(tmp_path: Path) -> None:
    finding = one(checked(broken_log(tmp_path / "log.mcap", without("/joint_states", last=14))))
    assert (finding.code, finding.where, finding.value) == ("part", "/joint_states", pytest.approx(1.5))


def test_transforms_that_end_midway_are_found(tmp_path: Path) -> None:
    def stops(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time, topic, kind, message
        if topic == "/tf" and log_time < START_NS + 10 * FRAME_NS:
            message.transforms[0].child_frame_id = "gripper"
            yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", stops)))
    assert (finding.code, finding.where, finding.value) == ("tf-ends", "tf world -> gripper", pytest.approx(2.003))


def test_depth_at_half_the_rate_is_noted(tmp_path: Path) -> None:
    def halved(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic != DEPTH or (log_time - START_NS) // FRAME_NS % 2 == 0:
            yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", halved))
    finding = noted(list(report.findings), "rates-differ")
    assert (finding.value, finding.what) == (0.5, "15 depth images to 30 of colour: 15 colour images go unused")


def test_one_camera_of_three_with_another_clock_is_found(tmp_path: Path) -> None:
    def early(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic.startswith("/cam1/"):
            set_stamp(message, stamp_of(message) - 100_000_000)
        yield log_time, topic, kind, message

    recipe = replace(GOOD, cameras=("cam0", "cam1", "cam2"))
    found = [
        f for f in checked(broken_log(tmp_path / "log.mcap", early, recipe)).findings if f.code == "clock-offset"
    ]
    assert [(f.where.split("/")[1:3], f.value) for f in found] == [(["cam1", "color"], 100), (["cam1", "depth"], 100)]


def test_files_that_were_logged_far_apart_are_found() -> None:
    spans = {"a_0.mcap": (0, 10 * SECOND), "a_1.mcap": (11 * SECOND, 20 * SECOND)}
    assert file_findings(spans) == []
    finding = noted(file_findings({**spans, "b.mcap": (100 * SECOND, 110 * SECOND)}), "files-apart")
    assert (finding.value, finding.what) == (80, "between a_1.mcap and b.mcap nothing was logged for 80 s")


def test_of_many_images_fewer_and_fewer_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.checks.check_images.NUM_DECODED", 8)

    def cut(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == COLOR and log_time == START_NS + 27 * FRAME_NS:
            message.data = message.data[:60]
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", cut))
    assert noted(list(report.findings), "sampled").what.startswith("32 of 60 images were decoded")
    assert noted(above_note(report), "undecodable").value == 1  # by its missing end


def test_several_logs_are_checked_as_one(tmp_path: Path) -> None:
    cameras = broken_log(tmp_path / "cameras.mcap", without("/joint_states"))
    joints = broken_log(tmp_path / "joints.mcap", without(COLOR, DEPTH, INFO, "/tf", "/tf_static"))
    log = open_logs([cameras, joints])
    assert log is not None
    report = check_log(log, SourceOptions())
    assert above_note(report) == []
    assert all(not report.lacks(need) for need in report.needs)
    alone = check_log(open_raw_log(cameras), SourceOptions())
    assert [need.command for need in alone.needs if alone.lacks(need)] == ["replay"]


def test_what_is_given_replaces_what_the_log_lacks(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", replace(GOOD, has_tf=False, has_info=False))
    assert {f.code for f in above_note(checked(log))} == {"missing"}
    given: dict[str, Any] = {"camera_poses": {"cam0": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}}
    assert above_note(checked(log, intrinsics={"cam0": (30.0, 30.0, 15.5, 11.5)}, **given)) == []
    wrong = one(checked(log, intrinsics={"cam0": (60.0, 60.0, 31.0, 23.0)}, **given))
    assert (wrong.code, wrong.severity, wrong.where) == ("principal-point", Severity.ERROR, "camera cam0")
    assert "as if calibrated at about 63x47" in wrong.what


def test_only_the_cameras_that_are_asked_for_are_judged(tmp_path: Path) -> None:
    log = broken_log(
        tmp_path / "log.mcap",
        without("/cam1/depth/image_raw", first=10, last=20),
        replace(GOOD, cameras=("cam0", "cam1")),
    )
    assert one(checked(log)).code == "gap"
    assert above_note(checked(log, cameras=("cam0",))) == []
    with pytest.raises(InputError, match="no camera 'cam7'"):
        checked(log, cameras=("cam7",))


def test_a_log_that_ingest_refuses_is_an_error(tmp_path: Path) -> None:
    report = checked(make_log(tmp_path / "log.mcap", LogRecipe(has_depth=False)))
    finding = noted(above_note(report), "missing")
    assert (finding.severity, finding.what) == (Severity.ERROR, "no depth topic; colour topics there: " + COLOR)
    assert finding.remedy == "record 16UC1, mono16 or 32FC1 depth images"

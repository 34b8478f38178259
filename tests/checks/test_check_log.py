"""Each finding of `check` on a log that is broken in exactly that way; a good log has none."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.checks.finding import CheckReport, Finding, Severity
from splatctrl_cli.containers.bag_log import open_raw_log
from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.robot.model import RobotModel
from tests.files.break_log import Message, broken_log, set_stamp, stamp_of
from tests.logs.make_log import FRAME_NS, START_NS, LogRecipe, make_log

COLOR, DEPTH, INFO = "/cam0/color/image_raw/compressed", "/cam0/depth/image_raw", "/cam0/color/camera_info"
GOOD = LogRecipe(num_frames=30)


def checked(path: Path, **options: Any) -> CheckReport:
    return check_log(open_raw_log(path), SourceOptions(**options))


def above_note(report: CheckReport) -> list[Finding]:
    return [finding for finding in report.findings if finding.severity is not Severity.NOTE]


def one(report: CheckReport) -> Finding:
    """The only finding above a note."""
    findings = above_note(report)
    assert len(findings) == 1, [(f.code, f.where, f.what) for f in findings]
    assert findings[0].remedy
    return findings[0]


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_a_good_log_has_no_finding_above_a_note(tmp_path: Path, encoding: str) -> None:
    recipe = LogRecipe(num_frames=30, cameras=("cam0", "cam1"), depth_encoding=encoding)
    report = checked(make_log(tmp_path / "log.mcap", recipe))
    assert above_note(report) == []
    assert all(not report.lacks(need) for need in report.needs)
    rate = next(rate for rate in report.rates if rate.topic == COLOR)
    assert (rate.messages, rate.hz) == (30, pytest.approx(10))


def test_the_simulated_recording_has_no_finding_above_a_note(sample_data: Path) -> None:
    tabletop = sample_data / "tabletop"
    model = RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml")
    report = check_log(open_raw_log(tabletop / "log.mcap"), SourceOptions(), model=model, num_images=12)
    assert above_note(report) == []
    arms = [finding for finding in report.findings if finding.code == "arm"]
    assert len(arms) == 4
    assert all(finding.value is not None and abs(finding.value) < 15 for finding in arms)


def test_an_arm_that_is_not_where_the_joints_say_is_a_warning(sample_data: Path) -> None:
    tabletop = sample_data / "tabletop"
    T = np.eye(4)
    T[:3, 3] = 0.0, 0.4, 0.0
    model = RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml", T_world_base=T)
    report = check_log(open_raw_log(tabletop / "log.mcap"), SourceOptions(), model=model, num_images=12)
    arms = [finding for finding in above_note(report) if finding.code == "arm"]
    assert [finding.where for finding in arms] == ["cameras cam0, cam1, cam2, cam3"]


def test_a_gap_is_found_with_its_time(tmp_path: Path) -> None:
    def without_a_second(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic != COLOR or not 10 <= (log_time - START_NS) // FRAME_NS < 20:
            yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", without_a_second))
    codes = {finding.code: finding for finding in above_note(report)}
    assert codes["gap"].where == COLOR
    assert codes["gap"].value == pytest.approx(1.1)
    assert report.seconds(codes["gap"]) == pytest.approx(0.9)
    assert "10 images are missing" in codes["gap"].what


def test_a_stamp_that_repeats_is_found(tmp_path: Path) -> None:
    def twice(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time, topic, kind, message
        if topic == "/joint_states" and log_time == START_NS + 5 * FRAME_NS:
            yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", twice)))
    assert (finding.code, finding.where, finding.value) == ("stamp-repeats", "/joint_states", 1)


def test_a_stamp_that_goes_back_is_found(tmp_path: Path) -> None:
    def back(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/joint_states" and log_time == START_NS + 5 * FRAME_NS:
            set_stamp(message, stamp_of(message) - 150_000_000)
        yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", back)))
    assert (finding.code, finding.value) == ("stamp-back", pytest.approx(0.05))


def test_stamps_of_zero_are_an_error(tmp_path: Path) -> None:
    def unstamped(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic in {COLOR, "/joint_states"}:
            set_stamp(message, 0)
        yield log_time, topic, kind, message

    log = broken_log(tmp_path / "log.mcap", unstamped)
    found = {f.where: f.severity for f in checked(log).findings if f.code == "stamp-zero"}
    assert found == {COLOR: Severity.ERROR, "/joint_states": Severity.WARNING}
    assert above_note(checked(log, stamps="log")) == []


def test_joints_whose_clock_is_ahead_are_found(tmp_path: Path) -> None:
    def ahead(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/joint_states":
            set_stamp(message, stamp_of(message) + 400_000_000)
        yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", ahead)))
    assert (finding.code, finding.where, finding.value) == ("clock-offset", "/joint_states", pytest.approx(-0.4))


def test_simulated_time_is_only_a_note(tmp_path: Path) -> None:
    def played(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time + 86_400_000_000_000, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", played))
    assert above_note(report) == []
    assert next(f.value for f in report.findings if f.code == "clock") == pytest.approx(86400)


def test_a_clock_that_drifts_is_found(tmp_path: Path) -> None:
    def drifting(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        late = (log_time - START_NS) // 50 if topic == "/joint_states" else 0
        yield log_time + late, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", drifting)))
    assert (finding.code, finding.where) == ("clock-drift", "/joint_states")
    assert finding.value == pytest.approx(0.02 * 2.9, rel=0.1)


def test_an_image_that_does_not_decode_is_found(tmp_path: Path) -> None:
    def cut(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == COLOR and log_time == START_NS + 7 * FRAME_NS:
            message.data = message.data[:60]
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", cut))
    finding = one(report)
    assert (finding.code, finding.where, finding.value) == ("undecodable", COLOR, 1)
    assert report.seconds(finding) == pytest.approx(0.7)


def test_an_encoding_that_is_not_read_is_found(tmp_path: Path) -> None:
    def odd(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time, topic, kind, message
        if topic == DEPTH:
            message.encoding = "bayer_of_mars"
            yield log_time, "/odd/image", kind, message

    report = checked(broken_log(tmp_path / "log.mcap", odd))
    assert above_note(report) == []  # no camera is made of the topic
    finding = next(f for f in report.findings if f.code == "encoding")
    assert finding.where == "/odd/image"
    assert "'bayer_of_mars' is not read" in finding.what


def test_images_that_change_their_size_are_found(tmp_path: Path) -> None:
    def grown(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == DEPTH and log_time > START_NS + 25 * FRAME_NS:
            message.height //= 2
            message.data = message.data[: message.height * message.step]
        yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", grown)))
    assert (finding.code, finding.where, finding.severity) == ("image-size", DEPTH, Severity.WARNING)


def test_colour_and_depth_that_seldom_pair_are_found(tmp_path: Path) -> None:
    def late(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == DEPTH and (log_time - START_NS) // FRAME_NS % 2:
            set_stamp(message, stamp_of(message) + 40_000_000)
            log_time += 40_000_000
        yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", late)))
    assert (finding.code, finding.where, finding.value) == ("pairing", "camera cam0", pytest.approx(0.5))


def test_depth_that_is_late_by_less_than_the_tolerance_is_noted(tmp_path: Path) -> None:
    report = checked(make_log(tmp_path / "log.mcap", replace(GOOD, depth_delay_ns=15_000_000)))
    assert next(f.value for f in report.findings if f.code == "pair-offset") == pytest.approx(15)


@pytest.mark.parametrize(
    ("recipe", "guess", "scale"),
    [
        (replace(GOOD, depth_counts=1), "metres stored as integers", "1"),
        (replace(GOOD, depth_encoding="32FC1", depth_m=1250.0), "millimetres stored as floats", "0.001"),
    ],
)
def test_millimetres_and_metres_that_are_confused_are_found(
    tmp_path: Path, recipe: LogRecipe, guess: str, scale: str
) -> None:
    report = checked(make_log(tmp_path / "log.mcap", recipe))
    finding = one(report)
    assert (finding.code, finding.severity) == ("depth-scale", Severity.ERROR)
    assert guess in finding.what
    assert finding.remedy == f"give --depth-scale {scale}"
    assert all(report.lacks(need) for need in report.needs)


def test_a_depth_scale_that_was_given_is_believed(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", replace(GOOD, depth_counts=12500))
    assert above_note(checked(log, depth_scale=1e-4)) == []


@pytest.mark.parametrize(("rows", "severity"), [(20, Severity.NOTE), (23, Severity.WARNING), (24, Severity.ERROR)])
def test_missing_depth_is_found(tmp_path: Path, rows: int, severity: Severity) -> None:
    def dark(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == DEPTH:
            message.data[: rows * message.step] = 0
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", dark))
    found = [f for f in report.findings if f.code in {"depth-share", "depth-empty"}]
    assert [f.severity for f in found] == [severity]


Lens = Callable[[Any], None]


def _shift(info: Any) -> None:
    info.k[2] = 2.0


def _double(info: Any) -> None:
    info.k[[0, 2, 4, 5]] *= 2


def _stretch(info: Any) -> None:
    info.k[4] *= 1.3


def _narrow(info: Any) -> None:
    info.k[0] = info.k[4] = 300.0


def _zero(info: Any) -> None:
    info.k[:] = 0


def _strange(info: Any) -> None:
    info.distortion_model, info.d = "fish", np.full(5, 0.1)


def _other_size(info: Any) -> None:
    info.width, info.height = 64, 48
    info.k[[2, 5]] *= 2


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (_shift, "principal-point"),
        (_double, "principal-point"),
        (_stretch, "focal-ratio"),
        (_narrow, "field-of-view"),
        (_zero, "uncalibrated"),
        (_strange, "distortion"),
        (_other_size, "camera-info-size"),
    ],
)
def test_intrinsics_that_do_not_fit_are_found(tmp_path: Path, change: Lens, code: str) -> None:
    def changed(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == INFO:
            change(message)
        yield log_time, topic, kind, message

    assert code in [f.code for f in above_note(checked(broken_log(tmp_path / "log.mcap", changed)))]


def test_a_camera_info_that_changes_is_found(tmp_path: Path) -> None:
    def zoomed(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == INFO and log_time > START_NS + 14 * FRAME_NS:
            message.k[[0, 4]] *= 1.1
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", zoomed))
    finding = one(report)
    assert (finding.code, report.seconds(finding)) == ("camera-info-changes", pytest.approx(1.5))


def test_two_camera_infos_that_differ_are_found(tmp_path: Path) -> None:
    def rival(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time, topic, kind, message
        if topic == INFO:
            message.k[[0, 4]] *= 1.1
            yield log_time, "/calibrated/camera_info", kind, message

    assert one(checked(broken_log(tmp_path / "log.mcap", rival))).code == "camera-info-two"


def test_poses_that_are_missing_are_found(tmp_path: Path) -> None:
    finding = one(checked(make_log(tmp_path / "log.mcap", replace(GOOD, tf_frames=20))))
    assert (finding.code, finding.value) == ("pose-missing", 10)


def test_a_pose_that_jumps_is_found(tmp_path: Path) -> None:
    def jumped(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/tf" and log_time > START_NS + 14 * FRAME_NS:
            message.transforms[0].transform.translation.x += 2.0
        yield log_time, topic, kind, message

    report = checked(broken_log(tmp_path / "log.mcap", jumped))
    finding = one(report)
    assert (finding.code, finding.value) == ("pose-jump", pytest.approx(2.1))
    assert report.seconds(finding) == pytest.approx(1.4)


def test_a_gap_in_tf_is_found(tmp_path: Path) -> None:
    def sleepy(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic != "/tf" or not 10 <= (log_time - START_NS) // FRAME_NS < 15:
            yield log_time, topic, kind, message

    finding = one(checked(broken_log(tmp_path / "log.mcap", sleepy)))
    assert (finding.code, finding.where, finding.value) == ("tf-gap", "tf world -> cam0_link", pytest.approx(0.6))


def test_cameras_in_separate_trees_are_an_error(tmp_path: Path) -> None:
    def torn(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/tf":
            message.transforms[1].header.frame_id = "elsewhere"
        yield log_time, topic, kind, message

    recipe = replace(GOOD, cameras=("cam0", "cam1"))
    finding = one(checked(broken_log(tmp_path / "log.mcap", torn, recipe)))
    assert (finding.code, finding.severity) == ("tf-roots", Severity.ERROR)
    assert "elsewhere, world" in finding.what


def test_a_frame_with_two_parents_is_found(tmp_path: Path) -> None:
    def rival(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time, topic, kind, message
        if topic == "/tf" and log_time == START_NS:
            message.transforms[0].header.frame_id = "map"
            yield log_time, topic, kind, message

    assert "tf-parents" in [f.code for f in above_note(checked(broken_log(tmp_path / "log.mcap", rival)))]


def _degrees(state: Any) -> None:
    state.position *= 57.3


def _nan(state: Any) -> None:
    state.position[1] = np.nan


def _zero_velocity(state: Any) -> None:
    state.velocity[:] = 0


@pytest.mark.parametrize(
    ("change", "code"),
    [(_degrees, "joints-degrees"), (_nan, "joints-nan"), (_zero_velocity, "joints-velocity")],
)
def test_joint_states_that_are_wrong_are_found(tmp_path: Path, change: Lens, code: str) -> None:
    def changed(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic == "/joint_states" and (code != "joints-nan" or log_time == START_NS + 3 * FRAME_NS):
            change(message)
        yield log_time, topic, kind, message

    assert one(checked(broken_log(tmp_path / "log.mcap", changed))).code == code


def test_what_a_log_lacks_is_said_for_each_command(tmp_path: Path) -> None:
    report = checked(make_log(tmp_path / "log.mcap", replace(GOOD, has_tf=False, has_joints=False)))
    lacks = {need.command: report.lacks(need) for need in report.needs}
    assert "no tf for frame" in lacks["ingest"][0]
    assert "no joint states" in lacks["replay"][0]
    missing = next(f for f in report.findings if f.code == "missing")
    assert missing.severity is Severity.ERROR  # so that check fails where ingest would
    assert missing.remedy == "record /tf and /tf_static, or give --camera-pose cam0=x,y,z,qx,qy,qz,qw"
    alone = checked(make_log(tmp_path / "alone.mcap", replace(GOOD, has_joints=False)))
    assert [need.command for need in alone.needs if alone.lacks(need)] == ["replay"]


def test_a_quick_check_reads_the_first_images_only_and_says_so(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", GOOD)
    report = check_log(open_raw_log(log), SourceOptions(), num_images=10)
    assert max(rate.messages for rate in report.rates if rate.topic == COLOR) == 10
    assert [f.code for f in report.findings if f.code == "quick"] == ["quick"]

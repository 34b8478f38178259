"""Each finding of `check` on a log that is broken in exactly that way; a good log has none."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.checks.check_times import file_findings
from splatctrl_cli.checks.finding import CHECKS, CheckReport, Finding, Severity
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.source import open_logs
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.robot.model import RobotModel
from tests.cli.conftest import few_points
from tests.recording.log.make_log import (
    FRAME_NS,
    START_NS,
    WIDTH,
    Change,
    LogRecipe,
    Message,
    broken_log,
    make_log,
    set_stamp,
    stamp_of,
)
from tests.refused import expect_refusal

__all__ = ["few_points"]
ROOT = Path(__file__).parents[2]
COLOR, DEPTH, INFO = "/cam0/color/image_raw/compressed", "/cam0/depth/image_raw", "/cam0/color/camera_info"
NO_DEPTH = "record 16UC1, mono16 or 32FC1 depth images (info and replay of joint states work without)"
JOINTS = "/joint_states"
GOOD = LogRecipe(num_frames=30)
CAMERAS_2, CAMERAS_3 = (replace(GOOD, cameras=tuple(f"cam{i}" for i in range(num))) for num in (2, 3))
SECOND = 1_000_000_000
NOTE, WARNING, ERROR = Severity.NOTE, Severity.WARNING, Severity.ERROR
Edit = Callable[[Any], object]


def checked(path: Path, **options: Any) -> CheckReport:
    """A report whose findings are as bad as the table of checks allows."""
    report = check_log(open_raw_log(path), SourceOptions(**options))
    assert all(finding.severity in CHECKS[finding.code].severities for finding in report.findings)
    return report


def above_note(report: CheckReport) -> list[Finding]:
    return [finding for finding in report.findings if finding.severity is not NOTE]


def is_good(report: CheckReport) -> bool:
    """True without errors and warnings, if every command can start."""
    return not above_note(report) and not any(map(report.obstacles, report.lacks))


def only(findings: list[Finding], code: str) -> Finding:
    """The only finding of a code."""
    (found,) = [finding for finding in findings if finding.code == code]
    return found


def edited(topic: str, edit: Edit, first: int = 0, last: int = 10**6) -> Change:
    """A change of the messages of topics that start like this, in frames `first` to `last`."""

    def change(log_time: int, name: str, kind: str, message: Any) -> Iterator[Message]:
        if name.startswith(topic) and first <= (log_time - START_NS) // FRAME_NS <= last:
            edit(message)
        yield log_time, name, kind, message

    return change


def doubled(topic: str, edit: Edit, *, name: str = "", first: int = 0, last: int = 10**6) -> Change:
    """A second message, edited, behind each of a topic (under another name), in frames `first` to `last`."""

    def change(log_time: int, found: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time, found, kind, message
        if found == topic and first <= (log_time - START_NS) // FRAME_NS <= last:
            edit(message)
            yield log_time, name or found, kind, message

    return change


def without(*topics: str, first: int = 0, last: int = 10**6) -> Change:
    """A change that leaves frames `first` to `last` of these topics out."""

    def change(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic not in topics or not first <= (log_time - START_NS) // FRAME_NS <= last:
            yield log_time, topic, kind, message

    return change


def logged_later(by_ns: Callable[[int, str], int]) -> Change:
    """A change of the times of logging, by time and topic."""

    def change(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        yield log_time + by_ns(log_time, topic), topic, kind, message

    return change


def shifted(by_ns: int) -> Edit:
    return lambda message: set_stamp(message, stamp_of(message) + by_ns)


def late_half(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
    """Every second depth image 40 ms late."""
    if topic == DEPTH and (log_time - START_NS) // FRAME_NS % 2:
        shifted(40_000_000)(message)
        log_time += 40_000_000
    yield log_time, topic, kind, message


def half_the_depth(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
    if topic != DEPTH or (log_time - START_NS) // FRAME_NS % 2 == 0:
        yield log_time, topic, kind, message


def _with(**values: Any) -> Edit:
    return lambda message: [setattr(message, name, value) for name, value in values.items()]


def _last_again(message: Any) -> None:
    """All pixels as in the image before, where the first row alone differs."""
    message.data[: 2 * WIDTH] = 0


def _cut(message: Any) -> None:
    message.data = message.data[:60]


def _shrink(message: Any) -> None:
    message.height //= 2
    message.data = message.data[: message.height * message.step]


def _dark(rows: int) -> Edit:
    return lambda message: message.data[: rows * message.step].fill(0)


def _scaled(name: str, factor: float, *indices: int) -> Edit:
    """A change of some values of a field, or of all."""

    def edit(message: Any) -> None:
        getattr(message, name)[list(indices) or slice(None)] *= factor

    return edit


def _other_size(info: Any) -> None:
    info.width, info.height = 64, 48
    info.k[[2, 5]] *= 2


def _jump(message: Any) -> None:
    message.transforms[0].transform.translation.x += 2.0


def _parent(number: int, name: str) -> Edit:
    return lambda message: setattr(message.transforms[number].header, "frame_id", name)


def _gripper(message: Any) -> None:
    message.transforms[0].child_frame_id = "gripper"


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A log that is broken in one way, and its only finding above a note (or of its code, with `beside`).

    at: seconds from the start; what: words of the text; remedy: all of it, where it is given.
    """

    code: str
    severity: Severity = WARNING
    change: Change | None = None
    recipe: LogRecipe = field(default_factory=lambda: GOOD)
    where: str = ""
    value: float | None = None
    at: float | None = None
    what: str = ""
    remedy: str = ""
    beside: bool = False


FAULTS = [
    Fault(code="gap", change=without(COLOR, first=10, last=19), where=COLOR, value=1.1, at=0.9,
          what="10 images are missing", beside=True),
    Fault(code="gap", change=without(COLOR, DEPTH, JOINTS, "/tf", first=10, last=14), value=0.6,
          what="4 pause together; "),
    Fault(code="part", change=without(JOINTS, last=14), where=JOINTS, value=1.5),
    Fault(code="stamp-repeats", change=doubled(JOINTS, lambda _: None, first=5, last=5), where=JOINTS, value=1),
    Fault(code="stamp-back", change=edited(JOINTS, shifted(-150_000_000), 5, 5), value=0.05),
    Fault(code="clock-offset", change=edited(JOINTS, shifted(400_000_000)), where=JOINTS, value=-0.4),
    Fault(code="clock", severity=NOTE, change=logged_later(lambda *_: 86_400 * SECOND), value=86400),
    Fault(code="clock-drift", value=0.058, where=JOINTS,
          change=logged_later(lambda time, topic: (time - START_NS) // 50 if topic == JOINTS else 0)),
    Fault(code="undecodable", change=edited(COLOR, _cut, 7, 7), where=COLOR, value=1, at=0.7),
    Fault(code="encoding", severity=NOTE, where="/odd/image", what="'bayer_of_mars' is not read",
          change=doubled(DEPTH, _with(encoding="bayer_of_mars"), name="/odd/image")),
    Fault(code="image-size", change=edited(DEPTH, _shrink, first=26), where=DEPTH),
    Fault(code="pairing", change=late_half, where="camera cam0", value=0.5),
    Fault(code="pair-offset", severity=NOTE, recipe=replace(GOOD, depth_delay_ns=15_000_000), value=15, beside=True),
    Fault(code="rates-differ", severity=NOTE, change=half_the_depth, value=0.5,
          what="15 depth images to 30 of colour: 15 colour images go unused", beside=True),
    Fault(code="depth-scale", severity=ERROR, recipe=replace(GOOD, depth_counts=1),
          what="metres stored as integers", remedy="give --depth-scale 1"),
    Fault(code="depth-scale", severity=ERROR, recipe=replace(GOOD, depth_encoding="32FC1", depth_m=1250.0),
          what="millimetres stored as floats", remedy="give --depth-scale 0.001"),
    Fault(code="depth-share", severity=NOTE, change=edited(DEPTH, _dark(20)), beside=True),
    Fault(code="depth-share", change=edited(DEPTH, _dark(23)), beside=True),
    Fault(code="depth-empty", severity=ERROR, change=edited(DEPTH, _dark(24)), beside=True),
    Fault(code="depth-invalid", severity=NOTE, recipe=replace(GOOD, depth_encoding="32FC1"), value=30, beside=True),
    Fault(code="depth-repeats", change=edited(DEPTH, _last_again, first=20), where=DEPTH, value=9,
          what="9 of 30 depth images equal the one before"),
    Fault(code="principal-point", change=edited(INFO, _scaled("k", 0.13, 2)), beside=True),
    Fault(code="principal-point", severity=ERROR, change=edited(INFO, _scaled("k", 2, 0, 2, 4, 5)), beside=True),
    Fault(code="focal-ratio", change=edited(INFO, _scaled("k", 1.3, 4)), beside=True),
    Fault(code="field-of-view", change=edited(INFO, _scaled("k", 10.0, 0, 4)), beside=True),
    Fault(code="uncalibrated", change=edited(INFO, _scaled("k", 0, *range(9))), beside=True),
    Fault(code="distortion", severity=ERROR, beside=True,
          change=edited(INFO, _with(distortion_model="fish", d=np.full(5, 0.1)))),
    Fault(code="distortion", severity=ERROR, what="plumb_bob with 3", beside=True,
          change=edited(INFO, _with(distortion_model="plumb_bob", d=np.full(3, 0.01)))),
    Fault(code="camera-info-size", severity=ERROR, change=edited(INFO, _other_size), beside=True),
    Fault(code="camera-info-changes", change=edited(INFO, _scaled("k", 1.1, 0, 4), first=15), at=1.5),
    Fault(code="camera-info-two", change=doubled(INFO, _scaled("k", 1.1, 0, 4), name="/calibrated/camera_info")),
    Fault(code="pose-missing", recipe=replace(GOOD, tf_frames=20), value=10),
    Fault(code="pose-jump", severity=ERROR, change=edited("/tf", _jump, first=15), value=2.1, at=1.4),
    Fault(code="tf-gap", change=without("/tf", first=10, last=14), where="tf world -> cam0_link", value=0.6),
    Fault(code="tf-ends", change=doubled("/tf", _gripper, last=9), where="tf world -> gripper", value=2.003),
    Fault(code="tf-roots", severity=ERROR, change=edited("/tf", _parent(1, "elsewhere")), recipe=CAMERAS_2,
          what="elsewhere, world", beside=True),
    Fault(code="tf-parents", change=doubled("/tf", _parent(0, "map"), last=0), beside=True),
    Fault(code="joints-degrees", severity=ERROR, change=edited(JOINTS, _scaled("position", 57.3))),
    Fault(code="joints-nan", change=edited(JOINTS, _scaled("position", np.nan, 1), 3, 3)),
    Fault(code="joints-velocity", change=edited(JOINTS, _scaled("velocity", 0.0))),
    Fault(code="joints-still", severity=NOTE, where=JOINTS, beside=True,
          change=edited(JOINTS, _scaled("position", 0.0))),
    Fault(code="damaged", change=edited(JOINTS, _with(position=np.zeros(0))), value=30,
          what="a JointState with 2 names and 0 positions (30 times)"),
    Fault(code="missing", severity=ERROR, recipe=LogRecipe(has_depth=False),
          what="no depth topic; colour topics there: " + COLOR, remedy=NO_DEPTH),
]  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.code)
def test_a_fault_is_found_by_its_name_place_and_figure(tmp_path: Path, fault: Fault) -> None:
    path = tmp_path / "log.mcap"
    log = make_log(path, fault.recipe) if fault.change is None else broken_log(path, fault.change, fault.recipe)
    report = checked(log)
    expected = [] if fault.severity is NOTE else [fault.code]
    assert fault.beside or [finding.code for finding in above_note(report)] == expected
    finding = next(f for f in report.findings if f.code == fault.code and f.severity is fault.severity)
    assert (finding.where, finding.remedy) == (fault.where or finding.where, fault.remedy or finding.remedy)
    assert fault.value is None or finding.value == pytest.approx(fault.value, rel=0.1)
    assert fault.at is None or report.seconds(finding) == pytest.approx(fault.at)
    assert fault.what in finding.what
    assert finding.remedy or finding.severity is NOTE
    if fault.severity is ERROR:
        refused = {command for command in report.lacks if report.obstacles(command)}
        assert refused >= set(CHECKS[fault.code].blocked) - ({"ingest"} if fault.code == "missing" else set())


def test_every_code_that_is_made_is_in_the_table_and_every_entry_is_made() -> None:
    sources = [*(ROOT / "splatctrl_cli/checks").glob("check_*.py"), ROOT / "splatctrl_cli/jobs/check.py"]
    text = "\n".join(path.read_text() for path in sources)
    made = set(re.findall(r'(?:error|warning|note|severity|make)\(\s*"([a-z-]+)"', text))
    assert made | set(re.findall(r'judge\([^"]*"([a-z-]+)"', text)) <= set(CHECKS)
    assert set(CHECKS) <= set(re.findall(r'"([a-z-]+)"', text))


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_a_good_log_has_no_finding_above_a_note(tmp_path: Path, encoding: str) -> None:
    report = checked(make_log(tmp_path / "log.mcap", replace(CAMERAS_2, depth_encoding=encoding)))
    assert is_good(report)
    rate = next(rate for rate in report.rates if rate.topic == COLOR)
    assert (rate.messages, rate.hz) == (30, pytest.approx(10))


@pytest.mark.parametrize("offset_m", [0.0, 0.4])
def test_the_simulated_arm_is_where_the_joints_say_or_it_is_a_warning(sample_data: Path, offset_m: float) -> None:
    tabletop = sample_data / "tabletop"
    T = pose_at([0.0, offset_m, 0.0])
    model = RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml", T_world_base=T)
    report = check_log(open_raw_log(tabletop / "log.mcap"), SourceOptions(), model=model, num_images=3)
    arms = [finding for finding in report.findings if finding.code == "arm"]
    if offset_m:
        assert [f.where for f in arms if f.severity is WARNING] == ["cameras cam0, cam1, cam2, cam3"]
    else:
        assert above_note(report) == []
        assert len(arms) == 4 and all(abs(finding.value) < 15 for finding in arms)


def test_stamps_of_zero_are_an_error_unless_the_times_of_logging_are_taken(tmp_path: Path) -> None:
    def unstamped(log_time: int, topic: str, kind: str, message: Any) -> Iterator[Message]:
        if topic in {COLOR, JOINTS}:
            set_stamp(message, 0)
        yield log_time, topic, kind, message

    log = broken_log(tmp_path / "log.mcap", unstamped)
    found = {f.where: f.severity for f in checked(log).findings if f.code == "stamp-zero"}
    assert found == {COLOR: ERROR, JOINTS: WARNING}
    assert above_note(checked(log, stamps="log")) == []


def test_a_depth_scale_that_was_given_is_believed(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", replace(GOOD, depth_counts=12500))
    assert above_note(checked(log, depth_scale=1e-4)) == []


def test_what_a_log_lacks_is_said_for_each_command(tmp_path: Path) -> None:
    report = checked(make_log(tmp_path / "log.mcap", replace(GOOD, has_tf=False, has_joints=False)))
    lacks = {command: report.obstacles(command) for command in report.lacks}
    assert "no tf for frame" in lacks["ingest"][0]
    assert "no joint states" in lacks["replay"][0]
    missing = only(list(report.findings), "missing")
    remedy = "record /tf and /tf_static, or give --camera-pose cam0=x,y,z,qx,qy,qz,qw"
    assert (missing.severity, missing.remedy) == (ERROR, remedy)  # so that check fails where ingest would


@pytest.mark.parametrize(
    ("recipe", "change"),
    [
        (replace(GOOD, has_joints=False), without()),
        (GOOD, edited(JOINTS, _with(name=[], position=np.zeros(0), velocity=np.zeros(0)))),
    ],
)
def test_a_log_without_joint_states_lacks_those_of_a_replay_alone(
    tmp_path: Path, recipe: LogRecipe, change: Change
) -> None:
    alone = checked(broken_log(tmp_path / "log.mcap", change, recipe))
    assert [command for command in alone.lacks if alone.obstacles(command)] == ["replay"]


def test_a_quick_check_reads_the_first_images_only_and_says_so(tmp_path: Path) -> None:
    report = check_log(open_raw_log(make_log(tmp_path / "log.mcap", GOOD)), SourceOptions(), num_images=10)
    assert max(rate.messages for rate in report.rates if rate.topic == COLOR) == 10
    assert only(list(report.findings), "quick")


def test_a_file_that_was_cut_is_a_warning_and_the_rest_is_judged(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", GOOD)
    log.write_bytes(log.read_bytes()[: 2 * log.stat().st_size // 3])
    report = checked(log)
    damaged = [f for f in above_note(report) if f.code == "damaged"]
    assert damaged and all(f.severity is WARNING and f.remedy.startswith("copy the file again") for f in damaged)
    assert next(rate for rate in report.rates if rate.topic == COLOR).messages > 10


def test_one_camera_of_three_with_another_clock_is_found(tmp_path: Path) -> None:
    report = checked(broken_log(tmp_path / "log.mcap", edited("/cam1/", shifted(-100_000_000)), CAMERAS_3))
    found = [f for f in report.findings if f.code == "clock-offset"]
    assert [(f.where.split("/")[1:3], f.value) for f in found] == [(["cam1", "color"], 100), (["cam1", "depth"], 100)]
    assert all("stamps are 100 ms before those of the other cameras' images" in f.what for f in found)


def test_files_that_were_logged_far_apart_are_found() -> None:
    spans = {"a_0.mcap": (0, 10 * SECOND), "a_1.mcap": (11 * SECOND, 20 * SECOND)}
    assert file_findings(spans) == []
    finding = only(file_findings({**spans, "b.mcap": (100 * SECOND, 110 * SECOND)}), "files-apart")
    assert (finding.value, finding.what) == (80, "between a_1.mcap and b.mcap nothing was logged for 80 s")


def test_of_many_images_fewer_and_fewer_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.checks.limits.DECODED_IMAGES", 8)
    report = checked(broken_log(tmp_path / "log.mcap", edited(COLOR, _cut, 27, 27)))
    assert only(list(report.findings), "sampled").what.startswith("32 of 60 images were decoded")
    assert only(above_note(report), "undecodable").value == 1  # by its missing end


def test_several_logs_are_checked_as_one(tmp_path: Path) -> None:
    cameras = broken_log(tmp_path / "cameras.mcap", without(JOINTS))
    joints = broken_log(tmp_path / "joints.mcap", without(COLOR, DEPTH, INFO, "/tf", "/tf_static"))
    assert is_good(check_log(open_logs([cameras, joints]), SourceOptions()))


def test_what_is_given_replaces_what_the_log_lacks(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", replace(GOOD, has_tf=False, has_info=False))
    assert {f.code for f in above_note(checked(log))} == {"missing"}
    given: dict[str, Any] = {"camera_poses": {"cam0": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}}
    assert above_note(checked(log, intrinsics={"cam0": (30.0, 30.0, 15.5, 11.5)}, **given)) == []
    (wrong,) = above_note(checked(log, intrinsics={"cam0": (60.0, 60.0, 31.0, 23.0)}, **given))
    assert (wrong.code, wrong.severity, wrong.where) == ("principal-point", ERROR, "camera cam0")
    assert "as if calibrated at about 63x47" in wrong.what


def test_only_the_cameras_that_are_asked_for_are_judged(tmp_path: Path) -> None:
    log = broken_log(tmp_path / "log.mcap", without("/cam1/depth/image_raw", first=10, last=20), CAMERAS_2)
    assert [f.code for f in above_note(checked(log))] == ["gap"]
    assert above_note(checked(log, cameras=("cam0",))) == []
    expect_refusal("no camera 'cam7'", checked, log, cameras=("cam7",))

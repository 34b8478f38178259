"""What `check` says of the simulated table once a scale, a pose, a clock or a joint of it is wrong."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.checks.check_arm import motion_findings
from splatctrl_cli.checks.check_folder import exposure_findings, usable_frames
from splatctrl_cli.checks.check_images import alignment_findings
from splatctrl_cli.checks.check_log import check_log
from splatctrl_cli.checks.check_states import log_states
from splatctrl_cli.checks.check_views import check_views
from splatctrl_cli.checks.clock_offset import ImageMotion
from splatctrl_cli.checks.finding import Finding, Severity
from splatctrl_cli.geometry import pose_at
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, simulate
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.recording.log.survey import survey
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.recording import RecordingOptions

Gain = Callable[[float, Float64], Float64]  # by step (0 to 1, first to last image) and row (-1 to 1)


@dataclass(frozen=True, kw_only=True)
class Table:
    """The recording as `check` keeps it; few: every second frame of three cameras."""

    frames: Sequence[RgbdFrame]
    few: Sequence[RgbdFrame]
    states: StateColumns
    model: RobotModel

    def views(self, frames: Sequence[RgbdFrame]) -> tuple[list[Finding], list[RgbdFrame], list[RgbdFrame]]:
        return check_views(frames, dict.fromkeys(sorted({frame.camera for frame in frames}), 1e-3))

    def motion(self, frames: Sequence[RgbdFrame], states: StateColumns) -> list[Finding]:
        found = motion_findings(frames, ImageMotion(), states, self.model)
        return [finding for finding in found if finding.severity is not Severity.NOTE]


@pytest.fixture(scope="module")
def table(plain_arm: Path, tmp_path_factory: pytest.TempPathFactory) -> Table:
    folder = tmp_path_factory.mktemp("table")
    arm = plain_arm / "tabletop"
    model = RobotModel.from_urdf(arm / "robot.urdf", arm / "robot_spheres.yaml")
    options = RecordingOptions(fps=1.25, color_rays=1)  # no more images than check keeps
    simulate(SimulateRequest(out=folder / "log", options=options))
    log = open_raw_log(folder / "log" / "log.mcap")
    states = log_states(survey(log), SourceOptions(), model, {}).states
    frames = check_log(log, SourceOptions(), only_errors=True).frames
    stamps = sorted({frame.stamp_ns for frame in frames})[::2]
    few = [frame for frame in frames if frame.stamp_ns in stamps and frame.camera != "cam3"]
    return Table(frames=frames, few=few, states=states, model=model)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"VIEWS_PAIRS": 24, "VIEWS_POINTS": 700, "VIEWS_LANDED": 300}.items():
        monkeypatch.setattr(f"splatctrl_cli.checks.limits.{name}", value)


def moved(frames: Sequence[RgbdFrame], camera: str, position: tuple[float, ...], degrees: float) -> list[RgbdFrame]:
    """With one camera moved [m] and turned about its own x."""
    T = np.eye(4)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T[1:3, 1:3], T[:3, 3] = [[c, -s], [s, c]], position
    return [replace(f, T_world_camera=f.T_world_camera @ T) if f.camera == camera else f for f in frames]


@pytest.mark.parametrize(
    ("factor", "cameras", "remedy"),
    [
        (10.0, "cam0 cam1 cam2 cam3", "give --depth-scale 0.0001"),
        (0.8, "cam0 cam1 cam2 cam3", "give --depth-scale 0.00125"),
        (1.25, "cam1", ""),
    ],
)
def test_depths_of_another_scale_are_named_with_the_right_one(
    table: Table, factor: float, cameras: str, remedy: str
) -> None:
    frames = [replace(f, depth=f.depth * np.float32(factor)) if f.camera in cameras else f for f in table.frames]
    (finding,), scaled, _ = table.views(frames)
    assert (finding.code, finding.severity) == ("views-scale", Severity.ERROR)
    assert cameras != "cam1" or finding.where == "camera cam1"
    assert finding.value == pytest.approx(1 / factor, rel=0.011)
    assert finding.remedy.startswith(remedy)
    assert np.median(scaled[0].depth) == pytest.approx(np.median(table.frames[0].depth), rel=0.011)


@pytest.mark.parametrize(("position", "degrees"), [((0.03, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 2.0)])
def test_a_camera_that_stands_elsewhere_is_named_with_its_move(
    table: Table, position: tuple[float, ...], degrees: float
) -> None:
    (finding,), _, frames = table.views(moved(table.frames, "cam1", position, degrees))
    assert (finding.code, finding.where, finding.severity) == ("views-pose", "camera cam1", Severity.WARNING)
    assert finding.value == pytest.approx(1e3 * position[0], abs=5)
    assert abs(float(finding.what.split(" mm and ")[1].split(" deg")[0]) - degrees) < 0.3
    original = next(f for f in table.frames if f.camera == "cam1").T_world_camera
    corrected = next(f for f in frames if f.camera == "cam1").T_world_camera
    assert np.abs(corrected - original)[:3, 3].max() < 0.005


def brighter(*colours: int) -> Gain:
    """Images that grow brighter by a quarter in these colours."""
    return lambda step, rows: np.broadcast_to(1 / (1.0 - 0.2 * np.array(colours) * step), (len(rows), 3))


def bands(step: float, rows: Float64) -> Float64:
    """A rolling shutter under a lamp: bands that move from image to image."""
    return 1 + 0.2 * np.sin(np.linspace(0, 9, len(rows)) + 154 * step)[:, None]


@pytest.mark.parametrize(
    ("gain", "ignored", "found"),
    [
        (brighter(0, 0, 0), "", {}),
        (brighter(1, 1, 1), "", {"exposure": pytest.approx(25.0, abs=4.0)}),
        (brighter(0, 0, 1), "", {"exposure": pytest.approx(25.0, abs=4.0)}),
        (bands, "exposure", {"exposure-rows": pytest.approx(45.0, abs=15.0)}),
        (lambda step, rows: bands(0.0, rows), "exposure", {}),
        (lambda step, rows: 1 + 0.3 * (step - 0.5) * rows[:, None], "exposure", {}),  # a slope that changes slowly
    ],
    ids=["steady", "exposure", "white balance", "flicker", "lens", "gloss"],
)
def test_a_camera_whose_brightness_changes_is_named_with_its_ratio(
    table: Table, gain: Gain, ignored: str, found: dict[str, object]
) -> None:
    bright = [frame for frame in table.few if frame.camera != "cam2"]
    stamps = sorted({frame.stamp_ns for frame in bright})
    off = []
    for frame in bright:
        by_row = gain(stamps.index(frame.stamp_ns) / (len(stamps) - 1), np.linspace(-1, 1, len(frame.color)))
        shown = np.clip(frame.color * by_row[:, None], 0, 255).astype(np.uint8)
        off.append(replace(frame, color=shown) if frame.camera == "cam1" else frame)
    findings = [finding for finding in exposure_findings(off) if finding.code != ignored]
    assert {finding.code: finding.value for finding in findings} == found
    assert all((f.where, f.severity) == ("camera cam1", Severity.NOTE) for f in findings)


def test_a_flat_wall_says_nothing_of_its_scale(table: Table) -> None:
    walls = [
        replace(
            frame,
            depth=np.full_like(frame.depth, 1.2),
            T_world_camera=pose_at([0.3 * index, 0.0, 0.0]),
            camera=f"cam{index % 2}",
        )
        for index, frame in enumerate(table.frames[:4])
    ]
    assert table.views(walls)[0] == []


def test_depth_that_is_not_registered_is_named_with_its_shift(table: Table) -> None:
    frames = [replace(f, depth=np.roll(f.depth, 12, axis=1)) for f in table.frames if f.camera == "cam0"]
    (finding,) = alignment_findings(frames)
    assert (finding.code, finding.severity, finding.value) == ("alignment", Severity.ERROR, 12)
    assert usable_frames(frames, [finding]) == []


def test_depth_of_another_camera_is_named(table: Table) -> None:
    zero, one = ([f for f in table.frames if f.camera == camera] for camera in ("cam0", "cam1"))
    frames = [replace(a, depth=b.depth) for a, b in zip(zero, one, strict=True)]
    frames += [replace(b, depth=a.depth) for a, b in zip(zero, one, strict=True)]
    found = alignment_findings(frames)
    assert [finding.where for finding in found] == ["camera cam0", "camera cam1"]
    assert "meet the depth edges of camera cam1" in found[0].what


def test_a_foreign_depth_on_one_side_alone_is_a_warning(table: Table) -> None:
    zero, one, two = ([f for f in table.frames if f.camera == camera] for camera in ("cam0", "cam1", "cam2"))
    frames = [replace(a, depth=c.depth) for a, c in zip(zero, two, strict=True)]
    frames += [replace(b, depth=a.depth) for a, b in zip(zero, one, strict=True)]
    (finding,) = alignment_findings(frames)
    assert (finding.where, finding.severity) == ("camera cam0", Severity.WARNING)


def test_a_shift_within_the_smear_of_edges_is_none_in_small_images(table: Table) -> None:
    """3 px are 1.9 % of an image 160 px wide, over the share that counts."""
    small = [
        replace(f, depth=f.depth[::2, ::2], color=cv2.resize(f.color, (160, 120), interpolation=cv2.INTER_AREA))
        for f in table.frames
        if f.camera == "cam0"
    ]

    def found(shift: int) -> list[float | None]:
        return [
            each.value for each in alignment_findings([replace(f, depth=np.roll(f.depth, shift, 1)) for f in small])
        ]

    assert (found(3), found(6)) == ([], [6])


def test_joints_or_a_camera_of_another_clock_are_named_with_the_offset(table: Table) -> None:
    (finding,) = table.motion(table.few, replace(table.states, stamp_ns=table.states.stamp_ns + 80_000_000))
    assert (finding.code, finding.where, finding.value) == ("robot-clock", "joint states", pytest.approx(-80, abs=10))
    assert finding.severity is Severity.WARNING
    frames = [replace(f, stamp_ns=f.stamp_ns + 100_000_000) if f.camera == "cam1" else f for f in table.few]
    (finding,) = table.motion(frames, table.states)
    assert (finding.code, finding.where, finding.value) == ("robot-clock", "camera cam1", pytest.approx(100, abs=10))


def test_exchanged_joints_are_named(table: Table) -> None:
    (finding,) = table.motion(table.few, table.states.select_joints(np.array([0, 2, 1, 3, 4, 5, 6])))
    assert (finding.code, finding.where) == ("arm", "cameras cam0, cam1, cam2")
    assert finding.remedy.startswith("exchange joint2 and joint3: ")


def test_a_joint_whose_zero_is_off_is_found(table: Table) -> None:
    position = np.asarray(table.states.position[0 : len(table.states)]).copy()
    position[:, 1] += np.radians(5)
    (finding,) = table.motion(table.few, replace(table.states, position=position))
    assert (finding.code, finding.value) == ("arm", pytest.approx(30, abs=8))
    assert "the joints' zeros" in finding.remedy

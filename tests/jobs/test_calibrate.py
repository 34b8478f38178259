"""`calibrate` on simulated arms whose cameras are recorded wrongly, and what it refuses to tell."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.calibration import T_HAND_WRIST, WRIST, SetUp, errors
from splatctrl_cli.calibration.calibration_file import read_calibration
from splatctrl_cli.calibration.evidence import transform_of, twist_between
from splatctrl_cli.checks import check_log
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.geometry import look_at
from splatctrl_cli.jobs.calibrate import CalibrateRequest, CalibrateResult, calibrate
from splatctrl_cli.jobs.check import IngestRequest, ingest, pose_robot
from splatctrl_cli.jobs.robot.logged_robot import RobotOptions
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.simulate.arm import HAND
from splatctrl_cli.simulate.recording import RecordingOptions, Scene
from tests.calibration.scan import calibrated, robot_in
from tests.refused import expect_refusal

SMALL = RecordingOptions(duration_s=3.0, fps=2.0, width=160, height=120, color_rays=0)
TINY = replace(SMALL, width=120, height=90)  # shows as much of a robot in view


def largest(setup: SetUp, result: CalibrateResult, *unknowns: str) -> list[float]:
    """The largest error of each."""
    rows = [*errors("", setup, result)]
    return [max(abs(row.error) for row in rows if row.unknown == unknown) for unknown in unknowns]


@pytest.fixture(scope="module")
def setup() -> SetUp:
    return SetUp(1, replace(TINY, fps=1.4))


@pytest.fixture(scope="module")
def result(setup: SetUp, plain_arm: Path, tmp_path_factory: pytest.TempPathFactory) -> CalibrateResult:
    return calibrated(setup, tmp_path_factory.mktemp("setup"), **robot_in(plain_arm))


@pytest.fixture(scope="module")
def log(result: CalibrateResult) -> Path:
    return result.out.with_name("log.mcap")


def test_three_cameras_about_an_arm_are_found_without_a_marker(setup: SetUp, result: CalibrateResult) -> None:
    off = largest(setup, result, "position", "rotation", "clock")
    assert np.all(np.array(off) < [0.002, np.radians(0.2), 0.003])
    assert result.calibration.cameras["cam0"].scale == pytest.approx(setup.scale, abs=0.002)
    assert result.before > 0.008 > 4 * result.after


def test_commands_open_the_recording_with_the_calibrated_poses_depths_and_clock(
    setup: SetUp, log: Path, result: CalibrateResult
) -> None:
    plain, source = open_source(log), open_source(log, SourceOptions(calibration=result.out))
    frames = [{r.camera: r for r in s.records() if isinstance(r, RgbdFrame)} for s in (plain, source)]
    for camera in setup.cameras:
        np.testing.assert_allclose(frames[1][camera.name].T_world_camera, camera.T_world_camera, atol=0.003)
        assert np.abs(frames[0][camera.name].T_world_camera - camera.T_world_camera).max() > 0.005
    seen = frames[0]["cam0"].depth > 0
    ratio = frames[1]["cam0"].depth[seen] / frames[0]["cam0"].depth[seen]
    np.testing.assert_allclose(ratio, setup.scale, atol=0.002)
    shift = (source.states.stamp_ns - plain.states.stamp_ns) * 1e-9
    np.testing.assert_allclose(shift, setup.clock, atol=0.003)
    assert f"--calibration {result.out.name}" in source.digests()
    assert any(result.out.name in note for note in source.loss.notes)


def test_states_are_opened_with_the_same_calibration(setup: SetUp, log: Path, result: CalibrateResult) -> None:
    source = open_states(log, SourceOptions(calibration=result.out), setup.robot.joint_names)
    first = open_states(log, SourceOptions(), setup.robot.joint_names).states.stamp_ns[0]
    assert (source.states.stamp_ns[0] - first) * 1e-9 == pytest.approx(setup.clock, abs=0.003)


def test_a_capture_keeps_the_calibration_and_refuses_it_twice(log: Path, result: CalibrateResult) -> None:
    out = log.with_name("calibrated.capture")
    options = SourceOptions(calibration=result.out)
    ingest(IngestRequest(paths=(log,), out=out, options=options))
    capture = open_source(out)
    key = f"--calibration {result.out.name}"
    assert capture.digests()[key] == open_source(log, options).digests()[key]
    poses = {camera: T for _, camera, T in capture.poses()}
    for name, camera in read_calibration(result.out).cameras.items():
        np.testing.assert_allclose(poses[name], camera.T, atol=1e-6)
    expect_refusal("was ingested with", open_source, out, options)


def test_a_calibration_of_other_cameras_is_refused(
    log: Path, result: CalibrateResult, sample_data: Path, tmp_path: Path
) -> None:
    sample = sample_data / "tabletop" / "log.mcap"
    for camera, words in (("cam0", "not recorded where"), ("cam3", "camera cam3 is not in")):
        options = SourceOptions(calibration=result.out, cameras=(camera,))
        expect_refusal(words, open_source, sample, options)
    other = tmp_path / "other.toml"
    other.write_text(result.out.read_text().replace("cam1", "side"))
    expect_refusal("camera cam1 is not in", open_source, log, SourceOptions(calibration=other))


def test_what_is_calibrated_is_the_recording_as_it_is(log: Path, result: CalibrateResult) -> None:
    expect_refusal(
        "--calibration",
        calibrate,
        CalibrateRequest(paths=(log,), options=SourceOptions(calibration=result.out)),
        error=UsageError,
    )


class Biased(SetUp):
    """Three cameras, one of which measures 10 mm short at every depth."""

    def __init__(self, seed: int, biased: str, options: RecordingOptions) -> None:
        super().__init__(seed, options)
        self.biased, self.scale = biased, 1.0
        self.off["cam0"] = np.eye(4)

    def frames(self) -> Iterator[RgbdFrame]:
        for frame in super().frames():
            short = np.where(frame.depth > 0, frame.depth - np.float32(0.01), 0).astype(np.float32)
            yield replace(frame, depth=short) if frame.camera == self.biased else frame


@pytest.mark.parametrize(("biased", "seed", "has_robot"), [("cam1", 2, False), ("cam0", 3, False), ("cam1", 2, True)])
def test_a_depth_bias_is_found_within_its_sigma_and_in_the_camera_that_has_it(
    biased: str, seed: int, has_robot: bool, tmp_path: Path, plain_arm: Path
) -> None:
    """A scale of the same camera, or the bias of a camera that is taken as recorded, fits nearly as well."""
    setup = Biased(seed, biased, TINY if has_robot else SMALL)
    found = calibrated(setup, tmp_path, **(robot_in(plain_arm) if has_robot else {}))
    for name, camera in found.calibration.cameras.items():
        if name == biased:
            assert abs(camera.bias - 0.01) < 2 * camera.sigma_depth[1] < 0.005
        else:
            assert camera.bias == 0.0 and "depth bias" in camera.as_recorded and camera.depth_noticed[1] < 0.01
        assert camera.scale == 1.0
    rows = [row for row in errors("", setup, found) if row.unknown in ("position", "rotation")]
    assert max(abs(row.error) / row.sigma for row in rows) < 3


def test_the_bias_that_would_not_be_noticed_is_said(setup: SetUp, result: CalibrateResult) -> None:
    for name, camera in result.calibration.cameras.items():
        assert camera.bias == 0.0 and 0.002 <= camera.depth_noticed[1] < 0.01
        assert (camera.scale != 1.0) == (name == "cam0") and camera.depth_noticed[0] < abs(setup.scale - 1)


@pytest.fixture(scope="module")
def wrist() -> SetUp:
    """A camera on the hand, recorded 2 cm and 2 degrees off its mount, with a clock 50 ms off."""
    setup = SetUp(2, TINY, has_wrist=True)
    turn, move = np.array([1, 2, -2]) / 3, np.array([2, -1, 2]) / 3
    setup.off[WRIST] = transform_of(np.concatenate([np.radians(2) * turn, 0.02 * move]))
    setup.clock = 0.05
    return setup


@pytest.fixture(scope="module")
def wrist_result(wrist: SetUp, plain_arm: Path, tmp_path_factory: pytest.TempPathFactory) -> CalibrateResult:
    return calibrated(wrist, tmp_path_factory.mktemp("wrist"), **robot_in(plain_arm))


@pytest.fixture(scope="module")
def wrist_log(wrist_result: CalibrateResult) -> Path:
    return wrist_result.out.with_name("log.mcap")


def off_hand(setup: SetUp, stamp_ns: int, T: Float64) -> tuple[float, float]:
    """How far [m] and [deg] the wrist camera at T is from where it was at a time."""
    q = setup._motion.at((stamp_ns - setup.start_ns) * 1e-9)[0]
    twist = twist_between(setup.link_poses(q)[HAND] @ T_HAND_WRIST, T)
    return float(np.linalg.norm(twist[3:])), float(np.degrees(np.linalg.norm(twist[:3])))


def test_a_camera_on_the_wrist_is_put_right_on_its_mount(wrist: SetUp, wrist_result: CalibrateResult) -> None:
    found = wrist_result.calibration.cameras[WRIST]
    off = twist_between(np.linalg.inv(wrist.off[WRIST]), found.T)
    assert found.moves and np.linalg.norm(off[3:]) < 0.002 and np.linalg.norm(off[:3]) < np.radians(0.2)
    assert largest(wrist, wrist_result, "clock")[0] < 0.003
    assert wrist_result.moved[WRIST] == (pytest.approx(0.02, abs=0.002), pytest.approx(2.0, abs=0.2))


def test_each_frame_of_the_wrist_is_where_the_hand_was(
    wrist: SetUp, wrist_log: Path, wrist_result: CalibrateResult
) -> None:
    """The hand moves by centimetres in the 50 ms that its clock is off, and not evenly between frames."""
    options = SourceOptions(calibration=wrist_result.out)
    poses = [(stamp, T) for stamp, camera, T in open_source(wrist_log, options).poses() if camera == WRIST]
    assert len(poses) == 6
    recorded = [(stamp, T) for stamp, camera, T in open_source(wrist_log).poses() if camera == WRIST]
    assert min(off_hand(wrist, *pose)[0] for pose in recorded) > 0.008
    distances, angles = zip(*(off_hand(wrist, *pose) for pose in poses), strict=True)
    assert max(distances) < 0.003 and max(angles) < 0.25


def test_check_has_the_frames_of_the_wrist_there_too(
    wrist: SetUp, wrist_log: Path, wrist_result: CalibrateResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check_log, "judge_frames", lambda *_, frames, **__: frames)
    found: Any = check_log.check_log(open_raw_log(wrist_log), SourceOptions(calibration=wrist_result.out))
    off = [off_hand(wrist, f.stamp_ns, f.T_world_camera)[0] for f in found if f.camera == WRIST]
    assert off and max(off) < 0.003


def test_frames_of_a_capture_that_the_clock_leaves_without_a_pose_are_counted(
    wrist_log: Path, wrist_result: CalibrateResult
) -> None:
    """A capture has poses at its frames alone: 50 ms before the first there is none."""
    plain = wrist_log.with_name("plain.capture")
    ingest(IngestRequest(paths=(wrist_log,), out=plain))
    source = open_source(plain, SourceOptions(calibration=wrist_result.out))
    stamps = [stamp for stamp, camera, _ in source.poses() if camera == WRIST]
    frames = [record.stamp_ns for record in source.records() if isinstance(record, RgbdFrame)]
    recorded = [stamp for stamp, camera, _ in open_source(plain).poses() if camera == WRIST]
    assert stamps == recorded[1:]
    assert (len(frames), source.loss.without_pose) == (2 * len(recorded) - 1, 1)


def apart() -> SetUp:
    """One camera looks along the table to the wall behind it, one the other way."""
    setup = SetUp(2, SMALL)
    places = ([1.2, 1.3, 0.2], [-0.4, -1.3, 0.2])
    setup.cameras = tuple(
        replace(camera, T_world_camera=look_at([0.3, 0.0, 0.6], place))
        for camera, place in zip(setup.cameras[:2], places, strict=True)
    )
    return setup


class Still(SetUp):
    """An arm that hardly moves."""

    def _scene(self, seed: int, options: RecordingOptions) -> Scene:
        scene = super()._scene(seed, options)
        start = scene.motion.waypoints[0]
        waypoints = start + 0.02 * (scene.motion.waypoints - start)
        return replace(scene, motion=replace(scene.motion, waypoints=waypoints))


class Bare(SetUp):
    """Three cameras over a table, close enough to see nothing else."""

    def __init__(self, seed: int, options: RecordingOptions) -> None:
        super().__init__(seed, options)
        places = ((0.55, -0.05), (0.65, 0.05))
        self.cameras = tuple(
            replace(camera, T_world_camera=look_at([x, y, 0.55], [0.6, 0.0, 0.0]))
            for camera, (x, y) in zip(self.cameras[:2], places, strict=True)
        )
        self.primitives = (*self.primitives[:1], self.primitives[-1])

    def frames(self) -> Iterator[RgbdFrame]:
        for frame in super().frames():
            height = frame.T_world_camera[2, 3]
            yield replace(frame, depth=np.where(frame.depth > 0.9 * height, frame.depth, 0).astype(np.float32))


NOT_OBSERVED: dict[str, tuple[Callable[[], SetUp], bool, dict[str, Any], tuple[str, ...]]] = {
    "cameras that see nothing in common": (
        apart,
        False,
        {},
        ("cannot be tied together: cam0 | cam1", "record a scene that neighbouring cameras both see"),
    ),
    "a robot that hardly moves": (
        partial(Still, 2, SMALL),
        True,
        {},
        ("the robot hardly moves", "record it moving"),
    ),
    "one camera without a robot": (
        partial(SetUp, 2, SMALL),
        False,
        {"options": SourceOptions(cameras=("cam0",))},
        ("no robot to place it against",),
    ),
    "directions that a table does not show": (
        partial(Bare, 2, SMALL),
        False,
        {},
        ("not observed: ", "of cam1", "translation in the table's plane", "put objects of different shapes"),
    ),
}


@pytest.mark.parametrize("name", NOT_OBSERVED)
def test_what_is_not_observed_is_named_and_leaves_no_file(name: str, tmp_path: Path, plain_arm: Path) -> None:
    setup, has_robot, more, words = NOT_OBSERVED[name]
    given = more | (robot_in(plain_arm) if has_robot else {})
    said = expect_refusal("", calibrated, setup(), tmp_path, error=NotEvaluableError, **given)
    assert all(each in said for each in words) and not list(tmp_path.glob("rig.toml*"))


def test_a_robot_that_meshes_draw_needs_no_spheres(sample_data: Path) -> None:
    model = pose_robot((), sample_data / "tabletop" / "robot.urdf", RobotOptions())
    assert model.surface.trees and not len(model.sphere_set.radii)

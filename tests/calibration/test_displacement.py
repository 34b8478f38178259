"""How far from where its joints put it a camera sees the robot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.calibration.displacement import (
    correct_pose,
    displaced_cameras,
    displacement_of,
    is_corrected,
    is_displaced,
)
from splatctrl_cli.calibration.evidence import Arm, transform_of
from splatctrl_cli.jobs.reconstruct.reconstruct import arm_of, frames_of
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, RgbdFrame
from splatctrl_cli.robot.model import RobotModel

CAMERA = "cam0"


@pytest.fixture(scope="module")
def seen(sample_data: Path) -> tuple[Arm, list[RgbdFrame]]:
    """The sample log's arm, and frames of one camera in which it moves."""
    tabletop = sample_data / "tabletop"
    source = open_source(tabletop / "log.mcap", SourceOptions())
    robot = RobotModel.from_urdf(tabletop / "robot.urdf", tabletop / "robot_spheres.yaml")
    arm = arm_of(robot.moved_by(source.joint_names), source)
    return arm, [frame for frame in frames_of(arm, source) if frame.camera == CAMERA]


@pytest.fixture(scope="module")
def arm(seen: tuple[Arm, list[RgbdFrame]]) -> Arm:
    return seen[0]


@pytest.fixture(scope="module")
def frames(seen: tuple[Arm, list[RgbdFrame]]) -> list[RgbdFrame]:
    return seen[1]


def moved(frames: list[RgbdFrame], twist: Float64) -> list[RgbdFrame]:
    """The frames of a camera whose recorded pose is off by a turn [rad] and a move [m] in its own frame."""
    T = np.linalg.inv(transform_of(twist))
    return [replace(frame, T_world_camera=frame.T_world_camera @ T) for frame in frames]


def test_a_camera_that_stands_where_the_log_says_sees_the_robot_in_its_place(
    arm: Arm,
    frames: list[RgbdFrame],
) -> None:
    found = displacement_of(arm, frames)
    assert found is not None and found[0]["distance_mm"] < 0.5 and found[0]["sigma_mm"] < 1.0


@pytest.mark.parametrize(
    ("turn", "move"),
    [
        ((0.0, 0.0, 0.0), (0.008, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, -0.01)),
        ((0.0, 0.009, 0.0), (0.0, 0.0, 0.0)),
        ((0.006, -0.005, 0.003), (0.003, 0.004, 0.005)),
    ],
    ids=["aside", "back", "turned", "both"],
)
def test_a_camera_that_stands_elsewhere_moves_what_it_sees_by_as_much(
    arm: Arm, frames: list[RgbdFrame], turn: tuple[float, ...], move: tuple[float, ...]
) -> None:
    twist = np.array([*turn, *move])
    shown = [arm.rows(f.depth, f.intrinsics, f.T_world_camera, np.zeros(6), f.stamp_ns, 0.03) for f in frames]
    points = np.concatenate([rows.points for rows in shown if rows is not None])
    T = transform_of(twist)
    true = np.sqrt(np.square(points @ (T[:3, :3] - np.eye(3)).T + T[:3, 3]).sum(axis=1).mean())
    found = displacement_of(arm, moved(frames, twist))
    assert found[0]["distance_mm"] == pytest.approx(1e3 * true, abs=0.5)


def test_each_camera_is_measured_by_its_own_frames_and_one_that_is_off_is_told(
    arm: Arm,
    frames: list[RgbdFrame],
) -> None:
    off = [replace(frame, camera="off") for frame in moved(frames, np.array([0.0, 0.0, 0.0, 0.008, 0.0, 0.0]))]
    blind = [replace(frame, camera="blind", depth=np.zeros_like(frame.depth)) for frame in frames]
    found = displaced_cameras(arm, [*frames, *off, *blind])
    assert {camera: is_displaced(row) for camera, row in found.items()} == {CAMERA: False, "off": True}


@pytest.mark.parametrize("size", [0.008, 0.02, 0.03])
def test_a_camera_that_is_off_is_placed_where_it_truly_stands(arm: Arm, frames: list[RgbdFrame], size: float) -> None:
    off = moved(frames, np.array([0.3 * size, -0.2 * size, 0.2 * size, size, 0.0, 0.5 * size]))
    rows = displaced_cameras(arm, off)
    assert rows[CAMERA]["left_mm"] < 0.5
    for true, frame in zip(frames, off, strict=True):
        assert correct_pose(frame, rows).T_world_camera == pytest.approx(true.T_world_camera, abs=1e-3)
    assert correct_pose(frames[0], {}) is frames[0]


@pytest.mark.parametrize("move", [0.06, 0.1, 0.15, 0.2])
@pytest.mark.parametrize("axis", range(3))
def test_a_camera_that_is_too_far_off_is_placed_rightly_or_stays_displaced(
    arm: Arm, frames: list[RgbdFrame], axis: int, move: float
) -> None:
    """A few pixels of another surface may agree with the robot's: they are no small displacement."""
    off = moved(frames, np.concatenate([np.full(3, 0.3 * move), move * np.eye(3)[axis]]))
    row = displaced_cameras(arm, off).get(CAMERA)
    assert row is None or is_displaced(row)
    if row is not None and is_corrected(row):
        frame = correct_pose(off[0], {CAMERA: row})
        assert frame.T_world_camera == pytest.approx(frames[0].T_world_camera, abs=2e-3)


def assert_stays_displaced(arm: Arm, frames: list[RgbdFrame]) -> None:
    row = displaced_cameras(arm, frames)[CAMERA]
    assert (is_displaced(row), is_corrected(row)) == (True, False)


def test_no_camera_is_corrected_by_one_posture_or_while_it_moves(arm: Arm, frames: list[RgbdFrame]) -> None:
    off = moved(frames, np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    assert_stays_displaced(arm, [replace(off[0]) for _ in off])
    assert_stays_displaced(arm, [*off[:-1], *moved(off[-1:], np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))])


def test_where_one_camera_cannot_be_corrected_none_is(arm: Arm, frames: list[RgbdFrame]) -> None:
    off = moved(frames, np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    other = [replace(frame, camera="other") for frame in moved(off[:-1], np.array([0.0, 0.0, 0.0, 0.0, 0.01, 0.0]))]
    assert is_corrected(displaced_cameras(arm, [*off, *other])[CAMERA])
    shaken = [*other, replace(off[-1], camera="other")]
    rows = displaced_cameras(arm, [*off, *shaken])
    assert {camera: (is_displaced(row), is_corrected(row)) for camera, row in rows.items()} == dict.fromkeys(
        (CAMERA, "other"), (True, False)
    )


@pytest.mark.parametrize("joint", [1, 3])
@pytest.mark.parametrize("degrees", [1.0, 4.0])
def test_a_joint_whose_zero_is_off_does_not_move_a_camera(
    arm: Arm, frames: list[RgbdFrame], joint: int, degrees: float
) -> None:
    posture = arm.posture

    def bent(stamp_ns: int) -> Float64 | None:
        q = posture(stamp_ns)
        return None if q is None else q + np.deg2rad(degrees) * np.eye(len(q))[joint]

    assert_stays_displaced(Arm(arm.model, bent), frames)


def test_one_link_alone_does_not_place_a_camera(arm: Arm, frames: list[RgbdFrame]) -> None:
    """What puts one link right may turn the camera about it."""
    off = moved(frames, np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    kept = []
    for true, frame in zip(frames, off, strict=True):
        poses = arm.surface_poses(true.stamp_ns)
        shown = arm.surface.render(poses, true.intrinsics, true.T_world_camera, true.depth)
        of_link = shown.link == arm.surface.links.index("panda_link1")
        kept.append(replace(frame, depth=np.where(of_link, frame.depth, np.float32(0.0))))
    assert_stays_displaced(arm, kept)


def test_too_little_of_the_robot_says_nothing_of_a_camera(arm: Arm, frames: list[RgbdFrame]) -> None:
    away = [replace(frame, depth=np.zeros_like(frame.depth)) for frame in frames]
    assert displacement_of(arm, away) is None
    assert displacement_of(arm, []) is None

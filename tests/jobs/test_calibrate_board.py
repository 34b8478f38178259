"""`calibrate --board`: cameras recorded far off, or nowhere; and those that nothing was observed of."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.calibration import T_HAND_WRIST, WRIST, SetUp, errors
from splatctrl_cli.calibration.board import Board, board_of, hand_eye, sighting_of
from splatctrl_cli.calibration.evidence import transform_of, twist_between
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.geometry import back_project, invert_transform, look_at, pose_at, transform_points
from splatctrl_cli.jobs.calibrate import CalibrateResult
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Bool, Float64, RgbdFrame
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.arm import HAND, Motion
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import RecordingOptions, Scene
from tests.calibration.scan import calibrated, printed, robot_in, with_board
from tests.refused import expect_refusal

OPTIONS = RecordingOptions(duration_s=2.0, fps=3.0, width=320, height=240, color_rays=0)
MOVING = replace(OPTIONS, duration_s=3.0, fps=2.0)
BOARD = Board(columns=7, rows=4, square=0.03)
EYES = [np.array([0.38 + 0.85 * np.cos(a), 0.85 * np.sin(a), 0.75]) for a in (-0.7, 0.0, 0.7)]
FAR = transform_of(np.concatenate([np.radians(60) * np.array([2, -1, 2]) / 3, 0.5 * np.array([1, 2, -2]) / 3]))


def facing(center: Float64, twist: Float64) -> Float64:
    """T_world_board of a board about a place, turned and moved a little from where it faces the cameras."""
    T = look_at(list(np.mean(EYES, axis=0)), list(center))
    T[:3, 3] = center
    T = T @ transform_of(twist)
    T[:3, 3] -= T[:3, :3] @ BOARD.points.mean(axis=0)
    return T


class Shown(SetUp):
    """Three cameras on one side of a table, before which somebody holds a board at first."""

    is_shown_to: tuple[str, ...] = ("cam0", "cam1", "cam2", WRIST)
    shown_s = 1.35

    def __init__(self, *, has_wrist: bool = False, options: RecordingOptions = OPTIONS, board: Board = BOARD) -> None:
        super().__init__(2, options, has_wrist=has_wrist)
        self.image = printed(board)
        self.cameras = tuple(
            replace(camera, T_world_camera=look_at(list(eye), [0.4, 0.0, 0.25]))
            for camera, eye in zip(self.cameras, EYES, strict=False)
        )
        self.off = dict.fromkeys(self.names, FAR)

    def board(self, seconds: float) -> Float64 | None:
        """T_world_board."""
        if seconds > self.shown_s:
            return None
        spread = [[0.2, 0.2, 0.4], [0.04] * 3]
        turn, move = np.random.default_rng(round(seconds * 1e3)).uniform(-1, 1, (2, 3)) * spread
        return facing(np.array([0.6, 0.0, 0.3]), np.concatenate([turn, move]))

    def frames(self) -> Iterator[RgbdFrame]:
        for frame in super().frames():
            T = self.board((frame.stamp_ns - self.start_ns) * 1e-9)
            is_shown = T is not None and frame.camera in self.is_shown_to
            yield with_board(frame, BOARD, T, self.image) if is_shown else frame


class Turning(Shown):
    """The same, with an arm that turns its hand about a place."""

    amount, shown_s = 1.0, 2.7

    def __init__(self, *, has_wrist: bool = False, options: RecordingOptions = MOVING) -> None:
        super().__init__(has_wrist=has_wrist, options=options)

    def _scene(self, seed: int, options: RecordingOptions) -> Scene:
        turns = np.array([[0, 0, 0], [0.35, 0.3, 0.4], [-0.35, 0.25, -0.5], [0.3, -0.3, -0.3], [-0.3, -0.25, 0.5]])
        waypoints = np.tile([-0.1, -0.4, 0.0, -1.9, 0.0, 1.5, 0.69], (5, 1))
        waypoints[:, 4:] += self.amount * turns
        waypoints[:, 0] += 0.3 * turns[:, 0]
        times = np.linspace(0.06, 0.94, 5) * options.duration_s
        return replace(super()._scene(seed, options), motion=Motion(times=times, waypoints=waypoints))

    def hand(self, seconds: float) -> Float64:
        return self.link_poses(self._motion.at(seconds)[0])[HAND]


class Gripped(Turning):
    """The same, with the board in the gripper."""

    def board(self, seconds: float) -> Float64 | None:
        middle = self.hand(0.0)
        return self.hand(seconds) @ invert_transform(middle) @ facing(middle[:3, 3] + [0.1, 0.0, -0.2], np.zeros(6))


class Lying(Turning):
    """A board that stands still, before a camera on the wrist and one beside the table."""

    amount = 0.6

    def __init__(self) -> None:
        super().__init__(has_wrist=True, options=replace(MOVING, duration_s=2.0, fps=5.0))

    def board(self, seconds: float) -> Float64 | None:
        eye = self.hand(0.0) @ T_HAND_WRIST
        center = eye[:3, 3] + 0.5 * eye[:3, 2]
        T = look_at(list(0.5 * (eye[:3, 3] + EYES[0])), list(center))
        T[:3, 3] = center - T[:3, :3] @ BOARD.points.mean(axis=0)
        return T


def check_errors(setup: SetUp, result: CalibrateResult) -> None:
    off = {row.unknown: 0.0 for row in errors("", setup, result)}
    for row in errors("", setup, result):
        off[row.unknown] = max(off[row.unknown], abs(row.error))
    assert off["position"] < 0.002 and off["rotation"] < np.radians(0.2)
    moved = [moved for camera, moved in result.moved.items() if not result.calibration.is_held(camera)]
    assert all(distance > 0.4 and angle == pytest.approx(60, abs=0.5) for distance, angle in moved)


def test_cameras_half_a_metre_off_are_found_by_a_board_that_somebody_holds(tmp_path: Path) -> None:
    setup = Shown()
    setup.off["cam0"] = np.eye(4)
    result = calibrated(setup, tmp_path, board=BOARD)
    check_errors(setup, result)
    recorded = result.calibration.cameras["cam1"].recorded  # what --calibration knows the camera by
    np.testing.assert_allclose(recorded, setup.cameras[1].T_world_camera @ FAR, atol=1e-6)


def test_cameras_without_a_recorded_pose_are_placed_against_the_one_that_is_held(tmp_path: Path) -> None:
    identity = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # --camera-pose NAME=identity
    nowhere = SourceOptions(camera_poses={f"cam{number}": identity for number in range(3)})
    setup = Shown()
    result = calibrated(setup, tmp_path, board=BOARD, options=nowhere)
    for camera in setup.cameras[1:]:
        truth = invert_transform(setup.cameras[0].T_world_camera) @ camera.T_world_camera
        off = twist_between(truth, result.calibration.cameras[camera.name].T)
        assert np.linalg.norm(off[3:]) < 0.002 and np.linalg.norm(off[:3]) < np.radians(0.2)


@pytest.mark.parametrize("setup", [partial(Gripped, options=replace(MOVING, fps=1.5)), Lying])
def test_cameras_half_a_metre_off_are_found_by_a_board_in_the_gripper_or_by_one_that_a_wrist_camera_passes(
    tmp_path: Path, plain_arm: Path, setup: Callable[[], SetUp]
) -> None:
    made = setup()
    result = calibrated(made, tmp_path, board=BOARD, **robot_in(plain_arm))
    check_errors(made, result)
    assert result.after < 0.002  # the board hides half the arm from one camera


class ShownApart(Shown):
    """The board is shown to one camera after the other."""

    def frames(self) -> Iterator[RgbdFrame]:
        for frame in super().frames():
            turn = round((frame.stamp_ns - self.start_ns) * 1e-9 * self.options.fps) % 3
            is_its = frame.camera == f"cam{turn}"
            yield frame if is_its else replace(frame, color=np.full_like(frame.color, 90))

    def board(self, seconds: float) -> Float64 | None:
        return super().board(0.4 * seconds)


class Mirrored(Shown):
    """Two cameras on the printed side, one behind the board."""

    def __init__(self) -> None:
        super().__init__()
        behind = replace(self.cameras[2], T_world_camera=look_at([-0.3, 0.2, 0.8], [0.4, 0.0, 0.25]))
        self.cameras = (*self.cameras[:2], behind)


class ShownToOne(Shown):
    is_shown_to = ("cam1",)


def test_the_hand_eye_equation_is_solved_and_poses_that_turn_about_one_axis_are_refused() -> None:
    rng = np.random.default_rng(0)
    X, stays = transform_of(rng.normal(size=6)), transform_of(rng.normal(size=6))
    ends = [transform_of(0.5 * rng.normal(size=6)) for _ in range(8)]
    pairs = [(A, invert_transform(A @ X) @ stays) for A in ends]
    pairs[3] = (pairs[3][0], pairs[3][1] @ transform_of(np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])))  # misread
    found_X, found_stays, _ = hand_eye(pairs)
    np.testing.assert_allclose(found_X, X, atol=1e-9)
    np.testing.assert_allclose(found_stays, stays, atol=1e-9)
    turns = [transform_of(np.array([0.0, 0.0, angle, *rng.normal(size=3)])) for angle in np.linspace(0, 2, 8)]
    about_one = [(A, invert_transform(A @ X) @ stays) for A in turns]
    expect_refusal("hardly turns the board", hand_eye, about_one, error=NotEvaluableError)
    expect_refusal("too few views of the board by one camera: 4", hand_eye, pairs[4:], error=NotEvaluableError)


@pytest.mark.parametrize("has_markers", [False, True])
@pytest.mark.parametrize("turn", [0.0, 0.5, 1.0])
def test_a_board_is_seen_where_it_is_whichever_way_it_is_turned(has_markers: bool, turn: float) -> None:
    board = Board(columns=7, rows=4, square=0.05) if not has_markers else Board(columns=6, rows=4, square=0.05)
    frame = next(iter(Shown().frames()))
    flat = replace(frame, depth=np.full_like(frame.depth, 5.0))
    T = facing(np.array([0.5, 0.0, 0.3]), np.zeros(6))
    half = transform_of(np.array([0.0, 0.0, turn * np.pi, 0.0, 0.0, 0.0]))
    T = T @ transform_of(np.concatenate([np.zeros(3), BOARD.points.mean(axis=0)])) @ half
    T[:3, 3] -= T[:3, :3] @ board.points.mean(axis=0)
    seen = sighting_of(board, with_board(flat, board, T, printed(board, has_markers=has_markers)))
    off = twist_between(invert_transform(frame.T_world_camera) @ T, seen.T_camera_board)
    assert np.linalg.norm(off[3:]) < 0.01 and np.linalg.norm(off[:3]) < np.radians(3)
    assert seen.depth_ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("text", ["9x6", "9x6:", "2x6:0.025", "9x6:25", "9*6:0.025", "9x6:-1"])
def test_what_is_no_board_is_refused(text: str) -> None:
    expect_refusal("expected inner corners.*; .*9x6:0.025", board_of, text, error=UsageError)


SMALL = RecordingOptions(duration_s=3.0, fps=2.0, width=160, height=120, color_rays=0)
MIDDLE = np.array([0.45, 0.0])  # [m] of the table, where the one thing stands


class Partial(SetUp):
    """Cameras that measure only some of what is before them."""

    def __init__(self, seed: int, options: RecordingOptions = SMALL) -> None:
        super().__init__(seed, options)
        self.scale = 1.0

    def shows(self, points_world: Float64, stamp_ns: int) -> Bool:
        """Which points (H, W, 3)."""
        raise NotImplementedError

    def frames(self) -> Iterator[RgbdFrame]:
        for frame in super().frames():
            points = back_project(frame.intrinsics, frame.depth)
            world = transform_points(frame.T_world_camera, points.reshape(-1, 3)).reshape(points.shape)
            shown = np.where(self.shows(world, frame.stamp_ns), frame.depth, 0.0)
            yield replace(frame, depth=shown.astype(np.float32))


class Round(Partial):
    """A table with one thing that looks the same from all sides, recorded rightly but for two cameras of three."""

    thing = "cylinder"

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.off["cam0"] = np.eye(4)

    def _scene(self, seed: int, options: RecordingOptions) -> Scene:
        scene = super()._scene(seed, options)
        source = next(p for p in tabletop.objects() if p.kind == self.thing)
        T = pose_at([*MIDDLE, source.T_world_shape[2, 3]])
        alone: tuple[Primitive, ...] = (scene.primitives[0], replace(source, T_world_shape=T), scene.primitives[-1])
        return replace(scene, primitives=alone)

    def shows(self, points_world: Float64, stamp_ns: int) -> Bool:
        """The table within its edges, and the thing, without the arm's base."""
        x, y, z = np.moveaxis(points_world, -1, 0)
        is_table = (x > -0.4) & (x < 1.0) & (np.abs(y) < 0.75) & (z > -0.04)
        return np.asarray(is_table & ~((np.hypot(x, y) < 0.25) & (z > 0.02)))


class OneLink(Partial):
    """Nothing but one link of a robot that moves."""

    link = "link4"

    def shows(self, points_world: Float64, stamp_ns: int) -> Bool:
        pose = self.link_poses(self._motion.at((stamp_ns - self.start_ns) * 1e-9)[0])[self.link]
        return np.asarray(np.linalg.norm(points_world - pose[:3, 3], axis=-1) < 0.12)


class RoundBall(Round):
    thing = "sphere"


def test_what_is_not_observed_stays_as_recorded_and_the_rest_is_found(tmp_path: Path) -> None:
    setup = Round(2)
    result = calibrated(setup, tmp_path, allow_unobserved=True)
    for camera in setup.cameras[1:]:
        found = result.calibration.cameras[camera.name]
        assert any("rotation about the table's normal" in direction for direction in found.unobserved)
        off = found.T @ invert_transform(camera.T_world_camera)  # of the world as it sees it
        recorded = camera.T_world_camera @ setup.off[camera.name] @ invert_transform(camera.T_world_camera)
        middle = np.array([*MIDDLE, 0.0, 1.0])
        assert abs((off @ middle)[2]) < 0.003 < abs((recorded @ middle)[2])
        assert np.degrees(np.arccos(off[2, 2])) < 0.3 < np.degrees(np.arccos(recorded[2, 2]))


def board_option(text: str) -> dict[str, Any]:
    return {"board": board_of(text)}


ONE_CAMERA = {"options": SourceOptions(cameras=("cam0",))}
SLOW = replace(OPTIONS, fps=2.0)
TIES_NOTHING: dict[str, tuple[Callable[[], SetUp], bool, dict[str, Any], tuple[str, ...]]] = {
    "a board shown to one camera after the other": (
        partial(ShownApart, options=replace(OPTIONS, duration_s=2.5, fps=4.0)),
        False,
        board_option("7x4:0.03"),
        ("does not tie together: cam0 | cam1, cam2", "at the same moment"),
    ),
    "a board seen from behind": (
        Mirrored,
        False,
        board_option("7x4:0.03"),
        ("too few views of the board of 7x4 inner corners: cam2 in 0", "its printed side"),
    ),
    "a board of another size": (
        partial(Shown, options=SLOW),
        False,
        board_option("8x5:0.03"),
        ("no board of 8x5 inner corners in 12 frames, but one of 7x4", "--board 7x4:0.03"),
    ),
    "a board that looks the same after half a turn": (
        partial(Shown, board=Board(columns=6, rows=4, square=0.03)),
        False,
        board_option("6x4:0.03"),
        ("looks the same after half a turn", "use a ChArUco board"),
    ),
    "a board of larger squares": (
        Shown,
        False,
        board_option("7x4:0.02"),
        ("measure about 30 mm by the cameras' depth, expected 20", "--board 7x4:0.030"),
    ),
    "no board": (
        partial(SetUp, 2, SLOW),
        False,
        board_option("7x4:0.03"),
        ("no board of 7x4 inner corners", "whole and lit"),
    ),
    "a board seen by one camera only": (
        ShownToOne,
        False,
        board_option("7x4:0.03"),
        (r"cam0 in 0, cam2 in 0 frames .*; only cam1 sees it",),
    ),
    "a board that somebody moves beside the robot": (
        partial(Turning, options=replace(MOVING, duration_s=6.0, fps=3.0)),
        True,
        board_option("7x4:0.03"),
        (r"tied to no robot: .*does not move with the robot.*; let the gripper hold the board",),
    ),
    "one round thing on a table": (partial(RoundBall, 3), False, {}, ("rotation about the table's normal",)),
    "one link of a robot": (
        partial(OneLink, 2),
        True,
        ONE_CAMERA,
        (r"not observed: translation along . of the world of cam0",),
    ),
    "too few pixels of one link": (
        partial(OneLink, 2, replace(SMALL, width=120, height=90)),
        True,
        ONE_CAMERA,
        ("measure no surface in common, and none of the robot's",),
    ),
}


@pytest.mark.parametrize("name", TIES_NOTHING)
def test_what_does_not_place_the_cameras_is_refused(name: str, tmp_path: Path, plain_arm: Path) -> None:
    setup, has_robot, more, (words, *others) = TIES_NOTHING[name]
    given = more | (robot_in(plain_arm) if has_robot else {})
    said = expect_refusal(words, calibrated, setup(), tmp_path, error=NotEvaluableError, **given)
    assert all(other in said for other in others) and not list(tmp_path.glob("rig.toml*"))


def test_a_camera_that_sees_neither_what_the_others_see_nor_the_robot_is_named(
    tmp_path: Path, plain_arm: Path
) -> None:
    setup = SetUp(2, SMALL)
    away = replace(setup.cameras[2], T_world_camera=look_at([0.6, 0.9, 0.8], [1.6, 1.3, 0.3]))
    setup.cameras = (*setup.cameras[:2], away)
    words = r"of cam2|cam0, cam1 \| cam2"
    said = expect_refusal(words, calibrated, setup, tmp_path, error=NotEvaluableError, **robot_in(plain_arm))
    assert not re.search("of cam[01]", said)

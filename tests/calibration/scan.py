"""The views of the sample's scan, the same with poses that are off and depths that are bent, and calibration boards
drawn into frames.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.calibration import SetUp, write_log
from splatctrl_cli.calibration.board import Board, matrix_of
from splatctrl_cli.calibration.evidence import transform_of
from splatctrl_cli.calibration.pose_refinement import bends_alone, unbent
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import back_project, invert_transform
from splatctrl_cli.jobs.calibrate import CalibrateRequest, CalibrateResult, calibrate
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.records import Float64, RgbdFrame, UInt8


def robot_in(sample_data: Path) -> dict[str, Path]:
    """The simulated arm's files, as requests name them."""
    folder = sample_data / "tabletop"
    return {"urdf": folder / "robot.urdf", "spheres": folder / "robot_spheres.yaml"}


def calibrated(setup: SetUp, folder: Path, **request: Any) -> CalibrateResult:
    """What `calibrate` finds in the log of a set-up, which is written first."""
    write_log(setup, folder / "log.mcap")
    return calibrate(CalibrateRequest(**{"paths": (folder / "log.mcap",), "out": folder / "rig.toml", **request}))


def views_of(sample_data: Path) -> list[RgbdFrame]:
    """Of a still scene, at their true poses."""
    source = open_to_train(RecordingRequest(path=sample_data / "dtu", is_dtu=True))
    return [record for record in source.records() if isinstance(record, RgbdFrame)]


def shrink_refinement(patch: pytest.MonkeyPatch) -> None:
    """Set smaller images, fewer points and rounds, and a wider lattice than a calibration has, for speed."""
    for name, value in {
        "BEND_GRID": (9, 12), "REFINE_NEIGHBOURS": 4, "REFINE_POINTS": 3000, "REFINE_ROWS": 104,
        "REFINE_WIDTHS": (60.0, 25.0, 10.0, 6.0), "REFINE_ROUNDS": 8,
    }.items():  # fmt: skip
        patch.setattr(fixed, name, value)


def disturbed(views: Sequence[RgbdFrame], millimetres: float, degrees: float) -> list[RgbdFrame]:
    """Each view moved and turned by so much, in a random direction."""
    rng = np.random.default_rng(3)
    found = []
    for view in views:
        turn, move = rng.normal(size=(2, 3))
        turn, move = (axis / np.linalg.norm(axis) for axis in (turn, move))
        twist = np.concatenate([np.radians(degrees) * turn, 1e-3 * millimetres * move])
        found.append(replace(view, T_world_camera=view.T_world_camera @ transform_of(twist)))
    return found


def gains_of(num: int) -> Float64:
    """Gains (N, 3) of as many views: brighter or darker by up to a quarter, each colour by its own."""
    rng = np.random.default_rng(5)
    gains = np.exp(rng.uniform(-0.2, 0.2, (num, 1)) + rng.uniform(-0.05, 0.05, (num, 3)))
    return np.asarray(gains / np.exp(np.log(gains).mean(axis=0)))


def a_bend(largest: float) -> Float64:
    """A bend (rows, columns), a saddle, of so much [1/m] at most."""
    rows, columns = fixed.BEND_GRID
    v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    alone = bends_alone()
    shape = alone @ (alone.T @ (u * u - 0.5 * v * v + 0.5 * u * v).ravel())
    return (largest * shape / np.abs(shape).max()).reshape(rows, columns)


def bent(views: Sequence[RgbdFrame], bend: Float64) -> list[RgbdFrame]:
    """The views as a camera with that bend would have recorded them."""
    return [unbent(view, -bend) for view in views]


EDGE = 24  # pixels of a drawn square


def printed(board: Board, *, has_markers: bool = False) -> UInt8:
    """The print of a board, with a white margin of a square."""
    columns, rows = board.columns + 1, board.rows + 1
    if has_markers:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
        charuco = cv2.aruco.CharucoBoard((columns, rows), board.square, 0.8 * board.square, dictionary)
        inside = charuco.generateImage((columns * EDGE, rows * EDGE))
    else:
        inside = np.kron(np.indices((rows, columns)).sum(axis=0) % 2 == 1, np.ones((EDGE, EDGE))) * 255
    return np.pad(inside.astype(np.uint8), EDGE, constant_values=255)


def with_board(frame: RgbdFrame, board: Board, T_world_board: Float64, image: UInt8) -> RgbdFrame:
    """A frame at its true pose, in which the board is seen; from behind it is grey."""
    lens, finer = frame.intrinsics, 3
    T = invert_transform(frame.T_world_camera) @ T_world_board
    to_metres = np.array([[1, 0, 0.5 - 2 * EDGE], [0, 1, 0.5 - 2 * EDGE], [0, 0, EDGE / board.square]])
    enlarge = np.array([[finer, 0, (finer - 1) / 2], [0, finer, (finer - 1) / 2], [0, 0, 1.0]])
    H = enlarge @ matrix_of(lens) @ T[:3, [0, 1, 3]] @ to_metres
    size = (finer * lens.width, finer * lens.height)
    shade, mask = (
        cv2.resize(cv2.warpPerspective(one, H, size), (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        for one in (image, np.full_like(image, 255))
    )
    rays = back_project(lens, np.ones((lens.height, lens.width), np.float32))
    depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
    shows = (mask > 127) & (depth > 0) & ((frame.depth == 0) | (depth < frame.depth))
    is_front = T[:3, 2] @ T[:3, 3] > 0
    color = np.full((lens.height, lens.width, 3), 90, np.uint8)
    color[shows] = shade[shows][:, None] if is_front else 150
    return replace(frame, color=color, depth=np.where(shows, depth, frame.depth).astype(np.float32))

"""Calibration boards drawn into simulated frames, where they hide what is behind them."""

from dataclasses import replace

import cv2
import numpy as np

from splatctrl_cli.calibration.board import Board, matrix_of
from splatctrl_cli.geometry import back_project, invert_transform
from splatctrl_cli.records import Float64, RgbdFrame, UInt8

EDGE = 24  # pixels of a drawn square


def printed(board: Board, *, has_markers: bool = False) -> UInt8:
    """The print of a board, with a white margin of a square."""
    columns, rows = board.columns + 1, board.rows + 1
    if has_markers:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
        charuco = cv2.aruco.CharucoBoard((columns, rows), board.square, 0.8 * board.square, dictionary)
        inside = charuco.generateImage((columns * EDGE, rows * EDGE))
    else:
        is_white = np.indices((rows, columns)).sum(axis=0) % 2 == 1
        inside = np.kron(is_white, np.ones((EDGE, EDGE))) * 255
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

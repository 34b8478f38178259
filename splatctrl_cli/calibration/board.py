"""A calibration board as a camera sees it: its inner corners in an image, and where it stands against the camera."""

import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import fixed
from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import pose_at, transform_points
from splatctrl_cli.records import Float32, Float64, Intrinsics, RgbdFrame, UInt8

MARKERS = ("DICT_4X4_250", "DICT_5X5_250", "DICT_6X6_250", "DICT_7X7_250", "DICT_ARUCO_ORIGINAL")
LEAST = 15  # inner corners of a board that is believed to be one of another size
FEWEST_MARKERS = 4  # whose middles tell a homography


@dataclass(frozen=True, kw_only=True)
class Board:
    """A chessboard or ChArUco board: its inner corners in a row and in a column, and the edge of a square [m]."""

    columns: int
    rows: int
    square: float

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    @property
    def points(self) -> Float64:
        """The inner corners (K, 3) [m], row by row: x along a row, y along a column, z away from who looks at it."""
        v, u = np.divmod(np.arange(self.columns * self.rows), self.columns)
        return self.square * np.column_stack([u, v, np.zeros(len(u))])

    @property
    def is_one_way_up(self) -> bool:
        """Whether a chessboard of this size looks different after half a turn."""
        return (self.columns + self.rows) % 2 == 1


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """A board seen in a frame: T_camera_board (4, 4), and how much farther the frame's depth has it, as a ratio; None
    where it has no depth there.
    """

    camera: str
    stamp_ns: int
    T_camera_board: Float64
    depth_ratio: float | None


def board_of(text: str) -> Board:
    """The board of ``COLUMNSxROWS:SQUARE``. Raises UsageError for another form."""
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2}):(\d*\.?\d+)", text)
    columns, rows, square = (int(match[1]), int(match[2]), float(match[3])) if match else (0, 0, 0.0)
    if not (min(columns, rows) >= 3 and 0.002 <= square <= 1.0):
        raise UsageError(
            f"--board {text}: expected inner corners, 3 to 99 each way, and the edge of a square, 0.002 to 1 m",
            remedy="give it as 9x6:0.025, for 10x7 squares of 25 mm",
        )
    return Board(columns=columns, rows=rows, square=square)


def sighting_of(board: Board, frame: RgbdFrame) -> Sighting | None:
    """The board in a frame's colour image; None where it is not seen whole, or fits no pose."""
    gray: UInt8 = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.uint8)
    pixels = _marked_corners(board, gray)
    if pixels is None and board.is_one_way_up:
        pixels = _plain_corners(board, gray)
    return None if pixels is None else _sighting(board, frame, pixels)


def other_size(frame: RgbdFrame) -> tuple[int, int] | None:
    """The inner corners, the larger number first, of whatever chessboard a frame shows; None where it shows none, or
    one so small that much looks like it.
    """
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    is_found, _, meta = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), cv2.CALIB_CB_LARGER)
    return (max(meta.shape), min(meta.shape)) if is_found and meta.size >= LEAST else None


def _plain_corners(board: Board, gray: UInt8) -> Float64 | None:
    """Pixels (K, 2) of a chessboard's inner corners in the order of `Board.points`, the first at a black square."""
    is_found, corners = cv2.findChessboardCornersSB(
        gray, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not is_found:
        return None
    grid = np.asarray(corners, np.float64).reshape(board.rows, board.columns, 2)
    (ax, ay), (bx, by) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if ax * by - ay * bx < 0:  # as in a mirror
        grid = grid[:, ::-1]
    first, second = _brightness(gray, grid[:2, :2]), _brightness(gray, grid[:2, 1:3])
    if first > second:  # of the inner squares, that beside the first corner is as the corner of the board
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _brightness(gray: UInt8, square: Float64) -> float:
    """Of an image in the middle of a square, whose corners (2, 2, 2) are in pixels."""
    u, v = np.round(square.reshape(4, 2).mean(axis=0)).astype(int)
    return float(gray[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].mean())


def _marked_corners(board: Board, gray: UInt8) -> Float64 | None:
    """Pixels (K, 2) of a ChArUco board's inner corners, from the middles of its markers, which do not depend on how
    large those are, and then from the corners themselves.
    """
    for name in MARKERS:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(gray)
        if ids is None or len(ids) < FEWEST_MARKERS:
            continue
        size = (board.columns + 1, board.rows + 1)
        drawn = cv2.aruco.CharucoBoard(size, board.square, 0.5 * board.square, dictionary)
        numbers, places = np.ravel(np.asarray(drawn.getIds())), np.asarray(drawn.getObjPoints())
        middles = dict(zip(numbers.tolist(), places.mean(axis=1), strict=True))
        seen = [(middles[i], c.reshape(4, 2).mean(axis=0)) for i, c in zip(ids.ravel().tolist(), corners, strict=True)
                if i in middles]  # fmt: skip
        if len(seen) < FEWEST_MARKERS:
            continue
        there = np.array([middle[:2] for middle, _ in seen]) - board.square
        H, used = cv2.findHomography(there, np.array([pixel for _, pixel in seen]), cv2.RANSAC, 3.0)
        if H is None or 2 * int(np.sum(used)) < len(seen):
            continue
        pixels = cv2.perspectiveTransform(board.points[None, :, :2], H)[0]
        if (pixels < 2).any() or (pixels >= np.array(gray.shape[::-1]) - 3).any():
            return None
        grid = pixels.reshape(board.rows, board.columns, 2)
        edge = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
        window = int(np.clip(edge / 4, 2, 10))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
        start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), np.float32)
        refined = cv2.cornerSubPix(gray, start, (window, window), (-1, -1), stop)
        return np.asarray(refined, np.float64).reshape(-1, 2)
    return None


def _sighting(board: Board, frame: RgbdFrame, pixels: Float64) -> Sighting | None:
    """Where the board is, of the two poses that a plane may have by its corners, the one nearer to the depth."""
    matrix = matrix_of(frame.intrinsics)
    _, turns, moves, errors = cv2.solvePnPGeneric(board.points, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    fits: list[tuple[float, Float64, float | None]] = []
    for turn, move, error in zip(turns, moves, np.ravel(errors), strict=True):
        T = pose_at(np.ravel(move), cv2.Rodrigues(turn)[0])
        ratios = _depth_ratios(frame.depth, pixels, transform_points(T, board.points)[:, 2])
        bend = float(np.std(ratios)) if len(ratios) >= len(pixels) // 2 else 0.0
        middle = float(np.median(ratios)) if len(ratios) >= len(pixels) // 2 else None
        if error < fixed.CALIBRATION_BOARD_PIXELS:
            fits.append((float(error) * (0.01 + bend), T, middle))
    if not fits:
        return None
    _, T, ratio = min(fits, key=lambda fit: fit[0])
    return Sighting(camera=frame.camera, stamp_ns=frame.stamp_ns, T_camera_board=T, depth_ratio=ratio)


def _depth_ratios(depth: Float32, pixels: Float64, z: Float64) -> Float64:
    """The depths at pixels (K, 2) in terms of what they should be, z (K,) [m], of those that have one."""
    height, width = depth.shape
    u, v = np.round(pixels).astype(int).T
    seen = depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    return np.asarray((seen / z)[(seen > 0) & (z > 0)])


def matrix_of(lens: Intrinsics) -> NDArray[Any]:
    """K (3, 3) of a pinhole camera."""
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])

"""Calibration boards: corners, board poses, and camera poses without recorded ones."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.calibration.evidence import Arm
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.geometry import invert_transform, pose_at, transform_points
from splatctrl_cli.records import Float32, Float64, Intrinsics, RgbdFrame, UInt8, spread

MARKERS = ("DICT_4X4_250", "DICT_5X5_250", "DICT_6X6_250", "DICT_7X7_250", "DICT_ARUCO_ORIGINAL")
LEAST = 15  # inner corners of a board that is believed to be one of another size
FEWEST_MARKERS = 4  # whose middles tell a homography


@dataclass(frozen=True, kw_only=True)
class Board:
    """A chessboard or ChArUco board: inner corners per row and column, square's edge [m]."""

    columns: int
    rows: int
    square: float

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    @property
    def points(self) -> Float64:
        """Inner corners (K, 3) [m], row by row.

        x is along rows, y along columns, z away from the viewer.
        """
        v, u = np.divmod(np.arange(self.columns * self.rows), self.columns)
        return self.square * np.column_stack([u, v, np.zeros(len(u))])

    @property
    def is_one_way_up(self) -> bool:
        """True if half a turn changes the chessboard."""
        return (self.columns + self.rows) % 2 == 1


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """A board in a frame: T_camera_board (4, 4), and the ratio of measured to expected depth."""

    camera: str
    stamp_ns: int
    T_camera_board: Float64
    depth_ratio: float | None


def board_of(text: str) -> Board:
    """Parse ``COLUMNSxROWS:SQUARE``. Raises UsageError for another form."""
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2}):(\d*\.?\d+)", text)
    columns, rows, square = (int(match[1]), int(match[2]), float(match[3])) if match else (0, 0, 0.0)
    refuse_if(
        not (min(columns, rows) >= 3 and 0.002 <= square <= 1.0),
        f"--board {text}: expected inner corners, 3 to 99 each way, and the edge of a square, 0.002 to 1 m",
        remedy="give it as 9x6:0.025, for 10x7 squares of 25 mm",
        error=UsageError,
    )
    return Board(columns=columns, rows=rows, square=square)


def sighting_of(board: Board, frame: RgbdFrame) -> Sighting | None:
    """The board in a frame's image; None if partly hidden or without a pose."""
    gray: UInt8 = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.uint8)
    pixels = _marked_corners(board, gray)
    if pixels is None and board.is_one_way_up:
        pixels = _plain_corners(board, gray)
    return None if pixels is None else _sighting(board, frame, pixels)


def other_size(frame: RgbdFrame) -> tuple[int, int] | None:
    """Numbers of inner corners, larger first, of any chessboard in view; None without one."""
    is_found, _, meta = cv2.findChessboardCornersSBWithMeta(
        cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), (3, 3), cv2.CALIB_CB_LARGER
    )
    return (max(meta.shape), min(meta.shape)) if is_found and meta.size >= LEAST else None


def _plain_corners(board: Board, gray: UInt8) -> Float64 | None:
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
    if first > second:  # the inner square at the first corner has the colour of the board's corner
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _brightness(gray: UInt8, square: Float64) -> float:
    u, v = np.round(square.reshape(4, 2).mean(axis=0)).astype(int)
    return float(gray[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].mean())


def _marked_corners(board: Board, gray: UInt8) -> Float64 | None:
    for name in MARKERS:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(gray)
        if ids is None or len(ids) < FEWEST_MARKERS:
            continue
        drawn = cv2.aruco.CharucoBoard(
            (board.columns + 1, board.rows + 1), board.square, 0.5 * board.square, dictionary
        )
        numbers, places = np.ravel(np.asarray(drawn.getIds())), np.asarray(drawn.getObjPoints())
        middles = dict(zip(numbers.tolist(), places.mean(axis=1), strict=True))
        seen = [(middles[i], c.reshape(4, 2).mean(axis=0)) for i, c in zip(ids.ravel().tolist(), corners, strict=True)
                if i in middles]  # fmt: skip
        if len(seen) < FEWEST_MARKERS:
            continue
        positions = np.array([middle[:2] for middle, _ in seen]) - board.square
        H, used = cv2.findHomography(positions, np.array([pixel for _, pixel in seen]), cv2.RANSAC, 3.0)
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
        return np.asarray(cv2.cornerSubPix(gray, start, (window, window), (-1, -1), stop), np.float64).reshape(-1, 2)
    return None


def _sighting(board: Board, frame: RgbdFrame, pixels: Float64) -> Sighting | None:
    """The board's pose. A plane's corners allow two poses; depth selects one."""
    _, turns, moves, errors = cv2.solvePnPGeneric(
        board.points, pixels, matrix_of(frame.intrinsics), None, flags=cv2.SOLVEPNP_IPPE
    )
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
    height, width = depth.shape
    u, v = np.round(pixels).astype(int).T
    seen = depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    return np.asarray((seen / z)[(seen > 0) & (z > 0)])


def matrix_of(lens: Intrinsics) -> NDArray[Any]:
    """K (3, 3) of a pinhole camera."""
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])


SHOW = "show the board to neighbouring cameras at the same moment, or keep some with --cameras"


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Recorded T_world_camera (4, 4) by camera and stamp [ns], moving cameras, robot, and fixed cameras."""

    recorded: Mapping[str, Mapping[int, Float64]]
    moving: frozenset[str]
    arm: Arm | None = None
    anchors: Sequence[str] = ()


HandEye = tuple[Float64, Float64, float]
"""X (4, 4), the ``A X B`` (4, 4) that it keeps constant, and the median deviation [m]."""


def board_start(board: Board, sightings: Sequence[Sighting], rig: Rig) -> dict[str, Float64]:
    """T_recorded_camera (4, 4) by camera, from sightings of a board.

    Hand-eye calibration first places moving cameras by a stationary board, or stationary cameras by a board on a
    link. The board then ties the other cameras to these, or to the `anchors`. Raises NotEvaluableError for too few
    sightings, squares of another size, or cameras that the board does not tie.
    """
    by_camera = {camera: [s for s in sightings if s.camera == camera] for camera in rig.recorded}
    _check_seen(board, by_camera)
    placed = {camera: np.eye(4) for camera in rig.anchors}
    T_world_board: Float64 | None = None
    stands = _board_stands(by_camera, rig)
    reasons: list[str] = []
    for camera in [camera for camera in rig.recorded if camera not in rig.anchors]:
        try:
            if camera in rig.moving and stands:
                X, stays, off = hand_eye(
                    [(rig.recorded[camera][s.stamp_ns], s.T_camera_board) for s in by_camera[camera]]
                )
                _check_fit(off, f"{camera}, which moves,")
                placed[camera], T_world_board = X, stays
            elif camera not in rig.moving and not stands and rig.arm is not None and not rig.anchors:
                T_world_camera = _place_by_link(rig.arm, by_camera[camera])
                placed[camera] = (
                    invert_transform(rig.recorded[camera][by_camera[camera][0].stamp_ns]) @ T_world_camera
                )
        except NotEvaluableError as error:
            reasons.append(error.message.removeprefix("calibrate: "))
    refuse_if(
        not placed,
        "calibrate: the board is tied to no robot: "
        + ("; ".join(dict.fromkeys(reasons)) or "it stands still, and no camera that moves sees it"),
        remedy="let the gripper hold the board, or a camera on the wrist see it stand still, from ten sides; or"
        " leave --urdf out",
        error=NotEvaluableError,
    )
    while missing := [camera for camera in rig.recorded if camera not in placed]:
        votes = {camera: _votes(camera, by_camera, placed, T_world_board, rig, stands) for camera in missing}
        best = max(missing, key=lambda camera: len(votes[camera]))
        groups = f"{', '.join(sorted(placed))} | {', '.join(missing)}"
        refuse_if(
            len(votes[best]) < fixed.CALIBRATION_BOARD_FEWEST,
            f"calibrate: cameras that the board does not tie together: {groups}: they never see it at the same"
            f" moment (expected {fixed.CALIBRATION_BOARD_FEWEST} times)",
            remedy=SHOW,
            error=NotEvaluableError,
        )
        placed[best] = invert_transform(rig.recorded[best][by_camera[best][0].stamp_ns]) @ middle_pose(votes[best])
    return placed


def _check_seen(board: Board, by_camera: Mapping[str, Sequence[Sighting]]) -> None:
    fewest = fixed.CALIBRATION_BOARD_FEWEST
    few = [f"{camera} in {len(its)}" for camera, its in by_camera.items() if len(its) < fewest]
    seen = [camera for camera, its in by_camera.items() if len(its) >= fewest]
    only = f"; only {seen[0]} sees it" if len(seen) == 1 and len(by_camera) > 1 else ""
    refuse_if(
        few,
        f"calibrate: too few views of the board of {board} inner corners: {', '.join(few)} frames (expected"
        f" {fewest}){only}",
        remedy=f"hold its printed side, whole and lit, in view of every camera; {SHOW}",
        error=NotEvaluableError,
    )
    ratios = [s.depth_ratio for its in by_camera.values() for s in its if s.depth_ratio is not None]
    ratio = float(np.median(ratios)) if ratios else 1.0
    low, high = fixed.CALIBRATION_BOARD_DEPTH
    refuse_if(
        not low < ratio < high,
        f"calibrate: the squares of the board measure about {1e3 * ratio * board.square:.0f} mm by the cameras'"
        f" depth, expected {1e3 * board.square:g}",
        remedy=f"measure a square: --board {board}:{ratio * board.square:.3f}; or the depth unit is wrong"
        " (--depth-scale)",
        error=NotEvaluableError,
    )


def _board_stands(by_camera: Mapping[str, Sequence[Sighting]], rig: Rig) -> bool:
    for camera, its in by_camera.items():
        places = np.array([s.T_camera_board[:3, 3] for s in its])
        away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        if camera not in rig.moving and len(its) > 1 and np.median(away) > fixed.CALIBRATION_BOARD_MOVED:
            return False
    return True


def _place_by_link(arm: Arm, sightings: Sequence[Sighting]) -> Float64:
    fits: list[HandEye] = []
    reasons = ["no joint states at its frames"]
    for link in arm.model.frame_names:
        poses = [(arm.link_pose(link, s.stamp_ns), s.T_camera_board) for s in sightings]
        try:
            fits.append(hand_eye([(invert_transform(at), seen) for at, seen in poses if at is not None]))
        except NotEvaluableError as error:
            reasons.append(error.message)
    refuse_if(not fits, reasons[-1], error=NotEvaluableError)
    X, _, off = min(fits, key=lambda fit: fit[2])
    _check_fit(off, f"the board before {sightings[0].camera}, on the link that fits best,")
    return X


def _check_fit(off: float, what: str) -> None:
    refuse_if(
        off > fixed.CALIBRATION_BOARD_FIT,
        f"calibrate: {what} does not move with the robot: {1e3 * off:.0f} mm off (expected"
        f" {1e3 * fixed.CALIBRATION_BOARD_FIT:.0f})",
        error=NotEvaluableError,
    )


def hand_eye(pairs: Sequence[tuple[Float64, Float64]]) -> HandEye:
    """X (4, 4) with one ``A X B`` for all pairs (A, B), that product, and the median deviation [m].

    Solves ``(A_j^-1 A_i) X = X (B_j B_i^-1)``: X turns the B factors' rotation vectors into the A factors'; its
    translation is then linear (after Park and Martin, Robot sensor calibration, 1994). Outliers are dropped once.
    Raises NotEvaluableError for too few pairs, or rotation about fewer than two axes.
    """
    pairs = spread(pairs, fixed.CALIBRATION_FRAMES)
    refuse_if(
        len(pairs) < fixed.CALIBRATION_BOARD_VIEWS,
        f"calibrate: too few views of the board by one camera: {len(pairs)} (expected"
        f" {fixed.CALIBRATION_BOARD_VIEWS})",
        error=NotEvaluableError,
    )
    for is_last in (False, True):
        X = _hand_eye(pairs)
        ends = [A @ X @ B for A, B in pairs]
        stays = middle_pose(ends)
        away = np.array([np.linalg.norm(end[:3, 3] - stays[:3, 3]) for end in ends])
        if is_last:
            break
        near = away <= 3 * np.median(away) + 1e-9
        pairs = [pair for pair, is_near in zip(pairs, near.tolist(), strict=True) if is_near]
    return X, stays, float(np.median(away))


def _hand_eye(pairs: Sequence[tuple[Float64, Float64]]) -> Float64:
    lefts, rights = [], []
    for i, (A_i, B_i) in enumerate(pairs):
        for A_j, B_j in pairs[:i]:
            lefts.append(invert_transform(A_j) @ A_i)
            rights.append(B_j @ invert_transform(B_i))
    turned_left, turned_right = (
        np.array([cv2.Rodrigues(T[:3, :3])[0].ravel() for T in some]) for some in (lefts, rights)
    )
    spreads = np.linalg.svd(turned_left, compute_uv=False) / np.sqrt(len(turned_left))
    refuse_if(
        spreads[1] < fixed.CALIBRATION_BOARD_TURN,
        "calibrate: the robot hardly turns the board, or the camera that sees it, about two axes:"
        f" {np.degrees(spreads[1]):.1f} degrees about the second (expected"
        f" {np.degrees(fixed.CALIBRATION_BOARD_TURN):.0f})",
        error=NotEvaluableError,
    )
    U, _, Vt = np.linalg.svd(turned_left.T @ turned_right)
    X = np.eye(4)
    R = X[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    rows = np.concatenate([A[:3, :3] - np.eye(3) for A in lefts])
    X[:3, 3] = np.linalg.lstsq(
        rows, np.concatenate([R @ B[:3, 3] - A[:3, 3] for A, B in zip(lefts, rights, strict=True)]), rcond=None
    )[0]
    return X


def _votes(
    camera: str,
    by_camera: Mapping[str, Sequence[Sighting]],
    placed: Mapping[str, Float64],
    T_world_board: Float64 | None,
    rig: Rig,
    stands: bool,
) -> list[Float64]:
    """T_world_camera (4, 4) of a stationary camera, per sighting shared with a placed camera.

    placed: T_recorded_camera (4, 4) by camera. T_world_board: of a stationary board, or None.
    """
    votes = []
    if camera in rig.moving:
        return []
    for own in by_camera[camera]:
        if T_world_board is not None:
            votes.append(T_world_board @ invert_transform(own.T_camera_board))
            continue
        for other in (s for name in placed for s in by_camera[name]):
            if stands or abs(other.stamp_ns - own.stamp_ns) <= fixed.CALIBRATION_BOARD_TOGETHER_NS:
                T_world_other = rig.recorded[other.camera][other.stamp_ns] @ placed[other.camera]
                votes.append(T_world_other @ other.T_camera_board @ invert_transform(own.T_camera_board))
    return votes


def middle_pose(poses: Sequence[Float64]) -> Float64:
    """The medoid of poses (4, 4); a radian counts as 0.3 m."""
    few = np.array(spread(poses, 100))
    moves = np.linalg.norm(few[:, None, :3, 3] - few[None, :, :3, 3], axis=2)
    cosines = (np.einsum("iab,jab->ij", few[:, :3, :3], few[:, :3, :3]) - 1) / 2
    return np.asarray(few[int(np.argmin((moves + 0.3 * np.arccos(np.clip(cosines, -1, 1))).sum(axis=1)))])

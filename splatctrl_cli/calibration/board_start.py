"""Where cameras stand by what they see of a calibration board: a start, where the recorded poses are none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from splatctrl_cli.calibration.arm import Arm
from splatctrl_cli.calibration.board import Board, Sighting
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Float64, spread

SHOW = "show the board to neighbouring cameras at the same moment, or keep some with --cameras"


@dataclass(frozen=True, kw_only=True)
class Rig:
    """The recorded T_world_camera (4, 4) of each camera by stamp [ns], which of them move, the robot, where it is
    known, and what is held.
    """

    recorded: Mapping[str, Mapping[int, Float64]]
    moving: frozenset[str]
    arm: Arm | None = None
    held: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class HandEye:
    """X (4, 4) such that ``A X B`` stays the same, what stays, and how far [m] the A X B are from it (median)."""

    X: Float64
    stays: Float64
    distance: float


@dataclass(kw_only=True)
class _Placed:
    """T_world_camera (4, 4) of cameras by their corrections; T_world_board where the board stands still."""

    corrections: dict[str, Float64] = field(default_factory=dict)
    T_world_board: Float64 | None = None


def board_start(board: Board, sightings: Sequence[Sighting], rig: Rig) -> dict[str, Float64]:
    """T_recorded_camera (4, 4) by camera.

    Without a robot and a camera that moves, what is held stays and the others are tied to it by the board. Else a
    camera that moves is placed by a board that stands still, or one that stands still by a board that a link carries
    (hand-eye calibration), and the others are tied to those. Raises NotEvaluableError where that does not reach all.
    """
    by_camera = {camera: [s for s in sightings if s.camera == camera] for camera in rig.recorded}
    _check_seen(board, by_camera)
    placed = _Placed(corrections={camera: np.eye(4) for camera in rig.held})
    stands = _board_stands(by_camera, rig)
    reasons: list[str] = []
    for camera in [camera for camera in rig.recorded if camera not in rig.held]:
        try:
            if camera in rig.moving and stands:
                found = hand_eye([(rig.recorded[camera][s.stamp_ns], s.T_camera_board) for s in by_camera[camera]])
                _check_fit(found, f"{camera}, which moves,")
                placed.corrections[camera], placed.T_world_board = found.X, found.stays
            elif camera not in rig.moving and not stands and rig.arm is not None and not rig.held:
                found = _carried(rig.arm, by_camera[camera])
                placed.corrections[camera] = invert_transform(_recorded(rig, by_camera[camera][0])) @ found.X
        except NotEvaluableError as error:
            reasons.append(error.message.removeprefix("calibrate: "))
    if not placed.corrections:
        raise NotEvaluableError(
            "calibrate: the board is tied to no robot: "
            + ("; ".join(dict.fromkeys(reasons)) or "it stands still, and no camera that moves sees it"),
            remedy="let the gripper hold the board, or a camera on the wrist see it stand still, from ten sides; or"
            " leave --urdf out",
        )
    while missing := [camera for camera in rig.recorded if camera not in placed.corrections]:
        votes = {camera: _votes(camera, by_camera, placed, rig, stands=stands) for camera in missing}
        best = max(missing, key=lambda camera: len(votes[camera]))
        if len(votes[best]) < fixed.CALIBRATION_BOARD_FEWEST:
            groups = f"{', '.join(sorted(placed.corrections))} | {', '.join(missing)}"
            raise NotEvaluableError(
                f"calibrate: cameras that the board does not tie together: {groups}: they never see it at the same"
                f" moment (expected {fixed.CALIBRATION_BOARD_FEWEST} times)",
                remedy=SHOW,
            )
        recorded = _recorded(rig, by_camera[best][0])
        placed.corrections[best] = invert_transform(recorded) @ middle_pose(votes[best])
    return placed.corrections


def _check_seen(board: Board, by_camera: Mapping[str, Sequence[Sighting]]) -> None:
    """Raise NotEvaluableError for cameras that see too little of the board, and for a board of other squares."""
    fewest = fixed.CALIBRATION_BOARD_FEWEST
    few = [f"{camera} in {len(its)}" for camera, its in by_camera.items() if len(its) < fewest]
    if few:
        seen = [camera for camera, its in by_camera.items() if len(its) >= fewest]
        only = f"; only {seen[0]} sees it" if len(seen) == 1 and len(by_camera) > 1 else ""
        raise NotEvaluableError(
            f"calibrate: too few views of the board of {board} inner corners: {', '.join(few)} frames (expected"
            f" {fewest}){only}",
            remedy=f"hold its printed side, whole and lit, in view of every camera; {SHOW}",
        )
    ratios = [s.depth_ratio for its in by_camera.values() for s in its if s.depth_ratio is not None]
    ratio = float(np.median(ratios)) if ratios else 1.0
    low, high = fixed.CALIBRATION_BOARD_DEPTH
    if not low < ratio < high:
        raise NotEvaluableError(
            f"calibrate: the squares of the board measure about {1e3 * ratio * board.square:.0f} mm by the cameras'"
            f" depth, expected {1e3 * board.square:g}",
            remedy=f"measure a square: --board {board}:{ratio * board.square:.3f}; or the depth unit is wrong"
            " (--depth-scale)",
        )


def _board_stands(by_camera: Mapping[str, Sequence[Sighting]], rig: Rig) -> bool:
    """Whether no camera that stands still sees the board move; without one, it is taken to stand."""
    for camera, its in by_camera.items():
        places = np.array([s.T_camera_board[:3, 3] for s in its])
        if camera not in rig.moving and len(its) > 1:
            away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
            if np.median(away) > fixed.CALIBRATION_BOARD_MOVED:
                return False
    return True


def _carried(arm: Arm, sightings: Sequence[Sighting]) -> HandEye:
    """T_world_camera of a camera that sees the board on a link of the robot: the link that fits best."""
    fits: list[HandEye] = []
    reasons = ["no joint states at its frames"]
    for link in arm.model.frame_names:
        poses = [(arm.link_pose(link, s.stamp_ns), s.T_camera_board) for s in sightings]
        try:
            fits.append(hand_eye([(invert_transform(at), seen) for at, seen in poses if at is not None]))
        except NotEvaluableError as error:
            reasons.append(error.message)
    if not fits:
        raise NotEvaluableError(reasons[-1])
    best = min(fits, key=lambda fit: fit.distance)
    _check_fit(best, f"the board before {sightings[0].camera}, on the link that fits best,")
    return best


def _check_fit(found: HandEye, what: str) -> None:
    if found.distance > fixed.CALIBRATION_BOARD_FIT:
        raise NotEvaluableError(
            f"calibrate: {what} does not move with the robot: {1e3 * found.distance:.0f} mm off (expected"
            f" {1e3 * fixed.CALIBRATION_BOARD_FIT:.0f})"
        )


def hand_eye(pairs: Sequence[tuple[Float64, Float64]]) -> HandEye:
    """X (4, 4) such that ``A X B`` is the same for all pairs (A, B) of poses.

    From ``(A_j^-1 A_i) X = X (B_j B_i^-1)``: the rotation vectors of the left are those of the right turned by X, and
    with its rotation known the move is linear (after Park and Martin, Robot sensor calibration, 1994). Pairs of which
    the board was misread are left out once. Raises NotEvaluableError where there are too few, or the poses do not
    turn about two axes.
    """
    pairs = spread(pairs, fixed.CALIBRATION_FRAMES)
    if len(pairs) < fixed.CALIBRATION_BOARD_VIEWS:
        raise NotEvaluableError(
            f"calibrate: too few views of the board by one camera: {len(pairs)} (expected"
            f" {fixed.CALIBRATION_BOARD_VIEWS})"
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
    return HandEye(X=X, stays=stays, distance=float(np.median(away)))


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
    if spreads[1] < fixed.CALIBRATION_BOARD_TURN:
        raise NotEvaluableError(
            "calibrate: the robot hardly turns the board, or the camera that sees it, about two axes:"
            f" {np.degrees(spreads[1]):.1f} degrees about the second (expected"
            f" {np.degrees(fixed.CALIBRATION_BOARD_TURN):.0f})"
        )
    U, _, Vt = np.linalg.svd(turned_left.T @ turned_right)
    X = np.eye(4)
    R = X[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    rows = np.concatenate([A[:3, :3] - np.eye(3) for A in lefts])
    moved = np.concatenate([R @ B[:3, 3] - A[:3, 3] for A, B in zip(lefts, rights, strict=True)])
    X[:3, 3] = np.linalg.lstsq(rows, moved, rcond=None)[0]
    return X


def _votes(
    camera: str, by_camera: Mapping[str, Sequence[Sighting]], placed: _Placed, rig: Rig, *, stands: bool
) -> list[Float64]:
    """T_world_camera (4, 4) of a camera that stands still, by each sighting that a placed camera has, too."""
    votes = []
    if camera in rig.moving:
        return []
    for own in by_camera[camera]:
        if stands and placed.T_world_board is not None:
            votes.append(placed.T_world_board @ invert_transform(own.T_camera_board))
            continue
        for other in (s for name in placed.corrections for s in by_camera[name]):
            if stands or abs(other.stamp_ns - own.stamp_ns) <= fixed.CALIBRATION_BOARD_TOGETHER_NS:
                T_world_other = _recorded(rig, other) @ placed.corrections[other.camera]
                votes.append(T_world_other @ other.T_camera_board @ invert_transform(own.T_camera_board))
    return votes


def _recorded(rig: Rig, sighting: Sighting) -> Float64:
    return rig.recorded[sighting.camera][sighting.stamp_ns]


def middle_pose(poses: Sequence[Float64]) -> Float64:
    """Of poses (4, 4), the one that the others are nearest to in the sum, a radian counted as 0.3 m."""
    few = np.array(spread(poses, 100))
    moves = np.linalg.norm(few[:, None, :3, 3] - few[None, :, :3, 3], axis=2)
    cosines = (np.einsum("iab,jab->ij", few[:, :3, :3], few[:, :3, :3]) - 1) / 2
    away = moves + 0.3 * np.arccos(np.clip(cosines, -1, 1))
    return np.asarray(few[int(np.argmin(away.sum(axis=1)))])

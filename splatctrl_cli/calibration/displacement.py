"""Errors of cameras' poses against the visible robot, and corrections."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatctrl_cli.calibration.evidence import POSE, Arm, ArmRows, moving_cameras, transform_of
from splatctrl_cli.calibration.views import depth_sigma, strided
from splatctrl_cli.config.fixed import (
    CALIBRATION_TRAVEL,
    DISPLACED_ALIKE,
    DISPLACED_FRAMES,
    DISPLACED_PIXELS,
    DISPLACED_PRIOR,
    DISPLACED_ROUNDS,
    DISPLACED_ROWS,
    DISPLACED_SHARE,
    DISPLACED_WIDTH,
    MISPLACED,
)
from splatctrl_cli.records import Float64, RgbdFrame, spread


def displaced_cameras(arm: Arm, frames: Sequence[RgbdFrame]) -> dict[str, dict[str, Any]]:
    """Rows of `displacement_of` by camera, without cameras that show too little robot.

    A displaced stationary camera is corrected if the arm moves and the correction puts each link in place. Its row
    then has `T_recorded_camera` (16 numbers by row), and `left_mm`, the last step. If one displaced camera cannot be
    corrected, none is: the robot may be misplaced.
    """
    by_camera = {name: [f for f in frames if f.camera == name] for name in sorted({f.camera for f in frames})}
    displacements = {camera: _correct_camera(arm, its) for camera, its in by_camera.items()}
    rows = {camera: row for camera, row in displacements.items() if row is not None}
    if any(is_displaced(row) and not is_corrected(row) for row in rows.values()):
        return {
            camera: {name: row[name] for name in ("distance_mm", "sigma_mm", "num_pixels")}
            for camera, row in rows.items()
        }
    return rows


def is_displaced(row: Mapping[str, Any]) -> bool:
    """True if a row's distance minus sigma exceeds `MISPLACED`."""
    return bool(row["distance_mm"] - row["sigma_mm"] > 1e3 * MISPLACED)


def is_corrected(row: Mapping[str, Any]) -> bool:
    return "T_recorded_camera" in row


def correct_pose(frame: RgbdFrame, cameras: Mapping[str, Mapping[str, Any]]) -> RgbdFrame:
    """The frame at its camera's corrected pose, if `cameras` has one."""
    row = cameras.get(frame.camera, {})
    return _move(frame, np.reshape(row["T_recorded_camera"], (4, 4))) if is_corrected(row) else frame


def _move(frame: RgbdFrame, T_recorded_camera: Float64) -> RgbdFrame:
    return replace(frame, T_world_camera=frame.T_world_camera @ T_recorded_camera)


def _correct_camera(arm: Arm, frames: Sequence[RgbdFrame]) -> dict[str, Any] | None:
    displacement = displacement_of(arm, frames)
    if displacement is None:
        return None
    row, T = displacement
    is_observed = arm.travel([f.stamp_ns for f in frames]) >= CALIBRATION_TRAVEL and not moving_cameras(frames)
    if not is_displaced(row) or not is_observed:
        return row
    left = row
    for _ in range(2):
        displacement = displacement_of(arm, [_move(frame, T) for frame in frames])
        if displacement is None:
            return row
        left, T = displacement[0], T @ displacement[1]
    if left["distance_mm"] + left["sigma_mm"] > 1e3 * MISPLACED or not _sees_links_in_place(
        arm, [_move(frame, T) for frame in frames]
    ):
        return row
    return row | {"left_mm": left["distance_mm"], "T_recorded_camera": T.ravel().tolist()}


def _sees_links_in_place(arm: Arm, frames: Sequence[RgbdFrame]) -> bool:
    """True if at least two links are clearly visible, each within half of `MISPLACED`."""
    shown = [strided(frame, DISPLACED_ROWS) for frame in spread(frames, DISPLACED_FRAMES)]
    rows_by_frame = [rows for frame in shown if (rows := _rows(arm, frame, np.eye(4))) is not None]
    links, residual = (
        np.concatenate([getattr(rows, name) for rows in rows_by_frame]) for name in ("links", "residual")
    )
    by_link = [residual[links == link] for link in np.unique(links)]
    medians = [abs(np.median(each)) for each in by_link if len(each) >= DISPLACED_PIXELS]
    return len(medians) > 1 and max(medians) <= 0.5 * MISPLACED


def displacement_of(arm: Arm, frames: Sequence[RgbdFrame]) -> tuple[dict[str, Any], Float64] | None:
    """One camera's pose error and correction T_recorded_camera (4, 4); None if little robot shows.

    `distance_mm`: root mean square motion of the robot's `num_pixels` visible points by the correction. `sigma_mm`:
    of their middle.

    Takes two Gauss-Newton steps on point-to-plane distances, with Huber's weight beyond two sigma. `DISPLACED_ALIKE`
    neighbouring pixels count as one: their errors correlate. `distance_mm` is `DISPLACED_WIDTH` if less than
    `DISPLACED_SHARE` of the expected pixels lie within that distance of the robot.
    """
    shown = [strided(frame, DISPLACED_ROWS) for frame in spread(frames, DISPLACED_FRAMES)]
    T, prior = np.eye(4), np.eye(POSE) / DISPLACED_PRIOR**2
    parts: list[ArmRows] = []
    information = prior
    for _ in range(DISPLACED_ROUNDS):
        parts = [rows for frame in shown if (rows := _rows(arm, frame, T)) is not None]
        visible = sum(rows.num_seen - rows.num_hidden for rows in parts)
        if visible < DISPLACED_PIXELS:
            return None
        information, pull = prior.copy(), np.zeros(POSE)
        for rows in parts:
            sigma = depth_sigma(rows.points[:, 2])
            weight = 1.0 / (DISPLACED_ALIKE * sigma * np.maximum(sigma, 0.5 * np.abs(rows.residual)))
            information += rows.jacobian.T @ (weight[:, None] * rows.jacobian)
            pull += rows.jacobian.T @ (weight * rows.residual)
        T = T @ transform_of(np.asarray(np.linalg.solve(information, -pull)))
    points = np.concatenate([rows.points for rows in parts])
    if len(points) < DISPLACED_SHARE * visible:
        return {"distance_mm": 1e3 * DISPLACED_WIDTH, "sigma_mm": 0.0, "num_pixels": len(points)}, T
    moved = points @ (T[:3, :3] - np.eye(3)).T + T[:3, 3]
    by_pose = np.hstack([np.cross(np.eye(POSE // 2), points.mean(axis=0)).T, np.eye(POSE // 2)])  # of their middle
    return {
        "distance_mm": round(1e3 * float(np.sqrt(np.square(moved).sum(axis=1).mean())), 2),
        "sigma_mm": round(1e3 * float(np.trace(by_pose @ np.linalg.inv(information) @ by_pose.T)) ** 0.5, 2),
        "num_pixels": len(points),
    }, T


def _rows(arm: Arm, frame: RgbdFrame, T_recorded_camera: Float64) -> ArmRows | None:
    return arm.rows(
        frame.depth,
        frame.intrinsics,
        frame.T_world_camera @ T_recorded_camera,
        np.zeros(POSE),
        frame.stamp_ns,
        DISPLACED_WIDTH,
    )

"""How far each camera sees the robot from where its joints put it.

That far the camera's pose is off; or the robot's, where all cameras say the same.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from splatctrl_cli.calibration.evidence import POSE, Arm, ArmRows, transform_of
from splatctrl_cli.calibration.views import depth_sigma, strided
from splatctrl_cli.config.fixed import (
    DISPLACED_ALIKE,
    DISPLACED_FRAMES,
    DISPLACED_PIXELS,
    DISPLACED_PRIOR,
    DISPLACED_ROUNDS,
    DISPLACED_ROWS,
    DISPLACED_WIDTH,
    MISPLACED,
)
from splatctrl_cli.records import Float64, RgbdFrame, spread


def displaced_cameras(arm: Arm, frames: Sequence[RgbdFrame]) -> dict[str, dict[str, float]]:
    """`displacement_of` by camera, without cameras that show too little of the robot. frames: of all cameras."""
    by_camera = {name: [f for f in frames if f.camera == name] for name in sorted({f.camera for f in frames})}
    found = {camera: displacement_of(arm, its) for camera, its in by_camera.items()}
    return {camera: row for camera, row in found.items() if row is not None}


def is_displaced(row: Mapping[str, float]) -> bool:
    """Whether one of `displaced_cameras` is off: by more than `MISPLACED` and one sigma."""
    return row["distance_mm"] - row["sigma_mm"] > 1e3 * MISPLACED


def displacement_of(arm: Arm, frames: Sequence[RgbdFrame]) -> dict[str, float] | None:
    """How far off one camera's pose is, by its frames; None where they show too little of the robot.

    The pose is corrected until depth lies on the robot's rendered surface. `distance_mm`: how far that moves the
    points that the camera shows of the robot (root mean square); `sigma_mm` of it; `num_pixels`: how many points.

    Two Gauss-Newton steps by the distances along the surface's normal; a residual beyond two sigma counts less
    (Huber). Neighbouring pixels err alike, so `DISPLACED_ALIKE` of them count as one.
    """
    shown = [strided(frame, DISPLACED_ROWS) for frame in spread(frames, DISPLACED_FRAMES)]
    T, prior = np.eye(4), np.eye(POSE) / DISPLACED_PRIOR**2
    found: list[ArmRows] = []
    information = prior
    for _ in range(DISPLACED_ROUNDS):
        found = [rows for frame in shown if (rows := _rows(arm, frame, T)) is not None]
        if sum(len(rows.residual) for rows in found) < DISPLACED_PIXELS:
            return None
        information, pull = prior.copy(), np.zeros(POSE)
        for rows in found:
            sigma = depth_sigma(rows.points[:, 2])
            weight = 1.0 / (DISPLACED_ALIKE * sigma * np.maximum(sigma, 0.5 * np.abs(rows.residual)))
            information += rows.jacobian.T @ (weight[:, None] * rows.jacobian)
            pull += rows.jacobian.T @ (weight * rows.residual)
        T = T @ transform_of(np.asarray(np.linalg.solve(information, -pull)))
    points = np.concatenate([rows.points for rows in found])
    moved = points @ (T[:3, :3] - np.eye(3)).T + T[:3, 3]
    by_pose = np.hstack([np.cross(np.eye(POSE // 2), points.mean(axis=0)).T, np.eye(POSE // 2)])  # of their middle
    variance = float(np.trace(by_pose @ np.linalg.inv(information) @ by_pose.T))
    return {
        "distance_mm": round(1e3 * float(np.sqrt(np.square(moved).sum(axis=1).mean())), 2),
        "sigma_mm": round(1e3 * variance**0.5, 2),
        "num_pixels": len(points),
    }


def _rows(arm: Arm, frame: RgbdFrame, T_recorded_camera: Float64) -> ArmRows | None:
    return arm.rows(
        frame.depth,
        frame.intrinsics,
        frame.T_world_camera @ T_recorded_camera,
        np.zeros(POSE),
        frame.stamp_ns,
        DISPLACED_WIDTH,
    )

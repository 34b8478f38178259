"""How far from where its joints put it a camera sees the robot: its pose is off, or the robot's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.calibration.evidence import Arm, ArmRows, transform_of
from splatctrl_cli.calibration.views import depth_sigma, strided
from splatctrl_cli.config.fixed import (
    DISPLACED_ALIKE,
    DISPLACED_FRAMES,
    DISPLACED_PIXELS,
    DISPLACED_PRIOR,
    DISPLACED_ROUNDS,
    DISPLACED_ROWS,
    DISPLACED_WIDTH,
)
from splatctrl_cli.records import Float64, RgbdFrame, spread

POSE = 6  # a turn and a move


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """Of one camera: distance [m], the root mean square over the robot's points that it shows of how far the camera
    would have to move them to lay them on the robot's surface; sigma [m] of it; num_pixels that it rests on.
    """

    distance: float
    sigma: float
    num_pixels: int


def displacement_of(arm: Arm, frames: Sequence[RgbdFrame]) -> Displacement | None:
    """Of the camera of these frames; None where they show too little of the robot.

    Gauss-Newton steps of the camera's pose, from the distances of measured points to the rendered surface along its
    normal, each weighed down beyond two sigma (Huber). Errors of neighbouring pixels are alike: so many count as one.
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
    return Displacement(
        distance=float(np.sqrt(np.square(moved).sum(axis=1).mean())),
        sigma=float(np.sqrt(np.trace(by_pose @ np.linalg.inv(information) @ by_pose.T))),
        num_pixels=len(points),
    )


def _rows(arm: Arm, frame: RgbdFrame, T_recorded_camera: Float64) -> ArmRows | None:
    return arm.rows(
        frame.depth,
        frame.intrinsics,
        frame.T_world_camera @ T_recorded_camera,
        np.zeros(POSE),
        frame.stamp_ns,
        DISPLACED_WIDTH,
    )

"""From a goal pose to an end-effector velocity, world-aligned, linear rows first."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.records import Float64


@dataclass(frozen=True, kw_only=True)
class Guide:
    """How a goal itself moves: twist (6,) [m/s, rad/s], world, of its pose; posture (J,) [rad] that the arm leans to,
    and the velocity (J,) [rad/s] of that posture.
    """

    twist: Float64
    posture: Float64
    velocity: Float64


def rotation_vector(R: Float64) -> Float64:
    """The logarithm (3,) [rad] of a rotation (3, 3): axis times an angle in [0, pi]."""
    quat_xyzw = quat_from_rotation(R)
    half_sine = float(np.linalg.norm(quat_xyzw[:3]))
    if half_sine == 0.0:
        return np.zeros(3)
    return np.asarray(quat_xyzw[:3] * (2.0 * np.arctan2(half_sine, quat_xyzw[3]) / half_sine))


def pose_error(T_world_frame: Float64, T_world_goal: Float64) -> Float64:
    """The twist (6,) [m, rad] in world that carries a frame to its goal in one second."""
    rotation = rotation_vector(T_world_goal[:3, :3] @ T_world_frame[:3, :3].T)
    return np.concatenate([T_world_goal[:3, 3] - T_world_frame[:3, 3], rotation])


def reference_velocity(error: Float64, *, gain: float, max_linear: float, max_angular: float) -> Float64:
    """The reference (6,) [m/s, rad/s]: gain times the pose error, each part capped in norm, direction kept."""
    velocity = gain * error
    return np.concatenate([_capped(velocity[:3], max_linear), _capped(velocity[3:], max_angular)])


def _capped(vector: Float64, limit: float) -> Float64:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= limit else vector * (limit / norm)

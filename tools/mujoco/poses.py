"""Rigid transforms: T (4, 4) maps points of the second frame in its name to the first."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Float64 = NDArray[np.float64]


def pose(place: Sequence[float] | Float64, turn: Float64 | None = None) -> Float64:
    """The transform (4, 4) of a place (3,) [m] and a rotation matrix (3, 3)."""
    T = np.eye(4)
    T[:3, 3] = place
    if turn is not None:
        T[:3, :3] = turn
    return T


def turn_rpy(rpy: Sequence[float] | Float64) -> Float64:
    """The rotation matrix of roll, pitch and yaw [rad] about fixed axes, as in URDF."""
    return np.asarray(Rotation.from_euler("xyz", rpy).as_matrix())


def turn_along(z_axis: Float64) -> Float64:
    """A rotation matrix whose third column is along z_axis (3,)."""
    z = z_axis / np.linalg.norm(z_axis)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def inverse(T: Float64) -> Float64:
    """The inverse of rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    turned = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = turned
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", turned, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def moved(T: Float64, points: Float64) -> Float64:
    """Points (..., 3) by one transform (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def look_at(eye: Sequence[float] | Float64, target: Sequence[float] | Float64) -> Float64:
    """T_world_camera of an optical frame (z forward, y down) at eye (3,), upright, looking at target (3,)."""
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return pose(eye, np.column_stack([right, np.cross(forward, right), forward]))


def quat_wxyz(T: Float64) -> Float64:
    """The unit quaternion (4,) of a transform, scalar first, as in MuJoCo."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return np.array([w, x, y, z])


def quat_xyzw(T: Float64) -> Float64:
    """The unit quaternion (4,) of a transform, scalar last, as in ROS."""
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat())

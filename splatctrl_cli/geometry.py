"""Rigid transforms T (4, 4), rotations (3, 3), pinhole camera; float64.

T_world_camera maps camera to world. Quaternions are (x, y, z, w), positions (3,) [m].
"""

import numpy as np
from numpy.typing import ArrayLike

from splatctrl_cli.records import Float64, Floats, Index, Intrinsics


def invert_transform(T: Float64) -> Float64:
    """Inverse of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def transform_points(T: Float64, points: Floats) -> Float64:
    """Points (..., 3) moved by T."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], dtype=np.float64)


def rotation_from_quat(quat_xyzw: ArrayLike) -> Float64:
    """Rotation of a finite, nonzero quaternion.

    It is first scaled by a power of two, which does not round: squares of tiny numbers would underflow.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    quat = np.ldexp(quat, -np.frexp(np.abs(quat).max())[1])
    x, y, z, w = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_from_rotation(R: Float64) -> Float64:
    """A rotation's unit quaternion with w >= 0."""
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], 0, 0, 0],
            [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], 0, 0],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], 0],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    quat = np.linalg.eigh(K, UPLO="L")[1][:, -1]
    return np.asarray(-quat if quat[3] < 0 else quat)


def pose_at(position: ArrayLike, R: ArrayLike | None = None) -> Float64:
    """T of a position and a rotation (default: none)."""
    T = np.eye(4)
    T[:3, 3] = position
    if R is not None:
        T[:3, :3] = R
    return T


def compare_poses(T_world_a: Float64, T_world_b: Float64) -> tuple[float, float]:
    """Distance [m] and angle [degrees] between two poses."""
    T = invert_transform(T_world_a) @ T_world_b
    cosine = np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(np.arccos(cosine)))


def turn_about_z(angle: float) -> Float64:
    """Rotation by an angle [rad] about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def frame_along(axis: Float64) -> Float64:
    """A rotation with z along `axis` (3,)."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def face_normals(corners: Float64) -> Float64:
    """Normals (F, 3) of triangles (F, 3, 3), times twice their area.

    Outward if corners run counter-clockwise seen from outside.
    """
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def transform_from(position: ArrayLike, quat_xyzw: ArrayLike) -> Float64:
    """T of a position and a quaternion."""
    return pose_at(position, rotation_from_quat(quat_xyzw))


def interpolate_transform(T_a: Float64, T_b: Float64, fraction: float) -> Float64:
    """T at `fraction` in [0, 1]: linear position, slerp rotation."""
    quat_a, quat_b = quat_from_rotation(T_a[:3, :3]), quat_from_rotation(T_b[:3, :3])
    cosine = float(quat_a @ quat_b)
    if cosine < 0:
        quat_b, cosine = -quat_b, -cosine
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        quat = (1 - fraction) * quat_a + fraction * quat_b
    else:
        quat = (np.sin((1 - fraction) * angle) * quat_a + np.sin(fraction * angle) * quat_b) / np.sin(angle)
    return transform_from((1 - fraction) * T_a[:3, 3] + fraction * T_b[:3, 3], quat)


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Float64:
    """T_world_camera (z forward, y down) at `eye`, towards `target`."""
    eye_world = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye_world
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    right /= np.linalg.norm(right)
    return pose_at(eye_world, np.column_stack([right, np.cross(forward, right), forward]))


def strided_lens(lens: Intrinsics, stride: int) -> Intrinsics:
    """Camera of every `stride`-th pixel: pixel (0, 0) stays."""
    fx, fy, cx, cy = (value / stride for value in (lens.fx, lens.fy, lens.cx, lens.cy))
    width, height = -(-lens.width // stride), -(-lens.height // stride)
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def project(intrinsics: Intrinsics, points_camera: Floats) -> Float64:
    """Pixels (..., 2) of camera-frame points (..., 3) with z > 0."""
    z = points_camera[..., 2]
    u = intrinsics.fx * points_camera[..., 0] / z + intrinsics.cx
    v = intrinsics.fy * points_camera[..., 1] / z + intrinsics.cy
    return np.stack([u, v], axis=-1).astype(np.float64)


def back_project(intrinsics: Intrinsics, depth: Floats) -> Float64:
    """Camera-frame points (H, W, 3) of depth (H, W) [m]."""
    v, u = np.ogrid[: depth.shape[0], : depth.shape[1]]
    return back_project_pixels(intrinsics, u, v, depth)


def back_project_pixels(intrinsics: Intrinsics, u: Index, v: Index, depth: Floats) -> Float64:
    """Camera-frame points (..., 3) of pixels; u, v broadcast to depth (...) [m]."""
    x = (u - intrinsics.cx) / intrinsics.fx * depth
    y = (v - intrinsics.cy) / intrinsics.fy * depth
    return np.stack([x, y, depth], axis=-1).astype(np.float64)

"""Which points of the world a camera saw."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.geometry import back_project, invert_transform, project, transform_points
from splatctrl_cli.records import Bool, Float64, RgbdFrame

MIN_Z = 1e-6  # [m] in front of the camera


def seen_by(points_world: NDArray[np.floating], frames: Iterable[RgbdFrame], tolerance: float = 0.02) -> Bool:
    """(Q,) True where a point (Q, 3) [m] is on a surface that one of the frames measured.

    The point falls on a pixel of the frame (the nearest), and that pixel has a depth within `tolerance` [m] of the
    point's own depth: neither hidden behind something else, nor in the free space before it.
    """
    seen = np.zeros(len(points_world), dtype=np.bool_)
    for frame in frames:
        unseen = np.flatnonzero(~seen)
        if not len(unseen):
            break
        seen[unseen] = _agrees(points_world[unseen], frame, tolerance)
    return seen


def surface_points(frame: RgbdFrame) -> tuple[Float64, Bool]:
    """The world points (Q, 3) [m] of a frame's pixels that have a depth, and where those pixels are (H, W)."""
    valid = frame.depth > 0
    return transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[valid]), valid


def seen_pixels(frame: RgbdFrame, others: Sequence[RgbdFrame], tolerance: float = 0.02) -> Bool:
    """(H, W) True where the frame's own depth lies on a surface that one of the `others` measured.

    The nearest cameras are asked first: they saw most of it, and what was seen is not asked again.
    """
    points_world, seen = surface_points(frame)
    center = frame.T_world_camera[:3, 3]
    nearest = sorted(others, key=lambda other: float(np.linalg.norm(other.T_world_camera[:3, 3] - center)))
    seen[seen] = seen_by(points_world, nearest, tolerance)
    return seen


def _agrees(points_world: NDArray[np.floating], frame: RgbdFrame, tolerance: float) -> Bool:
    points_camera = transform_points(invert_transform(frame.T_world_camera), points_world)
    agrees = points_camera[:, 2] > MIN_Z
    candidates = np.flatnonzero(agrees)
    pixels = np.floor(project(frame.intrinsics, points_camera[candidates]) + 0.5)
    height, width = frame.depth.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    agrees[candidates[~inside]] = False
    candidates = candidates[inside]
    u, v = pixels[inside].astype(np.int64).T
    depth = frame.depth[v, u]
    agrees[candidates] = (depth > 0) & (np.abs(depth - points_camera[candidates, 2]) <= tolerance)
    return agrees

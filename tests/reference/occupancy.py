"""What a depth image says about voxels, ray by ray (III-C): every pixel's ray walked from voxel to voxel."""

import numpy as np

from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Bool, Float64, RgbdFrame


def ray_walk(frame: RgbdFrame, origin: Float64, voxel: float, shape: tuple[int, int, int]) -> tuple[Bool, Bool]:
    """Voxels (X, Y, Z) that some ray passes on its way to its point, and voxels that hold a point.

    A ray is cut where it crosses a plane between voxels; the middle of each piece lies in one voxel.
    """
    passed, hit = np.zeros(shape, bool), np.zeros(shape, bool)
    eye = (frame.T_world_camera[:3, 3] - origin) / voxel + 0.5  # voxel i spans [i, i + 1)
    points = transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth.astype(np.float64)))
    for point in (points[frame.depth > 0] - origin) / voxel + 0.5:
        cuts = [np.array([0.0, 1.0])]
        for axis in range(3):
            low, high = sorted((eye[axis], point[axis]))
            planes = np.arange(np.ceil(low), np.floor(high) + 1)
            if high > low:
                cuts.append((planes - eye[axis]) / (point[axis] - eye[axis]))
        share = np.unique(np.clip(np.concatenate(cuts), 0.0, 1.0))
        middle = eye + (0.5 * (share[1:] + share[:-1]))[:, None] * (point - eye)
        end = _inside(np.floor(point)[None], shape)
        cells = _inside(np.floor(middle), shape)
        passed[tuple(cells[np.any(cells != np.floor(point), axis=1)].T)] = True
        hit[tuple(end.T)] = True
    return passed & ~hit, hit


def _inside(cells: Float64, shape: tuple[int, int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    return cells[np.all((cells >= 0) & (cells < shape), axis=1)].astype(np.int64)

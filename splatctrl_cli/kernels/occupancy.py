"""The voxel kernels of the compiled module: depth integration and entity marks, in place on the grid's arrays."""

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import native

Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


def pack_grid(origin: Float64, voxel: float, shape: tuple[int, ...]) -> Float64:
    """A grid as the kernels take it: (7,) float64."""
    return np.concatenate([origin, [voxel], shape]).astype(np.float64)


def integrate_depth(
    grid: Float64,
    log_odds: NDArray[np.float32],
    num_updates: NDArray[np.uint16],
    marks: UInt8,
    intrinsics: Float64,
    T_world_camera: Float64,
    depth: NDArray[np.float32],
    *,
    hit: float,
    miss: float,
    limit: float,
    max_range: float,
    stride: int,
    num_threads: int,
) -> None:
    """Add one depth image (H, W) [m] to log_odds and num_updates (X, Y, Z); marks (2, X, Y, Z) is zeroed scratch.

    intrinsics (6,): fx, fy, cx, cy, width, height.
    """
    native.integrate_depth(
        grid, log_odds, num_updates, marks, intrinsics, T_world_camera, depth, hit, miss, limit, max_range, stride,
        num_threads,
    )  # fmt: skip


def mark_spheres(grid: Float64, entity: UInt8, centers: Float64, radii: Float64, bit: int, num_threads: int) -> None:
    """OR `bit` into the voxels of entity (X, Y, Z) that meet a sphere; centers (S, 3) [m], radii (S,) [m]."""
    native.mark_spheres(grid, entity, centers, radii, bit, num_threads)

"""Voxel kernels, in place on a grid's arrays."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.kernels import Float32, Float64, UInt8, UInt16, native


@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """A depth image: intrinsics (6,) fx, fy, cx, cy, width, height; T_world_camera (4, 4); depth (H, W) [m].

    Below min_range depth does not count; beyond max_range it is no hit.
    """

    intrinsics: Float64
    T_world_camera: Float64
    depth: Float32
    min_range: float
    max_range: float


def pack_grid(origin: Float64, voxel: float, shape: tuple[int, ...]) -> Float64:
    """Grid (7,) as the kernels take it."""
    return np.concatenate([origin, [voxel], shape]).astype(np.float64)


def integrate_depth(
    grid: Float64,
    log_odds: Float32,
    num_updates: UInt16,
    last_seen: UInt16,
    hits: UInt8,
    image: DepthImage,
    *,
    hit: float,
    miss: float,
    limit: float,
    step: int,
    num_threads: int,
) -> None:
    """Add a depth image to log_odds and num_updates (X, Y, Z); changed voxels get last_seen `step`.

    A voxel with a pixel's point is a hit, else a miss if its centre is before its pixel's depth. A pixel without
    depth takes the nearest one's, while their rays are within half a voxel. Depth beyond max_range frees nearer
    voxels. hits: scratch, zero before and after.
    """
    native.integrate_depth(
        grid, log_odds, num_updates, last_seen, hits, image.intrinsics, image.T_world_camera, image.depth,
        image.min_range, image.max_range, hit, miss, limit, step, num_threads,
    )  # fmt: skip


def label_hits(
    grid: Float64,
    entity: UInt8,
    image: DepthImage,
    chosen: UInt8,
    *,
    set_bits: int = 0,
    clear_bits: int = 0,
    num_threads: int,
) -> None:
    """Set or clear bits of entity (X, Y, Z) at points of chosen (H, W) pixels."""
    native.label_hits(
        grid, entity, image.intrinsics, image.T_world_camera, image.depth, chosen, image.min_range, image.max_range,
        set_bits, clear_bits, num_threads,
    )  # fmt: skip


def mark_spheres(grid: Float64, entity: UInt8, centers: Float64, radii: Float64, bits: int, num_threads: int) -> None:
    """OR bits into voxels of entity (X, Y, Z) that spheres (S, 3), (S,) [m] meet."""
    native.mark_spheres(grid, entity, centers, radii, bits, num_threads)

"""What is asked of many points at once, in NumPy; `kernels.points` gives the same bytes."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.geometry import back_project, invert_transform, project, transform_points
from splatctrl_cli.kernels.surface_image import BALL, BOX, CAPSULE
from splatctrl_cli.records import Bool, Box, Float32, Float64, Index, RgbdFrame


def world_points(frame: RgbdFrame) -> Float64:
    """(H, W, 3) [m]."""
    return transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))


def pixels_at(frame: RgbdFrame, points: Float32) -> tuple[Index, Float64]:
    """Flat pixel indices (N,), -1 outside, and depths (N,) [m] of points (N, 3) [m], world."""
    k, local = frame.intrinsics, transform_points(invert_transform(frame.T_world_camera), points)
    is_ahead = local[:, 2] > 0
    pixels = np.floor(project(k, np.where(is_ahead[:, None], local, 1.0)) + 0.5)
    is_inside = is_ahead & np.all((pixels >= 0) & (pixels < [k.width, k.height]), axis=1)
    u, v = np.where(is_inside[:, None], pixels, 0).astype(np.int64).T
    return np.where(is_inside, v * k.width + u, -1), local[:, 2]


def seen_through(points: Float32, frame: RgbdFrame, nearest: Float32, tolerance: float) -> Bool:
    """Points (N, 3) nearer than nearest (H, W) at their pixel by more than the tolerance [m]."""
    pixel, z = pixels_at(frame, points)
    measured = nearest.reshape(-1)[pixel]
    return np.asarray((pixel >= 0) & np.isfinite(measured) & (z < measured - np.float32(tolerance)))


def are_inside(frame: RgbdFrame, box: Box, min_range: float) -> Bool:
    """Pixels (H, W) in a box with depth of at least `min_range` [m]."""
    return (frame.depth > 0) & (frame.depth >= min_range) & box.contains(world_points(frame))


def cube_means(points: Float32, colors: Float32, edge: float) -> dict[str, Float64]:
    """Of the K occupied cubes, in the order of their places: as `CubeMeans`, with the cube of each point."""
    places = np.floor(points.astype(np.float64) / edge).astype(np.int64)
    cube = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(cube).astype(np.float64)

    def mean(columns: list[Float64]) -> Float64:
        return np.stack([np.bincount(cube, weights=column) / count for column in columns], 1)

    center, shades = mean(list(points.T)), [column.astype(np.float64) for column in colors.T]
    offset = [column - middle[cube] for column, middle in zip(points.T, center.T, strict=True)]
    squared = offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2
    by_distance = np.lexsort((np.arange(len(points)), squared, cube))
    return {
        "count": count,
        "center": center,
        "color": mean(list(colors.T)),
        "square": mean([shade**2 for shade in shades]),
        "covariance": mean([a * b for a, b in combinations_with_replacement(offset, 2)]),
        "nearest": by_distance[np.searchsorted(cube[by_distance], np.arange(len(count)))],
        "of_point": cube,
    }


def are_further(centers: Float32, radii: Float32, points: Float64, gap: float) -> Bool:
    """Points (K, 3) further than `gap` [m] from each of the eight balls with the nearest centres."""
    distance, nearest = cKDTree(centers).query(points, k=np.arange(1, min(8, len(radii)) + 1))
    return np.asarray((distance - radii[nearest]).min(axis=1) > gap)


def solid_distance(kind: float, size: Float64, points: Float64) -> Float64:
    """Signed distance (N,) [m] of points (N, 3) in the solid's own frame."""
    if kind == BALL:
        return np.asarray(np.linalg.norm(points, axis=1) - size[0])
    if kind == BOX:
        beyond = np.abs(points) - size
    else:
        across, along = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2]) - size[1]
        if kind == CAPSULE:
            return np.asarray(np.hypot(across, np.maximum(along, 0.0)) - size[0])
        beyond = np.stack([across - size[0], along], axis=1)
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))


def outvoted(
    frames: Sequence[RgbdFrame],
    robots: Sequence[Bool],
    objects: Sequence[Bool],
    origin: Float64,
    voxel: float,
    share: float,
) -> list[Bool]:
    """Object pixels (H, W) in voxels where all frames count fewer of them than `share` times the robot's pixels."""
    cells = [np.floor((world_points(frame) - origin) / voxel + 0.5) for frame in frames]
    votes: dict[tuple[float, ...], list[int]] = defaultdict(lambda: [0, 0])
    for number, of_kind in enumerate((robots, objects)):
        for each, pixels in zip(cells, of_kind, strict=True):
            for cell in each[pixels]:
                votes[tuple(cell)][number] += 1
    few = {cell for cell, (num_robot, num_object) in votes.items() if num_object < share * num_robot}
    return [
        pixels & np.array([[tuple(cell) in few for cell in row] for row in each])
        for each, pixels in zip(cells, objects, strict=True)
    ]

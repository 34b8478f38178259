"""Depth images for comparison: surfaces, normals, and points projected on them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import back_project, project, strided_lens, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, Intrinsics, RgbdFrame

SMOOTH = 0.1  # of the depth, that a pixel and its four neighbours may differ by: beyond it they are no surface


@dataclass(frozen=True, kw_only=True)
class DepthView:
    """One depth image, in its camera's optical frame [m].

    surface, normals (h, w, 3): per pixel; normals point to the camera, 0 if unknown. points, point_normals (K, 3): a
    subset with normals. T_world_camera (4, 4): as recorded.
    """

    camera: str
    stamp_ns: int
    lens: Intrinsics
    T_world_camera: Float64
    surface: Float64
    normals: Float64
    points: Float64
    point_normals: Float64

    @classmethod
    def of(cls, frame: RgbdFrame, num_points: int, step: int = 1) -> "DepthView":
        surface = back_project(frame.intrinsics, frame.depth)
        normals = surface_normals(surface, step)
        normals[bend(frame.depth, step) > fixed.CALIBRATION_CREASE * depth_sigma(frame.depth)] = 0.0
        known = np.flatnonzero(np.any(normals != 0, axis=-1))
        spread = np.linspace(0, len(known) - 1, min(num_points // 2, len(known))).astype(np.int64)
        chosen = known[np.union1d(spread, _balance_directions(normals.reshape(-1, 3)[known], num_points // 2))]
        return cls(
            camera=frame.camera,
            stamp_ns=frame.stamp_ns,
            lens=frame.intrinsics,
            T_world_camera=frame.T_world_camera,
            surface=surface,
            normals=normals,
            points=surface.reshape(-1, 3)[chosen],
            point_normals=normals.reshape(-1, 3)[chosen],
        )


def _balance_directions(normals: Float64, most: int) -> Index:
    """Sorted indices of at most `most` normals (N, 3), balanced over directions.

    Normal-space sampling after Rusinkiewicz and Levoy, Efficient variants of the ICP algorithm (2001).
    """
    side = np.argmax(np.abs(normals), axis=1)
    largest = np.take_along_axis(normals, side[:, None], axis=1)[:, 0]
    cells = np.clip(np.floor(normals * 1.5 + 1.5), 0, 2).astype(np.int64) @ [1, 3, 9]
    bins = (2 * side + (largest > 0)) * 27 + cells
    order = np.argsort(bins, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(bins[order])) + 1) if len(order) else []
    chosen: list[Index] = []
    for left, part in enumerate(sorted(parts, key=len)):
        quota = (most - sum(map(len, chosen))) // (len(parts) - left)
        chosen.append(part[np.linspace(0, len(part) - 1, min(quota, len(part))).astype(np.int64)])
    return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.int64)


def strided(frame: RgbdFrame, rows: int) -> RgbdFrame:
    """Every n-th pixel, for about `rows` rows; without colour."""
    stride = max(1, frame.depth.shape[0] // rows)
    depth = np.ascontiguousarray(frame.depth[::stride, ::stride])
    return replace(
        frame,
        depth=depth,
        color=np.zeros((*depth.shape, 3), np.uint8),
        intrinsics=strided_lens(frame.intrinsics, stride),
        human=None if frame.human is None else frame.human[::stride, ::stride],
        valid=None,
    )


def surface_normals(surface: Float64, step: int = 1) -> Float64:
    """Unit normals (h, w, 3) towards the camera of a surface (h, w, 3).

    Computed from points `step` pixels to either side; 0 along depth edges and without depth.
    """
    normals = np.zeros_like(surface)
    middle, low, high = slice(step, -step), slice(None, -2 * step), slice(2 * step, None)
    around = np.stack(
        [surface[rows, columns] for rows, columns in
         ((middle, middle), (middle, low), (middle, high), (low, middle), (high, middle))]
    )  # fmt: skip
    cross = np.cross(around[4] - around[3], around[2] - around[1])
    length, z = np.linalg.norm(cross, axis=-1), around[..., 2]
    is_known = (z > 0).all(axis=0) & (np.ptp(z, axis=0) < SMOOTH * z[0]) & (length > 0)
    normals[middle, middle][is_known] = cross[is_known] / length[is_known][:, None]
    return normals


def bend(depth: Float32, step: int = 1) -> Float64:
    """Largest deviation (h, w) [m] of depth from the mean of pixels `step` to either side."""
    bent = np.zeros(depth.shape)
    middle, low, high = slice(step, -step), slice(None, -2 * step), slice(2 * step, None)
    z = depth.astype(np.float64)
    bent[middle, middle] = np.maximum(
        np.abs(z[middle, low] + z[middle, high] - 2 * z[middle, middle]),
        np.abs(z[low, middle] + z[high, middle] - 2 * z[middle, middle]),
    )
    return np.asarray(0.5 * bent)


def landed(points: Float64, view: DepthView) -> tuple[Bool, Float64, Float64]:
    """Return which points (K, 3), camera frame, land on depth, and the surface and normals there."""
    is_ahead = points[:, 2] > fixed.PLAUSIBLE_DEPTH[0]
    pixels = np.round(project(view.lens, np.where(is_ahead[:, None], points, 1.0)))
    lands = is_ahead & np.all((pixels >= 0) & (pixels < view.surface.shape[1::-1]), axis=1)
    u, v = np.where(lands[:, None], pixels, 0).astype(np.int64).T
    surface = view.surface[v, u]
    return lands & (surface[:, 2] > 0), surface, view.normals[v, u]


def derive_by_twists(own: Float64, projected: Float64, gradient: Float64, T: Float64) -> Float64:
    """Derivatives (K, 12) of a value at `projected` (K, 3) by two cameras' motions.

    own (K, 3): points in the first camera's frame, which T (4, 4) maps to the second's. gradient (K, 3): by
    `projected`. Motions are in each camera's frame. ``exp(x)`` moves a point p by ``x[:3] x p + x[3:]``, so ``g . T
    exp(x) p`` changes by ``(p x R^T g) . x[:3] + R^T g . x[3:]``. The second camera's sign is opposite.
    """
    along = gradient @ T[:3, :3]
    return np.hstack([_cross(own, along), along, _cross(gradient, projected), -gradient])


def _cross(a: Float64, b: Float64) -> Float64:
    """Cross products (K, 3), faster than `np.cross` for few points."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def overlap_rows(
    points: Float64, T: Float64, which: Bool, surface: Float64, normals: Float64
) -> tuple[Float64, Float64]:
    """Distances (M,) [m] of points from a view's surface planes, and derivatives (M, 12) by `derive_by_twists`.

    points (K, 3): in the other view's frame, which T (4, 4) maps to this one. which (K,): points that land.
    """
    projected, normal = transform_points(T, points[which]), normals[which]
    return np.einsum("ki,ki->k", projected - surface[which], normal), derive_by_twists(
        points[which], projected, normal, T
    )


def still_frame(frames: Sequence[RgbdFrame]) -> RgbdFrame:
    """A stationary camera's frame, with mean inverse depths near their median.

    Half of the frames must agree within three `depth_sigma`, else depth is 0.
    """
    if len(frames) == 1:
        return frames[0]
    depth = np.stack([frame.depth for frame in frames]).astype(np.float64)
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1.0), np.inf)
    num = (depth > 0).sum(axis=0)
    median = np.take_along_axis(np.sort(inverse, axis=0), np.maximum((num - 1) // 2, 0)[None], axis=0)[0]
    is_seen = num > 0
    middle = np.where(is_seen, median, 1.0)
    near = np.abs(inverse - middle) < 3 * depth_sigma(1 / middle) * np.square(middle)
    count = near.sum(axis=0)
    mean = np.where(near, inverse, 0.0).sum(axis=0) / np.maximum(count, 1)
    holds = is_seen & (2 * count >= len(frames)) & (mean > 0)
    return replace(
        frames[len(frames) // 2], depth=np.where(holds, 1 / np.where(holds, mean, 1.0), 0.0).astype(np.float32)
    )


def depth_sigma(depth: NDArray[np.floating]) -> Float64:
    """Assumed sigma [m] of depths (...) [m]: constant plus quadratic."""
    return np.asarray(fixed.CALIBRATION_NOISE[0] + fixed.CALIBRATION_NOISE[1] * np.square(depth), np.float64)


def tiles_of(pixels: Index, shape: tuple[int, ...]) -> Index:
    """Tile (K,) of each pixel, among `CALIBRATION_TILES` rows and columns."""
    rows, columns = fixed.CALIBRATION_TILES
    v, u = np.divmod(pixels, shape[1])
    return np.asarray((v * rows // shape[0]) * columns + u * columns // shape[1], dtype=np.int64)

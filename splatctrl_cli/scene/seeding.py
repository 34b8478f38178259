"""Where new splats come from: the first frames, and pixels that the map does not explain (M_add, eq. 5)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.geometry import back_project, transform_points
from splatctrl_cli.records import Bool, Box, Float32, Float64, RgbdFrame
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.render import Rendering

RADIUS_PER_SPACING = 0.6  # between the 1/2 that leaves holes and the 1/sqrt(2) of a water-tight zero level, measured

CROWDED = 0.7  # of the spacing: nearer than this to a live splat nothing is seeded


def world_points(frame: RgbdFrame) -> Float64:
    """Back-projected points (H, W, 3) [m], world; meaningless where the depth is 0."""
    return transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth))


def inside_workspace(frame: RgbdFrame, points_world: Float64, workspace: Box) -> Bool:
    """Pixels (H, W) with a valid depth in the workspace."""
    return np.asarray((frame.depth > 0) & workspace.contains(points_world))


def add_mask(frame: RgbdFrame, rendering: Rendering, mappable: Bool, config: SceneConfig) -> Bool:
    """M_add (H, W): pixels to seed, eq. 5 with the hole term.

    A mappable pixel is a hole (accumulated opacity below one half), or its depth is closer than the map's by more
    than lambda_MDE times the median depth error. The median is over mappable pixels that the map explains, with a
    floor and a ceiling; the map's depth is normalised by its opacity.
    """
    is_hole = rendering.opacity < config.hole_opacity
    error = rendering.normalised_depth() - frame.depth
    explained = mappable & ~is_hole
    median = float(np.median(np.abs(error[explained]))) if explained.any() else 0.0
    threshold = min(max(config.lambda_mde * median, config.min_depth_error), config.max_depth_error)
    return np.asarray(mappable & (is_hole | (error > threshold)))


def candidates(frame: RgbdFrame, points_world: Float64, mask: Bool) -> tuple[Float32, Float32, Float32]:
    """Points (K, 3) [m] world, colours (K, 3) in [0, 1] and pixel sizes D/f (K,) [m] of a mask (H, W)."""
    focal = 0.5 * (frame.intrinsics.fx + frame.intrinsics.fy)
    colors = frame.color[mask].astype(np.float32) / 255.0
    return points_world[mask].astype(np.float32), colors, (frame.depth[mask] / focal).astype(np.float32)


def thin(points: Float32, spacing: float, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of one point of (K, 3) per cube of edge `spacing`, chosen at random, in random order."""
    order = rng.permutation(len(points))
    cubes = np.floor(points[order] / np.float32(spacing)).astype(np.int64)
    keys = (cubes[:, 0] * 2_097_152 + cubes[:, 1]) * 2_097_152 + cubes[:, 2]
    first = np.unique(keys, return_index=True)[1]
    return order[np.sort(first)]


def spacing_for(points: Float32, count: int, rng: np.random.Generator) -> float:
    """The smallest cube edge [m] (to 1 %) at which thinning leaves at most `count` points."""
    low, high = 1e-4, 1.0
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if len(thin(points, middle, rng)) <= count else (middle, high)
    return high


def seeds_at(
    sources: Sequence[tuple[Float32, Float32, Float32]],
    live_centers: Float32,
    spacing: float,
    config: SceneConfig,
    rng: np.random.Generator,
) -> Seeds:
    """One seed per cube of edge `spacing` [m] over the candidates of several views, in random order.

    None within 0.7 spacings of a live splat (L, 3): silhouettes, where the blended depth is neither surface's, would
    otherwise ask for new splats for ever.

    The paper's radius min(D/f, r_max) is one pixel; a budget far below the number of pixels needs the radius of its
    spacing instead, so r = min(max(0.6 spacing, D/f), r_max).
    """
    points, colors, pixels = (np.concatenate(parts) for parts in zip(*sources, strict=True))
    chosen = thin(points, spacing, rng)
    if len(live_centers):
        distance = cKDTree(live_centers).query(points[chosen], distance_upper_bound=CROWDED * spacing)[0]
        chosen = chosen[~np.isfinite(distance)]
    radii = np.clip(np.maximum(RADIUS_PER_SPACING * spacing, pixels[chosen]), config.min_radius, config.max_radius)
    return Seeds(centers=points[chosen], radii=radii.astype(np.float32), colors=colors[chosen])

"""Seeds of new splats, from first frames and unexplained pixels (M_add, eq. 5).

The paper seeds every pixel. Here nested cubes get one splat each. A cube splits while its points differ in colour or
lie off a plane.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.kernels import native
from splatctrl_cli.kernels.points import CubeMeans, Cubes, SplatTree, are_inside, back_projected
from splatctrl_cli.kernels.raster import pack_camera
from splatctrl_cli.records import Bool, Box, Float32, Float64, Integers, RgbdFrame, SplatSet
from splatctrl_cli.scene.buffer import Seeds
from splatctrl_cli.scene.render import Rendering

Each = Callable[..., Iterable[Any]]  # `map`, or a parallel one

NO_SEEDS = Seeds(
    centers=np.zeros((0, 3), np.float32), radii=np.zeros(0, np.float32), colors=np.zeros((0, 3), np.float32)
)


def camera_in_world(frame: RgbdFrame) -> Float64:
    """Camera (18,) as `back_projected` takes it."""
    k = frame.intrinsics
    return pack_camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height, frame.T_world_camera)


def world_points(frame: RgbdFrame, mask: Bool | None = None, num_threads: int = 1) -> Float64:
    """Back-projected points [m], world: (K, 3) of a mask (H, W), else (H, W, 3).

    Points with depth 0 are meaningless.
    """
    points = back_projected(camera_in_world(frame), frame.depth, mask, num_threads)
    return points.reshape(*frame.depth.shape, 3) if mask is None else points


def inside_workspace(frame: RgbdFrame, workspace: Box, min_range: float = 0.0, num_threads: int = 1) -> Bool:
    """Pixels (H, W) in the workspace with valid depth of at least `min_range` [m]."""
    return are_inside(camera_in_world(frame), frame.depth, workspace.lower, workspace.upper, min_range, num_threads)


def add_mask(frame: RgbdFrame, rendering: Rendering, mappable: Bool, config: SceneConfig) -> Bool:
    """M_add (H, W): pixels to seed, eq. 5 with a term for holes.

    Holes are mappable pixels with opacity below `hole_opacity`. Other pixels are seeded if closer than the map by
    more than lambda_MDE times the median depth error. The median is over mappable pixels outside holes; the threshold
    is bounded. The map's depth is normalised by opacity.
    """
    images = (rendering.depth, rendering.opacity, frame.depth)
    error, sizes = np.empty(frame.depth.shape, np.float32), np.empty(frame.depth.size, np.float32)
    num = native.depth_errors(
        *(np.ascontiguousarray(image, np.float32) for image in images), np.ascontiguousarray(mappable).view(np.uint8),
        config.hole_opacity, fixed.OPAQUE_ENOUGH, error, sizes,
    )  # fmt: skip
    median = float(np.median(sizes[:num], overwrite_input=True)) if num else 0.0
    threshold = min(max(config.lambda_mde * median, config.min_depth_error), config.max_depth_error)
    return np.asarray(error > threshold)


def thinning(masks: Iterable[Bool]) -> int:
    """Step n that leaves at most about `SEED_MOST_PIXELS` of masks (H, W)."""
    return max(1, math.ceil(sum(int(mask.sum()) for mask in masks) / fixed.SEED_MOST_PIXELS))


def thin_mask(mask: Bool, every: int) -> Bool:
    """Keep the first of each `every` pixels of a mask (H, W), in row order."""
    if every == 1:
        return mask
    thinned = np.zeros(mask.size, bool)
    thinned[np.flatnonzero(mask)[::every]] = True
    return thinned.reshape(mask.shape)


def candidates(frame: RgbdFrame, mask: Bool, num_threads: int = 1) -> Seeds:
    """Candidates in a mask (H, W)."""
    focal, pixels = 0.5 * (frame.intrinsics.fx + frame.intrinsics.fy), np.flatnonzero(mask)
    if not len(pixels):
        return NO_SEEDS
    return Seeds(
        centers=world_points(frame, mask, num_threads).astype(np.float32),
        radii=(frame.depth.reshape(-1)[pixels] / focal).astype(np.float32),
        colors=frame.color.reshape(-1, 3)[pixels].astype(np.float32) / 255.0,
    )


@dataclass(frozen=True, kw_only=True)
class CubeLevel:
    """Occupied cubes of one size: points (K, 3) [m], means, and parent cube (K,) one level up.

    A cube's point is the measured point nearest to the mean.
    """

    edge: float
    points: Float32
    means: CubeMeans
    parent: Integers

    @cached_property
    def detail(self) -> Float64:
        """Detail (K,): number of points times (colour variance + SEED_BEND * least position variance / edge^2)."""
        means = self.means
        color_variance = (means.square - means.color**2).sum(axis=1)
        covariance = means.covariance[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        thickness = np.maximum(np.linalg.eigvalsh(covariance)[:, 0], 0.0)
        unexplained = np.maximum(color_variance, 0.0) + fixed.SEED_BEND * thickness / self.edge**2
        return np.asarray(means.count * unexplained)


def cube_levels(
    points: Float32, colors: Float32, edge: float, num_levels: int, num_threads: int = 1
) -> list[CubeLevel]:
    """Cubes of edges `edge`, `edge` / 2, … [m] over points (K, 3) with colours (K, 3)."""
    levels: list[CubeLevel] = []
    above = np.zeros(len(points), np.int32)
    for level in range(num_levels):
        size = edge / 2**level
        cubes = Cubes(points, size, num_threads)
        of_point, first = cubes.members()
        means = cubes.means(colors)
        levels.append(CubeLevel(edge=size, points=points[means.nearest], means=means, parent=above[first]))
        above = of_point
    return levels


def leaves(levels: Sequence[CubeLevel], tolerance: float) -> list[Bool]:
    """Masks (K,) per level of unsplit cubes; a cube splits while its detail exceeds `tolerance`."""
    masks, is_reached = [], np.ones(len(levels[0].points), bool)
    for level, below in pairwise(levels):
        is_split = is_reached & (level.detail > tolerance)
        masks.append(is_reached & ~is_split)
        is_reached = is_split[below.parent]
    return [*masks, is_reached]


def tolerance_for(levels: Sequence[CubeLevel], count: int) -> float:
    """Least tolerance (to 1 %) for at most `count` cubes; infinite if the coarsest cubes are more."""
    if len(levels[0].points) > count:
        return float("inf")
    low, high = 1e-6, float(max(level.detail.max() for level in levels)) + 1e-6
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        fits = sum(int(mask.sum()) for mask in leaves(levels, middle)) <= count
        low, high = (low, middle) if fits else (middle, high)
    return high


@dataclass(frozen=True, kw_only=True)
class SeedDensity:
    """Density of seeds: coarsest edge [m], splitting detail, and number of candidates."""

    edge: float
    tolerance: float
    num_candidates: int = 0


def density_for(sources: Sequence[Seeds], count: int, config: SceneConfig, num_threads: int = 1) -> SeedDensity:
    """Density that spends at most `count` seeds on the candidates.

    The edge starts at the largest splats, and grows by 5 % while there are more than `count` cubes.
    """
    everything = sources[0].joined(*sources[1:])
    points = everything.centers
    extent = float(np.max(np.ptp(points, axis=0))) if len(points) else 0.0
    edge = config.max_radius / config.radius_per_edge
    while edge < extent and len(Cubes(points, edge, num_threads)) > count:
        edge *= 1.05
    tolerance = tolerance_for(cube_levels(points, everything.colors, edge, fixed.SEED_LEVELS, num_threads), count)
    return SeedDensity(edge=edge, tolerance=tolerance, num_candidates=len(points))


def seeds_at(
    sources: Sequence[Seeds],
    live_centers: Float32,
    density: SeedDensity,
    config: SceneConfig,
    num_threads: int = 1,
) -> Seeds:
    """One seed per unsplit cube over the candidates, finest cubes first.

    No seed is within 0.7 edges of a live splat (L, 3). The paper's radius is min(D/f, r_max); here it is
    min(max(radius_per_edge * edge, D/f), r_max).
    """
    cloud = sources[0].joined(*sources[1:])
    levels = cube_levels(cloud.centers, cloud.colors, density.edge, fixed.SEED_LEVELS, num_threads)
    pixel, chosen = float(np.median(cloud.radii)), leaves(levels, density.tolerance)
    parts = [_seeds_of(level, mask, pixel, live_centers, config) for level, mask in zip(levels, chosen, strict=True)]
    return parts[-1].joined(*parts[-2::-1])


def gap_seeds(
    views: Sequence[tuple[RgbdFrame, Bool]],
    occupied: Float32,
    voxel: float,
    splats: SplatSet,
    config: SceneConfig,
    *,
    half: int | None = None,
    stride: int | None = None,
    num_threads: int = 1,
    each: Each = map,
) -> Seeds:
    """Seeds where a measured surface is further than `max_gap` [m] from every sphere.

    Every `stride`-th pixel and row of the views is checked (default: about half of `max_gap` apart). Occupied centres
    (K, 3) may be half a voxel further. half: 0 or 1 checks only every second row. each: a `map` over views.
    """
    spheres = SplatTree(splats.centers, splats.radii, num_threads)

    def bare(frame: RgbdFrame, mappable: Bool) -> Seeds:
        step = _gap_stride(frame, config.max_gap) if stride is None else stride
        rows = np.arange(len(mappable))
        skipped = (rows % step != 0) | ((rows // step) % 2 == (2 if half is None else 1 - half))
        mask = np.zeros_like(mappable)
        mask[~skipped, ::step] = mappable[~skipped, ::step]
        mask[mask] = spheres.are_further(world_points(frame, mask, num_threads), config.max_gap)
        return candidates(frame, mask)

    sources = [source for source in each(lambda view: bare(*view), views) if len(source)]
    forgotten = occupied[spheres.are_further(occupied, config.max_gap + 0.5 * voxel)]
    if len(forgotten):
        grey = np.full((len(forgotten), 3), 0.5, np.float32)
        colors = splats.colors[cKDTree(splats.centers).query(forgotten)[1]] if len(splats) else grey
        sources.append(Seeds(centers=forgotten, radii=np.zeros(len(forgotten), np.float32), colors=colors))
    if not sources:
        return NO_SEEDS
    cloud = sources[0].joined(*sources[1:])
    level = cube_levels(cloud.centers, cloud.colors, config.max_radius / config.radius_per_edge, 1, num_threads)[0]
    pixel, no_splats = float(np.median(cloud.radii)), np.zeros((0, 3), np.float32)
    return _seeds_of(level, np.ones(len(level.points), bool), pixel, no_splats, config)


def _gap_stride(frame: RgbdFrame, max_gap: float) -> int:
    depth = frame.depth[::8, ::8]
    typical = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    return max(3, round(0.5 * max_gap * frame.intrinsics.fx / typical))


def _seeds_of(level: CubeLevel, mask: Bool, pixel: float, live_centers: Float32, config: SceneConfig) -> Seeds:
    centers, colors = level.points[mask].astype(np.float32), level.means.color[mask].astype(np.float32)
    if len(live_centers) and len(centers):
        reach = fixed.SEED_CROWDED * level.edge
        is_free = ~np.isfinite(cKDTree(live_centers).query(centers, distance_upper_bound=reach)[0])
        centers, colors = centers[is_free], colors[is_free]
    radius = np.clip(max(config.radius_per_edge * level.edge, pixel), config.min_radius, config.max_radius)
    return Seeds(centers=centers, radii=np.full(len(centers), radius, np.float32), colors=colors)

"""Removal of splats, by reason (III-C), eviction for bare surface, and use of idle slots."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.records import Bool, Box, Float32, Float64, Index, Label, RgbdFrame, SplatSet
from splatctrl_cli.scene.buffer import Filled, Seeds, SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.seeding import NO_SEEDS, candidates, thin_mask, thinning
from splatctrl_cli.scene.self_mask import least_within

REASONS = ("broken", "workspace", "opacity", "free", "seen_through", "uncertain", "trail", "robot", "weak", "evicted")


def nearest_depth(
    frame: RgbdFrame, reach: float = fixed.NEAREST_REACH, is_robot: Bool | None = None
) -> tuple[Float32, Float32]:
    """Least valid depth (H, W) [m] within `reach` [m] of each pixel, with and without the robot.

    inf: no depth. `reach` becomes pixels at the median depth. In the second image, robot pixels count only for
    themselves and neighbours.
    """
    is_valid = frame.depth > 0
    depth, valid = np.where(is_valid, frame.depth, np.float32(np.inf)), frame.depth[is_valid]
    if not len(valid):
        return depth, depth
    half = max(1, round(reach * frame.intrinsics.fx / float(np.median(valid))))
    nearest = least_within(depth, half)
    if is_robot is None or not is_robot.any():
        return nearest, nearest
    others = least_within(np.where(is_robot, np.float32(np.inf), depth), half)
    return nearest, np.minimum(others, least_within(depth, 1))


def removals(
    buffer: SplatBuffer,
    occupancy: OccupancyMap,
    workspace: Box,
    min_opacity: float,
    *,
    is_trail: Bool,
    is_floating: Bool,
    counts_time: bool = True,
) -> dict[str, Bool]:
    """Masks (M,) of live splats to remove, each under its first reason in `REASONS`.

    broken: not finite. workspace: outside. opacity: below alpha_min. free: all seen voxels around are free.
    seen_through: floats before measured depth. uncertain: occupancy 0.3 to 0.7 for longer than the patience. trail:
    no longer robot or human. Set elsewhere: robot, evicted, weak. Splats in never-seen space stay, unless the rule is
    "literal". counts_time: counts towards the patience.
    """
    config = occupancy.config
    centers = buffer.centers
    is_broken: Bool = ~np.all(np.isfinite(buffer.parameters), axis=1)
    value, is_observed = occupancy.occupancy_around(np.where(is_broken[:, None], np.float32(0), centers))
    is_known = is_observed | (config.rule == "literal")
    is_free = is_known & (value < config.free_below)
    is_uncertain = is_known & (value >= config.free_below) & (value < config.occupied_above)
    if counts_time:
        buffer.num_uncertain[:] = np.where(is_uncertain, buffer.num_uncertain + 1, 0)
    masks = {
        "broken": is_broken,
        "workspace": buffer.is_mapped & ~workspace.contains(centers),
        "opacity": buffer.opacities < min_opacity,
        "free": is_free,
        "seen_through": is_floating,
        "uncertain": is_uncertain & ((buffer.num_uncertain > config.uncertain_patience) | (config.rule == "literal")),
        "trail": is_trail,
        "robot": np.zeros(len(centers), bool),
        "weak": np.zeros(len(centers), bool),
        "evicted": np.zeros(len(centers), bool),
    }
    remaining = buffer.is_alive.copy()
    reasons = {}
    for reason in REASONS:
        reasons[reason] = masks[reason] & remaining
        remaining &= ~masks[reason]
    return reasons


def room_for(
    seeds: Seeds, num: int, buffer: SplatBuffer, occupancy: OccupancyMap, shown: Float64, tolerance: float
) -> tuple[Bool, Seeds]:
    """Mask (M,) of at most `num` splats to evict; the seeds, nearest to the path first.

    Only object splats go: redundant ones that show least, then ones far from the path. shown (M,): blended opacity by
    slot; tolerance [m]: of `find_redundant`.
    """
    splats, live = buffer.splats(occupancy.num_threads), np.flatnonzero(buffer.is_mapped)
    stands = splats.labels != Label.ROBOT
    others, may_go = live[stands], live[splats.labels == Label.OBJECT]
    weakest = may_go[np.argsort(shown[may_go], kind="stable")][: fixed.EVICT_ASKED * num]
    order, voxels = np.searchsorted(others, weakest), occupancy.centers_of(occupancy.occupied_voxels())
    chosen = others[find_redundant(order, num, splats.select(stands), voxels, tolerance, occupancy.num_threads)]
    is_evicted = np.zeros(len(shown), bool)
    is_evicted[chosen] = True
    path = occupancy.swept_box()
    if path is not None:
        seeds = seeds.select(np.argsort(distance_to_box(seeds.centers, path), kind="stable"))
        left, slots = num - len(chosen), may_go[~is_evicted[may_go]]
        waiting = seeds.centers[len(seeds) - left :]
        is_evicted[slots[find_far(left, waiting, buffer.centers[slots], path)]] = True
    return is_evicted, seeds


def find_redundant(
    order: Index,
    num_wanted: int,
    splats: SplatSet,
    voxels: Float32,
    tolerance: float,
    num_threads: int = 1,
) -> Index:
    """The first splats of `order`, at most `num_wanted`, that other splats can replace.

    splats: N of objects and people; voxels (K, 3) [m]: occupied centres. A splat represents voxels within `tolerance`
    [m] of its sphere, if among their eight nearest splats. It may go if other splats represent all its voxels.
    """
    if not len(order) or not len(voxels) or num_wanted < 1:
        return np.zeros(0, np.intp)
    reach = splats.radii[order] + tolerance
    of_splat = cKDTree(voxels).query_ball_point(splats.centers[order], reach, workers=num_threads)
    candidates = np.unique(np.concatenate([np.asarray(near, np.intp) for near in of_splat]))
    count = np.zeros(len(voxels), np.int64)
    distance, nearest = cKDTree(splats.centers).query(
        voxels[candidates], k=np.arange(1, min(fixed.EVICT_NEAREST, len(splats)) + 1), workers=num_threads
    )
    count[candidates] = (distance - splats.radii[nearest] <= tolerance).sum(axis=1)
    chosen: list[np.intp] = []
    for splat, near in zip(order, of_splat, strict=True):
        if len(chosen) == num_wanted:
            break
        if (count[near] > 1).all():
            count[near] -= 1
            chosen.append(splat)
    return np.array(chosen, np.intp)


def find_far(num_wanted: int, seeds: Float32, centers: Float32, path: Box) -> Index:
    """Choose at most `num_wanted` splats (N, 3) to evict for seeds (K, 3), farthest first.

    Each is at least EVICT_NEARER farther from the path than its seed.
    """
    to_splat = distance_to_box(centers, path)
    farthest = np.argsort(-to_splat, kind="stable")[:num_wanted]
    to_seed = np.sort(distance_to_box(seeds, path))[:num_wanted]
    pairs = min(len(farthest), len(to_seed))
    is_worth_it = to_splat[farthest[:pairs]] >= to_seed[:pairs] + fixed.EVICT_NEARER
    return farthest[:pairs][np.logical_and.accumulate(is_worth_it)]


def distance_to_box(points: Float32, box: Box) -> Float64:
    """Points (K, 3) [m] -> distance (K,) [m] to a box, 0 inside."""
    outside = np.maximum(np.maximum(box.lower - points, points - box.upper), 0.0)
    return np.asarray(np.linalg.norm(outside, axis=1), np.float64)


def clone_shape(opacity: Float64, radius: Float64, count: Index) -> tuple[Float64, Float64]:
    """Opacity (N,) and radius (N,) [m] of each of `count` (N,) coinciding copies.

    The copies conserve the peak: `a = 1 - (1 - alpha)^(1/N)`. They also conserve the blended opacity over the screen
    (2-D rule): `r' = r sqrt(alpha / sum_{i=1..N} (1 - (1 - a)^i) / i)`. The 1-D rule of 3DGS-MCMC (Kheradmand et al.
    2024, eq. 9) loses a few percent.
    """
    a = 1.0 - (1.0 - opacity) ** (1.0 / count)
    mass = np.zeros_like(opacity)
    for i in range(1, int(count.max(initial=1)) + 1):
        mass += np.where(i <= count, (1.0 - (1.0 - a) ** i) / i, 0.0)
    return a, radius * np.sqrt(np.divide(opacity, mass, out=np.ones_like(mass), where=mass > 0))


def clone_sources(opacities: Float64, num_clones: int, rng: np.random.Generator) -> Index:
    """Draw indices (num_clones,) in proportion to opacity, with replacement."""
    total = float(opacities.sum())
    if num_clones < 1 or total <= 0.0:
        return np.zeros(0, np.intp)
    return np.asarray(rng.choice(len(opacities), size=num_clones, p=opacities / total), np.intp)


def clone(buffer: SplatBuffer, num_clones: int, rng: np.random.Generator) -> Filled:
    opacities = np.where(buffer.is_alive, buffer.opacities, 0.0).astype(np.float64)
    sources = clone_sources(opacities, num_clones, rng)
    count = 1 + np.bincount(sources, minlength=len(opacities))
    return Filled(relocated=buffer.copy(sources, *clone_shape(opacities, buffer.radii.astype(np.float64), count)))


Misfit = tuple[RgbdFrame, Float32]
"""A view's frame, and its mean absolute colour error (H, W), 0 where not mappable."""


def use_idle(
    buffer: SplatBuffer,
    misfits: Callable[[], tuple[list[Misfit], Float64]],
    config: SceneConfig,
    rng: np.random.Generator,
) -> tuple[Filled, int]:
    """Fill dead slots beyond the reserve by `when_idle`; count weak splats removed.

    misfits: returns each view's misfit, and each slot's blended opacity (M,).
    """
    is_alive, reserve = buffer.is_alive, int(config.gap_reserve * config.max_splats)
    if config.when_idle == "leave" or not is_alive.any():
        return Filled(), 0
    misfit_views, shown = ([], None) if config.when_idle == "clone" else misfits()
    if shown is None or not any(error.any() for _, error in misfit_views):  # no depth shows where detail is missing
        return clone(buffer, int((~is_alive).sum()) - reserve, rng), 0
    weakest = np.argsort(np.where(is_alive, shown, np.inf), kind="stable")
    is_weak = np.zeros(len(is_alive), bool)
    is_weak[weakest[: int(config.weak_share * is_alive.sum())]] = True
    num_weak = buffer.kill(is_weak)
    seeds = detail_seeds(misfit_views, int((~is_alive).sum()) - reserve, config, rng)
    return buffer.fill(seeds, config.initial_opacity), num_weak


def detail_seeds(misfits: Sequence[Misfit], num_seeds: int, config: SceneConfig, rng: np.random.Generator) -> Seeds:
    """Place at most `num_seeds` pixel-sized seeds on measured surfaces, drawn by squared colour error.

    The error is a 3 x 3 mean; its square is weighted by a pixel's area on the surface. Seeds are at least a diameter
    apart.
    """
    every = thinning(error > 0 for _, error in misfits)
    masks = [thin_mask(error > 0, every) for _, error in misfits]
    weight = np.concatenate(
        [
            np.square(uniform_filter(error, 3)[mask] * frame.depth[mask], dtype=np.float64)
            for (frame, error), mask in zip(misfits, masks, strict=True)
        ]
    )
    count = min(fixed.SEED_OVERSAMPLING * num_seeds, int(np.count_nonzero(weight)))
    if count == 0:
        return NO_SEEDS
    seeds = _pixels([frame for frame, _ in misfits], masks, draw_indices(weight, count, rng))
    apart = _apart(seeds.centers, 2.0 * seeds.radii)[:num_seeds]
    return replace(seeds.select(apart), radii=np.clip(seeds.radii[apart], config.min_radius, config.max_radius))


def draw_indices(weight: Float64, count: int, rng: np.random.Generator) -> Index:
    """Draw `count` different indices in proportion to weight (K,).

    At least `count` weights must be positive. It draws like ``rng.choice(K, count, replace=False, p=weight /
    weight.sum())``, but faster.
    """
    left = weight / weight.sum()
    indices = np.zeros(0, np.intp)
    while len(indices) < count:
        left[indices] = 0.0
        reached = np.cumsum(left)
        reached /= reached[-1]
        more = reached.searchsorted(rng.random(count - len(indices)), side="right")
        _, first = np.unique(more, return_index=True)
        indices = np.concatenate([indices, more[np.sort(first)]])
    return indices


def _pixels(frames: Sequence[RgbdFrame], masks: Sequence[Bool], chosen: Index) -> Seeds:
    order = np.argsort(chosen, kind="stable")
    parts, first = [], 0
    for frame, mask in zip(frames, masks, strict=True):
        pixels = np.flatnonzero(mask)
        begin, end = np.searchsorted(chosen[order], [first, first + len(pixels)])
        only = np.zeros(mask.shape, bool)
        only.reshape(-1)[pixels[chosen[order[begin:end]] - first]] = True
        parts.append(candidates(frame, only))
        first += len(pixels)
    return parts[0].joined(*parts[1:]).select(np.argsort(order))


def _apart(points: Float32, distances: Float32) -> Index:
    is_taken = np.zeros(len(points), bool)
    neighbours = cKDTree(points).query_ball_point(points, distances)
    indices = []
    for index, near in enumerate(neighbours):
        if not is_taken[index]:
            indices.append(index)
            is_taken[near] = True
    return np.array(indices, np.intp)

"""Removal of splats, by reason (III-C), and eviction for observed surface without splats."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.records import Bool, Box, Float32, Float64, Label, RgbdFrame, SplatSet
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap

REASONS = ("broken", "workspace", "opacity", "free", "seen_through", "uncertain", "trail", "robot", "weak", "evicted")


def nearest_depth(frame: RgbdFrame, reach: float = fixed.NEAREST_REACH, is_robot: Bool | None = None) -> Float32:
    """Least valid depth (H, W) [m] within `reach` [m] of each pixel; inf without any.

    `reach` is at the median depth. Robot pixels count only for themselves and neighbours: near the robot, what is
    before all else floats.
    """
    depth = np.where(frame.depth > 0, frame.depth, np.float32(np.inf))
    valid = frame.depth[frame.depth > 0]
    if not len(valid):
        return depth
    half = max(1, round(reach * frame.intrinsics.fx / float(np.median(valid))))
    if is_robot is None or not is_robot.any():
        return least_around(depth, half)
    return np.minimum(least_around(np.where(is_robot, np.float32(np.inf), depth), half), least_around(depth, 1))


def least_around(depth: Float32, half: int) -> Float32:
    """Least value (H, W) in the square of 2 half + 1 pixels around each."""
    window = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    return np.asarray(cv2.erode(depth, window, borderType=cv2.BORDER_REPLICATE), np.float32)


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

    broken: not finite. workspace: outside. opacity: below alpha_min. free: all voxels around observed free.
    seen_through: floats before measured depth. uncertain: occupancy 0.3 to 0.7 beyond the patience. trail: was
    robot or human, is no longer. Set elsewhere: robot (moved off it), evicted (for bare surface), weak (for detail).

    Splats in never-seen surroundings stay, unless the rule is "literal". `counts_time`: this is a time step, which
    counts towards the patience.
    """
    config = occupancy.config
    centers = buffer.centers
    is_broken: Bool = ~np.all(np.isfinite(buffer.parameters), axis=1)
    value, is_observed = occupancy.occupancy_around(np.where(is_broken[:, None], np.float32(0), centers))
    is_free, is_uncertain = _verdict(value, is_observed, config)
    if counts_time:
        buffer.num_uncertain[:] = np.where(is_uncertain, buffer.num_uncertain + 1, 0)
    masks = {
        "broken": is_broken,
        "workspace": ~workspace.contains(centers),
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


def _verdict(value: Float32, is_observed: Bool, config: OccupancyConfig) -> tuple[Bool, Bool]:
    if config.rule == "literal":
        return value < config.free_below, (value >= config.free_below) & (value < config.occupied_above)
    return (
        is_observed & (value < config.free_below),
        is_observed & (value >= config.free_below) & (value < config.occupied_above),
    )


def room_for(
    seeds: Seeds, num: int, buffer: SplatBuffer, occupancy: OccupancyMap, shown: Float64, tolerance: float
) -> tuple[Bool, Seeds]:
    """Slots (M,) of at most `num` splats to evict, and the seeds in the order in which they get slots.

    Only object splats go: redundant ones that show least, then those far from the robot's path, for seeds near it.
    shown (M,): how much slots show; tolerance [m]: as in `redundant`.
    """
    splats, live = buffer.splats(occupancy.num_threads), np.flatnonzero(buffer.is_alive)
    stands = splats.labels != Label.ROBOT
    others, may_go = live[stands], live[splats.labels == Label.OBJECT]
    weakest = may_go[np.argsort(shown[may_go], kind="stable")][: fixed.EVICT_ASKED * num]
    order, voxels = np.searchsorted(others, weakest), occupancy.occupied_centers()
    chosen = others[redundant(order, num, splats.select(stands), voxels, tolerance, occupancy.num_threads)]
    is_evicted = np.zeros(len(shown), bool)
    is_evicted[chosen] = True
    path = occupancy.swept_box()
    if path is not None:
        seeds = seeds.select(np.argsort(distance_to_box(seeds.centers, path), kind="stable"))
        left, slots = num - len(chosen), may_go[~is_evicted[may_go]]
        waiting = seeds.centers[len(seeds) - left :]
        is_evicted[slots[far_away(left, waiting, buffer.centers[slots], path)]] = True
    return is_evicted, seeds


def redundant(
    order: NDArray[np.intp],
    num_wanted: int,
    splats: SplatSet,
    voxels: Float32,
    tolerance: float,
    num_threads: int = 1,
) -> NDArray[np.intp]:
    """The first splats of `order`, at most `num_wanted`, that the others together can replace.

    splats: N of objects and people; voxels (K, 3) [m]: occupied centres. A splat represents voxels within
    `tolerance` [m] of its sphere, among the eight nearest centres. It may go if all its voxels keep another: this
    bares no surface.
    """
    if not len(order) or not len(voxels) or num_wanted < 1:
        return np.zeros(0, np.intp)
    reach = splats.radii[order] + tolerance
    of_splat = cKDTree(voxels).query_ball_point(splats.centers[order], reach, workers=num_threads)
    asked = np.unique(np.concatenate([np.asarray(found, np.intp) for found in of_splat]))
    count = np.zeros(len(voxels), np.int64)
    distance, nearest = cKDTree(splats.centers).query(
        voxels[asked], k=np.arange(1, min(fixed.EVICT_NEAREST, len(splats)) + 1), workers=num_threads
    )
    count[asked] = (distance - splats.radii[nearest] <= tolerance).sum(axis=1)
    chosen: list[np.intp] = []
    for splat, found in zip(order, of_splat, strict=True):
        if len(chosen) == num_wanted:
            break
        if (count[found] > 1).all():
            count[found] -= 1
            chosen.append(splat)
    return np.array(chosen, np.intp)


def far_away(num_wanted: int, seeds: Float32, centers: Float32, path: Box) -> NDArray[np.intp]:
    """At most `num_wanted` splats (N, 3) to evict for seeds (K, 3), farthest first.

    Each is at least EVICT_NEARER farther from the path than its seed, so that no two surfaces exchange slots in turn.
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

"""Which splats give their slots to observed surface that has none."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatctrl_cli.config.fixed import EVICT_ASKED, EVICT_NEARER, EVICT_NEAREST
from splatctrl_cli.records import Bool, Box, Float32, Float64, Label, SplatSet
from splatctrl_cli.scene.buffer import Seeds, SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap


def room_for(
    seeds: Seeds, num: int, buffer: SplatBuffer, occupancy: OccupancyMap, shown: Float64, tolerance: float
) -> tuple[Bool, Seeds]:
    """Slots (M,) of at most `num` splats to evict, and the seeds in the order in which they are to get slots.

    First redundant splats, those that show least first, then splats far from the robot's path, for seeds near it.
    Only splats of objects go. shown (M,): how much each slot shows; tolerance [m]: as in `redundant`.
    """
    splats, live = buffer.splats(occupancy.num_threads), np.flatnonzero(buffer.is_alive)
    stands = splats.labels != Label.ROBOT
    others, may_go = live[stands], live[splats.labels == Label.OBJECT]
    weakest = may_go[np.argsort(shown[may_go], kind="stable")][: EVICT_ASKED * num]
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
    """At most `num_wanted` of the splats in `order`, the first of which all others together can do without.

    splats: N that stand for objects and people; voxels (K, 3) [m]: centres of what is occupied. A splat stands for
    the voxels within `tolerance` [m] of its sphere (of eight splats with the nearest centres). One is redundant where
    each of its voxels has another that stays: giving it up leaves no surface bare, to be seeded again at once.
    """
    if not len(order) or not len(voxels) or num_wanted < 1:
        return np.zeros(0, np.intp)
    reach = splats.radii[order] + tolerance
    of_splat = cKDTree(voxels).query_ball_point(splats.centers[order], reach, workers=num_threads)
    asked = np.unique(np.concatenate([np.asarray(found, np.intp) for found in of_splat]))
    count = np.zeros(len(voxels), np.int64)
    ranks = np.arange(1, min(EVICT_NEAREST, len(splats)) + 1)
    distance, nearest = cKDTree(splats.centers).query(voxels[asked], k=ranks, workers=num_threads)
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
    """At most `num_wanted` splats (N, 3), farthest first, each of which is EVICT_NEARER or more farther from the
    robot's path than a seed (K, 3) that gets its slot; seeds come nearest first.

    Farther by that much, so that no two surfaces ever take each other's slots in turn.
    """
    to_splat = distance_to_box(centers, path)
    farthest = np.argsort(-to_splat, kind="stable")[:num_wanted]
    to_seed = np.sort(distance_to_box(seeds, path))[:num_wanted]
    pairs = min(len(farthest), len(to_seed))
    is_worth_it = to_splat[farthest[:pairs]] >= to_seed[:pairs] + EVICT_NEARER
    return farthest[:pairs][np.logical_and.accumulate(is_worth_it)]


def distance_to_box(points: Float32, box: Box) -> Float64:
    """Points (K, 3) [m] -> distance (K,) [m] to a box, 0 inside."""
    outside = np.maximum(np.maximum(box.lower - points, points - box.upper), 0.0)
    return np.asarray(np.linalg.norm(outside, axis=1), np.float64)

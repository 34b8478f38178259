"""Clearance of logged joint states by each field, and their share of unknown space."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.kernels.chain import pair_gaps
from splatctrl_cli.records import Bool, Float64, Stamps

Channel = NDArray[np.uint8]

DistanceFunction = Callable[[Float64], Float64]
"""points (Q, 3) [m], world -> distance (Q,) [m], NaN where there is none."""


@dataclass(frozen=True, kw_only=True)
class BallDistance:
    """A `DistanceFunction` of balls, centers (N, 3), radii (N,) [m], for surface measurement."""

    of_points: DistanceFunction
    centers: NDArray[np.floating]
    radii: NDArray[np.floating]

    def __call__(self, points: Float64) -> Float64:
        return self.of_points(points)


DistancesAt = Callable[[int], Mapping[str, DistanceFunction]]
"""The distances known at a stamp [ns], by name; the same object for the same scene, so that states share a query."""

Observed = Callable[[Float64], Channel]
"""points (Q, 3) [m], world -> the observed channel (Q,) uint8: 0 = never seen."""

CHUNK = 256  # states per query


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """distance (T,) [m] of the nearest moving part, NaN if unknown; sphere (T,): the index of its sphere.

    For self-collision, distance is that of the nearest pair, and sphere is the pair's index, -1 without pairs.
    """

    distance: Float64
    sphere: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class AuditTrace:
    """T audited states.

    stamp_ns (T,); position (T, J) [rad]; clearance by field; limit_margin (T,) [rad]: to the nearest position limit,
    negative outside, at limit_joint (T,); self_clearance (T,) [m] (inf without pairs) at self_pair (T,);
    unknown_share (T,) of sphere centres in never-seen space (NaN if not measured); of_spheres: clearances (T, M) [m]
    by field, if kept.
    """

    stamp_ns: Stamps
    position: Float64
    clearance: Mapping[str, Clearance]
    limit_margin: Float64
    limit_joint: NDArray[np.int64]
    self_clearance: Float64
    self_pair: NDArray[np.int64]
    unknown_share: Float64
    of_spheres: Mapping[str, Float64] = field(default_factory=dict)


def part_clearances(
    model: ArmModel, positions: Float64, distance_to: DistanceFunction, centers: Float64 | None = None
) -> tuple[Float64, Bool]:
    """Return the moving parts' clearances (T, M) [m] at postures (T, J), and which (M,) are of link surfaces.

    A link's triangles decide if the scene is of balls: the link's nearest sphere has their clearance. Each other
    sphere has the larger of that and its own less `sphere_deficit`. centers (T, S, 3) [m]: of all spheres, if known.
    """
    moving = np.flatnonzero(model.moving_spheres)
    there = model.sphere_centers_batch(positions) if centers is None else centers
    points = np.ascontiguousarray(there[:, moving].reshape(-1, 3))
    each = distance_to(points).reshape(len(positions), len(moving)) - model.sphere_set.radii[moving]
    gaps: Mapping[str, Float64] = {}
    if isinstance(distance_to, BallDistance):
        gaps = model.surface_gaps(positions, distance_to.centers, distance_to.radii)
    links = np.array(model.sphere_set.links)[moving]
    for link, gap in gaps.items():
        of_link = np.flatnonzero(links == link)
        if not len(of_link):
            continue
        nearest = of_link[each[:, of_link].argmin(axis=1)]
        deficit = np.maximum(np.nan_to_num(model.sphere_deficit[moving[of_link]]), 0.0)
        each[:, of_link] = np.maximum(each[:, of_link] - deficit, gap[:, None])
        each[np.arange(len(each)), nearest] = gap
    return each, np.isin(links, list(gaps))


def moving_clearance(
    model: ArmModel, positions: Float64, distance_to: DistanceFunction, centers: Float64 | None = None
) -> tuple[Clearance, Float64]:
    """Return the least of `part_clearances` (T,), and all (T, M) [m]."""
    distance, _ = part_clearances(model, positions, distance_to, centers)
    moving = np.flatnonzero(model.moving_spheres)
    nearest = np.argmin(distance, axis=1)
    least = Clearance(distance=distance[np.arange(len(distance)), nearest], sphere=moving[nearest])
    return least, distance


def audit(
    model: ArmModel,
    stamps: Stamps,
    positions: Float64,
    distances_at: DistancesAt,
    *,
    observed: Observed | None = None,
) -> AuditTrace:
    """Return clearances of states, by the distances known at their stamps.

    stamps (T,) [ns] never go back; positions (T, J) finite; T >= 1. The audit of some states of one scene equals that
    part of the audit of all, to the bit.
    """
    parts: dict[str, list[Clearance]] = {}
    spheres: dict[str, list[Float64]] = {}
    self_parts, unknown_parts = [], []
    for first, last in _runs(stamps, distances_at):
        centers = model.sphere_centers_batch(positions[first:last])
        for name, distance_to in distances_at(int(stamps[first])).items():
            least, each = moving_clearance(model, positions[first:last], distance_to, centers)
            parts.setdefault(name, []).append(least)
            spheres.setdefault(name, []).append(each)
        self_parts.append(_self_clearance(model, centers))
        unknown_parts.append(_unknown_share(model, centers, observed))
    limit = np.minimum(model.upper - positions, positions - model.lower)
    return AuditTrace(
        stamp_ns=stamps,
        position=positions,
        clearance={name: _joined(several) for name, several in parts.items()},
        limit_margin=limit.min(axis=1),
        limit_joint=limit.argmin(axis=1),
        self_clearance=_joined(self_parts).distance,
        self_pair=_joined(self_parts).sphere,
        unknown_share=np.concatenate(unknown_parts),
        of_spheres={name: np.concatenate(several) for name, several in spheres.items()},
    )


def observed_at(seen: Channel, origin: Float64, voxel: float, points: Float64) -> Channel:
    """Return the value (Q,) of the voxel of `seen` (X, Y, Z) nearest to each point; 0 (never seen) outside."""
    cell = np.floor((points - origin) / voxel + 0.5).astype(np.int64)
    is_inside = np.all((cell >= 0) & (cell < seen.shape), axis=1)
    found = np.zeros(len(points), dtype=np.uint8)
    found[is_inside] = seen[tuple(cell[is_inside].T)]
    return found


def _runs(stamps: Stamps, distances_at: DistancesAt) -> Iterator[tuple[int, int]]:
    """Yield ranges of at most CHUNK consecutive states in one scene; hold at most two scenes."""
    first, before = 0, distances_at(int(stamps[0]))
    for index, stamp in enumerate(stamps[1:], start=1):
        known = distances_at(int(stamp))
        if known is not before or index - first == CHUNK:
            yield first, index
            first = index
        before = known
    yield first, len(stamps)


def _self_clearance(model: ArmModel, centers: Float64) -> Clearance:
    pairs = np.asarray(model.self_pairs(), dtype=np.int64).reshape(-1, 2)
    if not len(pairs):
        nothing = np.full(len(centers), -1, dtype=np.int64)
        return Clearance(distance=np.full(len(centers), np.inf), sphere=nothing)
    distance = np.array([pair_gaps(c, model.sphere_set.radii, pairs)[0] for c in centers])
    nearest = distance.argmin(axis=1)
    return Clearance(distance=distance[np.arange(len(centers)), nearest], sphere=nearest)


def _unknown_share(model: ArmModel, centers: Float64, observed: Observed | None) -> Float64:
    if observed is None:
        return np.full(len(centers), np.nan)
    moving = centers[:, np.flatnonzero(model.moving_spheres)]
    never = observed(np.ascontiguousarray(moving.reshape(-1, 3))) == 0
    return np.asarray(never.reshape(moving.shape[:2]).mean(axis=1))


def _joined(several: list[Clearance]) -> Clearance:
    return Clearance(
        distance=np.concatenate([c.distance for c in several]), sphere=np.concatenate([c.sphere for c in several])
    )

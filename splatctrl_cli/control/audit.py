"""Clearance of logged joint states by each field, their unknown share, and bounds between states.

Between states with distances d_0s and d_1s, sphere s travels at most L_s, joint motion times `RobotModel.lever_arms`.
Exact distance is 1-Lipschitz, and thus at least ``(d_0s + d_1s - L_s) / 2`` in between.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from splatctrl_cli.config.fixed import HALVED_DOWN_TO, MAX_HALVINGS
from splatctrl_cli.kernels.chain import pair_gaps
from splatctrl_cli.records import Bool, Columns, Float64, Floats, Index, Integers, Stamps, UInt8
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import voxels_at

DistanceFunction = Callable[[Float64], Float64]
"""points (Q, 3) [m], world -> distance (Q,) [m], NaN where unknown."""


@dataclass(frozen=True, kw_only=True)
class BallDistance:
    """A `DistanceFunction` to balls: centers (N, 3), radii (N,) [m]."""

    of_points: DistanceFunction
    centers: Floats
    radii: Floats

    def __call__(self, points: Float64) -> Float64:
        return self.of_points(points)


DistancesAt = Callable[[int], Mapping[str, DistanceFunction]]
"""Stamp [ns] -> the distances known then, by name. One scene gives one object, so that its states share a query."""

Observed = Callable[[Float64], UInt8]
"""points (Q, 3) [m], world -> the observed channel (Q,) uint8: 0 = never seen."""

CHUNK = 256  # states per query


@dataclass(frozen=True, kw_only=True)
class Clearance(Columns):
    """Distance (T,) [m] of the nearest moving part, NaN if unknown; sphere (T,): its index.

    For self-collision, both are of the nearest pair; inf and -1 without pairs.
    """

    distance: Float64
    sphere: Index


@dataclass(frozen=True, kw_only=True)
class AuditTrace:
    """T audited states, with values (T,).

    position (T, J) [rad]; clearance: by field; limit_margin [rad]: to the nearest position limit, of limit_joint,
    negative outside; self_clearance [m]: of self_pair, inf without pairs; unknown_share: never-seen share of sphere
    centres (NaN: not measured); of_spheres: clearances (T, M) [m] by field.
    """

    stamp_ns: Stamps
    position: Float64
    clearance: Mapping[str, Clearance]
    limit_margin: Float64
    limit_joint: Index
    self_clearance: Float64
    self_pair: Index
    unknown_share: Float64
    of_spheres: Mapping[str, Float64] = field(default_factory=dict)


def part_clearances(
    model: RobotModel, positions: Float64, distance_to: DistanceFunction, centers: Float64 | None = None
) -> tuple[Float64, Bool]:
    """Moving parts' clearances (T, M) [m] at postures (T, J); True (M,) for link surfaces.

    In a scene of balls, a link's triangles decide: its nearest sphere gets their clearance. Its other spheres get the
    larger of that clearance and their own less `sphere_deficit`. centers (T, S, 3) [m]: of all spheres, if known.
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
    model: RobotModel, positions: Float64, distance_to: DistanceFunction, centers: Float64 | None = None
) -> tuple[Clearance, Float64]:
    """Least of `part_clearances` (T,), and all (T, M) [m]."""
    distance, _ = part_clearances(model, positions, distance_to, centers)
    moving = np.flatnonzero(model.moving_spheres)
    nearest = np.argmin(distance, axis=1)
    return Clearance(distance=distance[np.arange(len(distance)), nearest], sphere=moving[nearest]), distance


def audit(
    model: RobotModel,
    stamps: Stamps,
    positions: Float64,
    distances_at: DistancesAt,
    *,
    observed: Observed | None = None,
) -> AuditTrace:
    """Clearances of states, by the distances known at their stamps.

    stamps (T,) [ns] never go back; positions (T, J) finite; T >= 1. Auditing only some of the states gives
    bit-identical results for them.
    """
    parts: dict[str, list[tuple[Clearance, Float64]]] = {}
    self_parts, unknown_parts = [], []
    for first, last in _runs(stamps, distances_at):
        centers = model.sphere_centers_batch(positions[first:last])
        for name, distance_to in distances_at(int(stamps[first])).items():
            part = moving_clearance(model, positions[first:last], distance_to, centers)
            parts.setdefault(name, []).append(part)
        self_parts.append(_self_clearance(model, centers))
        unknown_parts.append(_unknown_share(model, centers, observed))
    limit = np.minimum(model.upper - positions, positions - model.lower)
    of_self = self_parts[0].joined(*self_parts[1:])
    return AuditTrace(
        stamp_ns=stamps,
        position=positions,
        clearance={name: own[0][0].joined(*(least for least, _ in own[1:])) for name, own in parts.items()},
        limit_margin=limit.min(axis=1),
        limit_joint=limit.argmin(axis=1),
        self_clearance=of_self.distance,
        self_pair=of_self.sphere,
        unknown_share=np.concatenate(unknown_parts),
        of_spheres={name: np.concatenate([each for _, each in own]) for name, own in parts.items()},
    )


def observed_at(seen: UInt8, origin: Float64, voxel: float, points: Float64) -> UInt8:
    """Value (Q,) of the voxel of `seen` (X, Y, Z) at each point; 0 (never seen) outside."""
    cells, is_inside = voxels_at(points, origin, voxel, seen.shape)
    return np.where(is_inside, seen[tuple(cells.T)], np.uint8(0))


def _runs(stamps: Stamps, distances_at: DistancesAt) -> Iterator[tuple[int, int]]:
    """Yield ranges of at most CHUNK states in one scene, with two scenes in memory."""
    first, before = 0, distances_at(int(stamps[0]))
    for index, stamp in enumerate(stamps[1:], start=1):
        known = distances_at(int(stamp))
        if known is not before or index - first == CHUNK:
            yield first, index
            first = index
        before = known
    yield first, len(stamps)


def _self_clearance(model: RobotModel, centers: Float64) -> Clearance:
    pairs = np.asarray(model.self_pairs(), dtype=np.int64).reshape(-1, 2)
    if not len(pairs):
        return Clearance(distance=np.full(len(centers), np.inf), sphere=np.full(len(centers), -1, dtype=np.int64))
    distance = np.array([pair_gaps(c, model.sphere_set.radii, pairs)[0] for c in centers])
    nearest = distance.argmin(axis=1)
    return Clearance(distance=distance[np.arange(len(centers)), nearest], sphere=nearest)


def _unknown_share(model: RobotModel, centers: Float64, observed: Observed | None) -> Float64:
    if observed is None:
        return np.full(len(centers), np.nan)
    moving = centers[:, np.flatnonzero(model.moving_spheres)]
    never = observed(np.ascontiguousarray(moving.reshape(-1, 3))) == 0
    return np.asarray(never.reshape(moving.shape[:2]).mean(axis=1))


@dataclass(frozen=True, kw_only=True)
class Reach:
    """Moving spheres (M,) of an arm and their travel.

    radii (M,) [m]: enlarged to cover the surface; levers (M, J): travel [m] per rad or m of a joint; velocity_limit
    (J,) [1/s].
    """

    moving: Integers
    radii: Float64
    levers: Float64
    velocity_limit: Float64

    @classmethod
    def of(cls, model: RobotModel) -> "Reach":
        moving = np.flatnonzero(model.moving_spheres)
        deficit = np.maximum(np.nan_to_num(np.asarray(model.sphere_deficit, np.float64)[moving]), 0.0)
        return cls(
            moving=moving,
            radii=np.asarray(model.sphere_set.radii, np.float64)[moving] + deficit,
            levers=model.lever_arms()[moving],
            velocity_limit=np.asarray(model.velocity_limit, np.float64),
        )


@dataclass(frozen=True, kw_only=True)
class Between:
    """Lower bounds (T - 1,) [m] of the clearance within intervals, ends included.

    is_met (T - 1,): lower is the clearance of a posture in between that is below the margin. is_bounded (T - 1,):
    False without a bound.
    """

    lower: Float64
    is_met: Bool
    is_bounded: Bool


def between_states(
    model: RobotModel,
    reach: Reach,
    stamps: Index,
    positions: Float64,
    velocities: Float64,
    at_states: Float64,
    distance_to: DistanceFunction,
    *,
    margin: float,
    longest: float,
) -> Between:
    """Bound clearances between states (T, J) at stamps (T,) [ns] in one scene.

    at_states (T, M) [m]: moving spheres' `clearances`, infinite for intended contact. Up to `longest` [s] the arm
    moves straight in joint space, plus any travel of its velocities (T, J) beyond that motion. Over longer intervals
    it may move anywhere within its velocity limits; that bound counts only if it reaches the margin [m], or if an end
    is below the margin.
    """
    seconds = np.diff(stamps) * 1e-9
    motion = np.abs(np.diff(positions, axis=0))
    speed = 0.5 * (np.abs(velocities[1:]) + np.abs(velocities[:-1])) * seconds[:, None]
    straight = motion @ reach.levers.T
    beyond = np.maximum(np.where(np.isfinite(speed), speed, 0.0) - motion, 0.0) @ reach.levers.T
    first, last = at_states[:-1], at_states[1:]
    is_long = seconds > longest + 1e-6
    anywhere = seconds[:, None] * reach.velocity_limit @ reach.levers.T
    travel = np.where(is_long[:, None], np.maximum(anywhere, straight), straight)
    lower = 0.5 * (first + last - travel - beyond)
    ends = np.minimum(first.min(axis=1), last.min(axis=1))
    is_open = ~is_long & (lower.min(axis=1) < margin) & (ends >= margin)
    least = np.minimum(lower.min(axis=1), ends)
    chosen = np.flatnonzero(is_open)
    is_met = np.zeros(len(least), dtype=np.bool_)
    if len(chosen):
        refined, is_met[chosen] = _refined(
            model, reach, positions[chosen], positions[chosen + 1], first[chosen], last[chosen], distance_to, margin
        )
        away = np.where(is_met[chosen], 0.0, 0.5 * beyond[chosen].max(axis=1))
        least[chosen] = np.minimum(refined - away, ends[chosen])
    short = ~is_long & ~is_open & (ends < margin)
    least[short] = ends[short]  # the ends are below the margin already
    is_bounded = np.isfinite(least) & (~is_long | (least >= margin) | (ends < margin))
    return Between(lower=least, is_met=is_met, is_bounded=is_bounded)


def _refined(
    model: RobotModel,
    reach: Reach,
    q_first: Float64,
    q_last: Float64,
    first: Float64,
    last: Float64,
    distance_to: DistanceFunction,
    margin: float,
) -> tuple[Float64, Bool]:
    """Halve K straight motions until each piece is short, or its bound reaches the margin.

    Return the least bound (K,) and is_met (K,). If is_met, a posture on the way is below the margin, and its least
    clearance replaces the bound.
    """
    least, is_met = np.full(len(q_first), np.inf), np.zeros(len(q_first), dtype=np.bool_)
    owner = np.arange(len(q_first))
    for level in range(MAX_HALVINGS + 1):
        travel = np.abs(q_last - q_first) @ reach.levers.T
        bound = (0.5 * (first + last - travel)).min(axis=1)
        is_done = (bound >= margin) | (travel.max(axis=1) < HALVED_DOWN_TO) | (level == MAX_HALVINGS)
        np.minimum.at(least, owner[is_done], bound[is_done])
        open_ = np.flatnonzero(~is_done)
        if not len(open_):
            break
        middle = 0.5 * (q_first[open_] + q_last[open_])
        at_middle = clearances(model, reach, middle, distance_to)
        at_middle[np.isposinf(first[open_]) | np.isposinf(last[open_])] = (
            np.inf
        )  # excluded at an end: also in between
        reached = at_middle.min(axis=1) < margin  # a sample below the margin settles its interval
        is_first = reached & ~is_met[owner[open_]]
        least[owner[open_[is_first]]] = np.inf  # drop the bounds of settled pieces
        is_met[owner[open_[reached]]] = True
        np.minimum.at(least, owner[open_[reached]], at_middle[reached].min(axis=1))
        settled = np.isin(owner[open_], owner[open_[reached]])
        keep = open_[~settled]
        middle, at_middle = middle[~settled], at_middle[~settled]
        q_first, q_last = np.concatenate([q_first[keep], middle]), np.concatenate([middle, q_last[keep]])
        first, last = np.concatenate([first[keep], at_middle]), np.concatenate([at_middle, last[keep]])
        owner = np.concatenate([owner[keep], owner[keep]])
    return least, is_met


def clearances(model: RobotModel, reach: Reach, positions: Float64, distance_to: DistanceFunction) -> Float64:
    """Moving spheres' clearances (T, M) [m], less uncovered surface where no triangles decide."""
    each, is_surface = part_clearances(model, positions, distance_to)
    return np.asarray(each - np.where(is_surface, 0.0, reach.radii - model.sphere_set.radii[reach.moving]))

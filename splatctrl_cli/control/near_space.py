"""What cameras knew of the space just outside of a moving arm, and how old that evidence was.

The space inside the arm is never seen, and that the arm was somewhere says nothing of what is beside it. So the
question is put to points on shells: each moving sphere's radius and the margin away from its centre, outside of all
other spheres of the arm. Where its link has triangles, the shell is as near to the link's own surface instead.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from splatctrl_cli.config import fixed
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Bool, Float64, Index


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What cameras had seen at one moment. last_ns: points (Q, 3) [m], world -> stamps (Q,) [ns] at which a camera
    last returned depth through or on them, -1 never; unanswered: centres (K, 3) [m], world, of the voxels, with edges
    of `voxel` [m], that cameras looked at and got no depth from; edges: centre and radius (K, 4) [m], world, of balls
    in which a surface may go on where its edge was lost.
    """

    last_ns: Callable[[Float64], NDArray[np.int64]]
    unanswered: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    voxel: float = 0.0
    edges: Float64 = field(default_factory=lambda: np.empty((0, 4)))


@dataclass(frozen=True, kw_only=True)
class NearFigures:
    """Of one state: unseen, the share of the points in space that is new to the motion that no camera had ever seen;
    blind, the share of the moving spheres about which nearly all (`NEAR_BLIND`) of that space was never seen; age [s]
    within which `NEAR_FRESH_SHARE` of the seen points were last seen; ahead [s] by which the last of them was seen
    after the state. NaN where there are too few points. unanswered [m]: the distance of the nearest voxel that
    cameras looked at without an answer, and its place (3,) [m]; hidden [m]: how near a point that was never seen, of
    new space or not, is to the map's surfaces, and its place (3,) [m]; beyond [m]: the same of new space about a
    sphere that comes to almost nothing else (`NEAR_BLIND`); edge [m]: the distance of the nearest lost edge, and its
    place (3,) [m]; infinite and NaN where there is none.
    """

    unseen: float
    blind: float
    age: float
    ahead: float
    unanswered: float
    unanswered_place: Float64
    hidden: float
    hidden_place: Float64
    beyond: float
    beyond_place: Float64
    edge: float
    edge_place: Float64


class NearSpace:
    """Asks for the shells of the states of a motion that are far enough apart, in time or in space."""

    def __init__(self, model: ArmModel, margin: float) -> None:
        self._model = model
        self._moving = np.flatnonzero(model.moving_spheres)
        self._radii = np.asarray(model.sphere_set.radii, np.float64)
        self._margin = margin
        self._depths = np.arange(margin, 0.0, -fixed.NEAR_LAYER)  # of shells, the outermost first
        self._first: Float64 | None = None  # centres (S, 3) of the first state
        self._next_ns = -(2**63)
        self._looked: Float64 | None = None  # centres (M, 3) of the moving spheres when they were last looked about
        self._surfaces, self._links = model.link_distances, np.array(model.sphere_set.links)
        names = list(dict.fromkeys(self._links))
        own = np.arange(len(names), len(names) + len(self._links))  # a sphere is a body where its link has no surface
        self._body = np.where(
            np.isin(self._links, list(self._surfaces)), [names.index(link) for link in self._links], own
        )
        self._reaches = dict[tuple[int, float], Float64]()  # of shells, by the number of directions and how far away

    def due(self, stamps: NDArray[np.int64], centers: Float64) -> dict[int, bool]:
        """Of states at stamps (T,) [ns] that do not go back, with their spheres' centres (T, S, 3), those to look at:
        each time a sphere has moved by `NEAR_MOVED`, and True for those `NEAR_EVERY_NS` after the last such, whose
        shares and ages count: what is allowed of these is from states so far apart.
        """
        chosen, moving = dict[int, bool](), centers[:, self._moving]
        for index, stamp_ns in enumerate(stamps.tolist()):
            is_timed = stamp_ns >= self._next_ns
            if is_timed:
                self._next_ns = stamp_ns + fixed.NEAR_EVERY_NS
            if is_timed or self._has_moved(moving[index]):
                chosen[index], self._looked = is_timed, moving[index]
        return chosen

    def _has_moved(self, centers: Float64) -> bool:
        """Whether one of the moving spheres (M, 3) is `NEAR_MOVED` from where it was last looked about."""
        if self._looked is None:
            return False
        return bool(np.sum((centers - self._looked) ** 2, axis=1).max(initial=0.0) >= fixed.NEAR_MOVED**2)

    def on_the_way(self, first: Float64, last: Float64) -> Float64:
        """Postures (K, J) between two (J,), so many that no sphere moves by `NEAR_MOVED` from one to the next."""
        begin, end = self._model.sphere_centers_batch(np.stack([first, last]))[:, self._moving]
        num = int(np.ceil(np.linalg.norm(end - begin, axis=1).max(initial=0.0) / fixed.NEAR_MOVED))
        return np.asarray(first + (last - first) * (np.arange(1, num) / max(num, 1))[:, None])

    def look(
        self, stamp_ns: int, q: Float64, known: Seen, distance: Callable[[Float64], Float64] | None = None
    ) -> NearFigures:
        """What was known about the posture q (J,) at a stamp; distance: of points (Q, 3) from the map's surfaces."""
        centers = self._model.sphere_centers(q)
        if self._first is None:
            self._first = centers
        points, owners = self._shell(q, centers, DIRECTIONS, self._margin)
        fewest = fixed.NEAR_LEAST_SHARE * len(self._moving) * len(DIRECTIONS)
        seen = known.last_ns(points)
        is_never = seen < 0
        is_new = self._is_new(points)
        unseen = blind = age = ahead = np.nan
        if is_new.sum() >= fewest:
            unseen = float(is_never[is_new].mean())
            num_new, num_never = (np.bincount(owners[which]) for which in (is_new, is_new & is_never))
            num_never = np.pad(num_never, (0, len(num_new) - len(num_never)))
            is_blind = (num_new >= fixed.NEAR_FEWEST) & (num_never >= fixed.NEAR_BLIND * num_new)
            blind = float(np.sum(is_blind)) / len(self._moving)
        if (~is_never).sum() >= fewest:
            ages = (stamp_ns - seen[~is_never]) * 1e-9
            age, ahead = float(np.quantile(ages, fixed.NEAR_FRESH_SHARE)), max(-float(ages.min()), 0.0)
        voxels = known.unanswered
        unanswered, unanswered_place = self._nearest(q, voxels, centers, known.voxel / 2)  # from its nearest face
        edge, edge_place = self._nearest(q, known.edges[:, :3], centers, known.edges[:, 3])
        hidden, hidden_place = beyond, beyond_place = NOWHERE
        if distance is not None:
            fine, owners = self._shell(q, centers, FINE, self._margin)
            is_never = known.last_ns(fine) < 0
            within = [self._shell(q, centers, FINE, away)[0] for away in self._depths[1:]]
            never = [fine[is_never], *(points[known.last_ns(points) < 0] for points in within)]
            hidden, hidden_place = _nearest_of(np.concatenate(never), distance)
            beyond, beyond_place = _nearest_of(fine[self._is_in_the_blind(fine, owners, is_never)], distance)
        return NearFigures(
            unseen=unseen,
            blind=blind,
            age=age,
            ahead=ahead,
            unanswered=unanswered,
            unanswered_place=unanswered_place,
            hidden=hidden,
            hidden_place=hidden_place,
            beyond=beyond,
            beyond_place=beyond_place,
            edge=edge,
            edge_place=edge_place,
        )

    def _shell(self, q: Float64, centers: Float64, directions: Float64, away: float) -> tuple[Float64, Index]:
        """Points (Q, 3), so far [m] from moving spheres or their surfaces and outside of all others, and their
        spheres (Q,).
        """
        turned = np.tile(directions, (len(self._moving), 1, 1))
        for link in self._surfaces:
            turned[self._links[self._moving] == link] = directions @ self._model.frame_pose(q, link)[:3, :3].T
        offsets = self._reach(directions, away)[..., None] * turned
        points = (centers[self._moving][:, None] + offsets).reshape(-1, 3)
        owners = np.repeat(self._moving, len(directions))
        is_outside = _is_outside(points, centers, self._radii + fixed.NEAR_APART, self._body[owners], self._body)
        return points[is_outside], owners[is_outside]

    def _reach(self, directions: Float64, away: float) -> Float64:
        """How far (M, D) [m] from the moving spheres' centres their shells are, along directions (D, 3) in the frames
        of links that have triangles; NaN where another part of the link is nearer.
        """
        key = len(directions), away
        if key not in self._reaches:
            reach = np.repeat((self._radii[self._moving] + away)[:, None], len(directions), axis=1)
            for row, sphere in enumerate(self._moving):
                if (distance := self._surfaces.get(self._links[sphere])) is not None:
                    center = self._model.sphere_set.centers[sphere]
                    for _ in range(fixed.NEAR_STEPS):
                        gap = distance(center + reach[row][:, None] * directions)
                        reach[row] -= np.clip(gap - away, 0.0, reach[row])
                    reach[row][gap < away - fixed.NEAR_APART] = np.nan
            self._reaches[key] = reach
        return self._reaches[key]

    def _is_new(self, points: Float64) -> Bool:
        """Points (Q, 3) that the motion comes to: away from the arm of the first state."""
        assert self._first is not None
        return _is_outside(points, self._first, self._radii + fixed.NEAR_NEW)

    def _is_in_the_blind(self, points: Float64, owners: Index, is_never: Bool) -> Bool:
        """Those of `FINE` points (Q, 3) about spheres (Q,) in new space that were never seen, as nearly all of the
        new space about their sphere.
        """
        is_unknown, num = is_never.copy(), len(self._radii)
        is_unknown[is_never] = self._is_new(points[is_never])
        num_unknown = np.bincount(owners[is_unknown], minlength=num)
        is_asked = (num_unknown >= fixed.NEAR_BLIND * fixed.NEAR_FEWEST_FINE)[owners]
        num_new = np.bincount(owners[is_asked], self._is_new(points[is_asked]), minlength=num)
        is_blind = (num_new >= fixed.NEAR_FEWEST_FINE) & (num_unknown >= fixed.NEAR_BLIND * num_new)
        return np.asarray(is_unknown & is_blind[owners])

    def _nearest(
        self, q: Float64, points: Float64, centers: Float64, reach: float | Float64
    ) -> tuple[float, Float64]:
        """The least distance [m] of balls about points (K, 3), `reach` (K,) [m] large, near the arm to its moving
        spheres, within the margin to the surfaces that these stand for, at least 0, and that point (3,).
        """
        moving, radii = centers[self._moving], self._radii[self._moving]
        around = radii.max() + max(fixed.NEAR_NEW, self._margin + np.max(reach, initial=0.0))
        is_near = np.all((points > moving.min(axis=0) - around) & (points < moving.max(axis=0) + around), axis=1)
        if not is_near.any():
            return NOWHERE
        points, reach = points[is_near], np.broadcast_to(reach, len(is_near))[is_near]
        each = cdist(points, moving) - radii
        is_within = each.min(axis=1) - reach <= self._margin
        for link, distance in self._surfaces.items():
            T_link_world = invert_transform(self._model.frame_pose(q, link))
            gap = distance(transform_points(T_link_world, points[is_within]))
            each[np.ix_(is_within, self._links[self._moving] == link)] = gap[:, None]
        away = each.min(axis=1) - reach
        least = int(np.argmin(away))
        return max(float(away[least]), 0.0), points[least]


def _nearest_of(points: Float64, distance: Callable[[Float64], Float64]) -> tuple[float, Float64]:
    """The least distance [m] of points (Q, 3) to surfaces, and that point (3,)."""
    away = distance(points) if len(points) else np.full(len(points), np.nan)
    if np.isnan(away).all():
        return NOWHERE
    least = int(np.nanargmin(away))
    return float(away[least]), points[least]


def _is_outside(
    points: Float64, centers: Float64, radii: Float64, owners: Index | None = None, bodies: Index | None = None
) -> Bool:
    """Points (Q, 3) outside of all spheres (S, 3), (S,) [m] but those of their owner (Q,), by bodies (S,)."""
    squared = np.sum(points**2, axis=1)[:, None] + np.sum(centers**2, axis=1) - 2.0 * points @ centers.T
    beyond = squared - radii**2
    if owners is not None and bodies is not None:
        beyond[owners[:, None] == bodies] = np.inf
    return np.asarray(beyond.min(axis=1) > 0)


def _directions() -> Float64:
    """Unit vectors (26, 3) towards the faces, edges and corners of a cube."""
    steps = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)], np.float64) - 1.0
    return np.asarray(steps / np.linalg.norm(steps, axis=1)[:, None])


def _spiral(num: int) -> Float64:
    """Unit vectors (num, 3) spread evenly over the sphere, on a Fibonacci spiral."""
    z = 1.0 - 2.0 * (np.arange(num) + 0.5) / num
    angle = np.pi * (1.0 + 5.0**0.5) * np.arange(num)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


NOWHERE = (np.inf, np.full(3, np.nan))  # a distance and its place
DIRECTIONS = _directions()
FINE = _spiral(fixed.NEAR_DIRECTIONS)

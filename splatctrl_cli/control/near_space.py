"""Camera evidence near a moving arm: each point within the margin has one class.

The points form a lattice outside the robot, near its moving links' triangles, or a link's spheres if it has none.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.distance import cdist

from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Bool, Float64, Index, UInt8
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import EvidenceClass

NEVER_SEEN = (
    *(EvidenceClass.HIDDEN_BY_ARM, EvidenceClass.HIDDEN_BY_THING, EvidenceClass.OUT_OF_VIEW),
    *(EvidenceClass.NO_RETURN, EvidenceClass.CONTRADICTED, EvidenceClass.UNANSWERED),
)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Camera evidence at one moment.

    look: points (Q, 3) [m], world -> stamp (Q,) [ns] of the last depth through or on each point, -1 if never, and its
    `EvidenceClass` (Q,), `FREE` if ever seen. edges (K, 4) [m], world: centre and radius of balls into which a
    surface may extend. origin (3,), voxel [m], shape (X, Y, Z): of the voxels. is_free (X, Y, Z): None if unknown.
    """

    look: Callable[[Float64], tuple[Index, UInt8]]
    edges: Float64 = field(default_factory=lambda: np.empty((0, 4)))
    origin: Float64 = field(default_factory=lambda: np.zeros(3))
    voxel: float = fixed.NEAR_LATTICE
    shape: tuple[int, ...] = (0, 0, 0)
    is_free: Bool | None = None


@dataclass(frozen=True, kw_only=True)
class Account:
    """Evidence near the arm in one posture.

    shares (C,): of points within the margin, by `EvidenceClass`. assumed: share not free, of points whose voxels
    reach into the margin. nearest (C,) [m]: each class's least distance to the arm, at places (C, 3).
    unseen_path [m]: shortest path from the map's surfaces to the arm through a never-seen point, unseen_path_place.
    blind_to_surface [m]: least distance from the surfaces to a never-seen point, blind_place, near a sphere with
    almost only such points (`NEAR_BLIND`). Without such points, distances are infinite, places NaN. age [s]: quantile
    `NEAR_FRESH_SHARE` of ages. ahead [s]: time until the latest view. Both are NaN without views.
    """

    shares: Float64
    assumed: float
    nearest: Float64
    places: Float64
    unseen_path: float
    unseen_path_place: Float64
    blind_to_surface: float
    blind_place: Float64
    age: float
    ahead: float


class NearSpace:
    """Evaluates states of a motion that are far enough apart."""

    def __init__(self, model: RobotModel, margin: float, max_age: float = np.inf) -> None:
        """max_age [s]: older evidence is stale."""
        self._model, self._margin, self._max_age = model, margin, max_age
        self._moving = model.moving_spheres
        self._radii = np.asarray(model.sphere_set.radii, np.float64)
        self._links = np.array(model.sphere_set.links)
        self._names = list(dict.fromkeys(self._links))
        self._surfaces = model.link_distances
        self._grids = dict[str, tuple[Float64, Float64]]()  # by link, as `_grid_of`
        self._next_ns = -(2**63)
        self._looked: Float64 | None = None  # centres (M, 3) of the moving spheres at the last evaluation

    def choose(self, stamps: Index, centers: Float64) -> dict[int, bool]:
        """Indices of states to evaluate; True if the evidence's age counts.

        A state is chosen every `NEAR_EVERY_NS` (True), and when a sphere has moved by `NEAR_MOVED`. stamps (T,) [ns]
        never go back; centers (T, S, 3).
        """
        chosen, moving = dict[int, bool](), centers[:, self._moving]
        for index, stamp_ns in enumerate(stamps.tolist()):
            is_timed = stamp_ns >= self._next_ns
            if is_timed:
                self._next_ns = stamp_ns + fixed.NEAR_EVERY_NS
            away = np.zeros((0, 3)) if self._looked is None else moving[index] - self._looked
            if is_timed or np.sum(away**2, axis=1).max(initial=0.0) >= fixed.NEAR_MOVED**2:
                chosen[index], self._looked = is_timed, moving[index]
        return chosen

    def postures_between(self, first: Float64, last: Float64) -> Float64:
        """Postures (K, J) between two, so dense that no sphere moves over `NEAR_MOVED`."""
        begin, end = self._model.sphere_centers_batch(np.stack([first, last]))[:, self._moving]
        num = int(np.ceil(np.linalg.norm(end - begin, axis=1).max(initial=0.0) / fixed.NEAR_MOVED))
        return np.asarray(first + (last - first) * (np.arange(1, num) / max(num, 1))[:, None])

    def look(
        self, stamp_ns: int, q: Float64, known: Seen, distance: Callable[[Float64], Float64] | None = None
    ) -> Account:
        """Evidence at posture q (J,); distance: to the map's surfaces."""
        centers, voxels = self._model.sphere_centers(q), fixed.NEAR_LATTICE / known.voxel
        # The step is a multiple of a voxel, or an integer fraction.
        step = float(known.voxel * np.ceil(voxels - 1e-6) / np.ceil(1 / voxels - 1e-6))
        points = self._lattice(known.origin, step, centers)
        gaps, spheres = self._gaps(q, centers, points, self._margin + step / 2)
        is_near = (gaps > 0) & (gaps <= self._margin + step / 2)  # the voxel of such a point reaches into the margin
        points, gaps, spheres = points[is_near], gaps[is_near], spheres[is_near]
        seen_ns, classes = known.look(points)
        ages, is_seen = (stamp_ns - seen_ns) * 1e-9, seen_ns >= 0
        classes = np.where((classes == EvidenceClass.FREE) & (ages > self._max_age), EvidenceClass.STALE, classes)
        away = np.full(len(points), np.inf)
        if distance is not None and len(points):
            away = np.nan_to_num(distance(points), nan=np.inf)
        classes[away <= 0] = EvidenceClass.SURFACE
        nearest, places = _nearest_by(classes, gaps - step / 2, points)
        edge = EvidenceClass.DEPTH_EDGE
        nearest[edge], places[edge] = self._nearest_edge(q, centers, known.edges)
        is_within = gaps <= self._margin
        is_never = is_within & np.isin(classes, NEVER_SEEN)
        num, num_never = (np.bincount(spheres[which], minlength=len(centers)) for which in (is_within, is_never))
        is_blind = (num_never >= fixed.NEAR_BLIND * num) & (num >= fixed.NEAR_FEWEST)
        unseen_path, unseen_path_place = _nearest_of(points[is_never], away[is_never] + gaps[is_never])
        is_in_blind = is_never & is_blind[spheres]
        to_blind, blind_place = _nearest_of(points[is_in_blind], away[is_in_blind])
        return Account(
            shares=np.bincount(classes[is_within], minlength=len(EvidenceClass)) / max(num.sum(), 1),
            assumed=float(np.mean(classes != EvidenceClass.FREE)) if len(points) else 0.0,
            nearest=nearest,
            places=places,
            unseen_path=unseen_path,
            unseen_path_place=unseen_path_place,
            blind_to_surface=to_blind,
            blind_place=blind_place,
            age=float(np.quantile(ages[is_seen], fixed.NEAR_FRESH_SHARE)) if is_seen.any() else np.nan,
            ahead=max(-float(ages[is_seen].min()), 0.0) if is_seen.any() else np.nan,
        )

    def _lattice(self, origin: Float64, step: float, centers: Float64) -> Float64:
        at = (centers[self._moving] - origin) / step
        reaches = (self._radii[self._moving] + self._margin) / step + 0.5
        first = np.floor((at - reaches[:, None]).min(axis=0)).astype(int)
        is_near = np.zeros(np.ceil((at + reaches[:, None]).max(axis=0)).astype(int) - first + 1, bool)
        for center, reach in zip(at - first, reaches, strict=True):
            low, high = np.ceil(center - reach).astype(int), np.floor(center + reach).astype(int) + 1
            x, y, z = (np.arange(a, b) - c for a, b, c in zip(low, high, center, strict=True))
            is_in = x[:, None, None] ** 2 + y[:, None] ** 2 + z**2 <= reach**2
            is_near[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] |= is_in
        return np.asarray(origin + step * (first + np.argwhere(is_near)))

    def _gaps(self, q: Float64, centers: Float64, points: Float64, reach: float) -> tuple[Float64, Index]:
        """Distance (Q,) [m] to moving links, infinite beyond `reach`, negative inside; nearest moving sphere."""
        to_spheres = cdist(points, centers) - self._radii
        gaps = np.full(len(points), np.inf)
        is_inside = np.zeros(len(points), bool)
        for name in self._names:
            own = self._links == name
            gap = to_spheres[:, own].min(axis=1)
            is_asked = gap <= reach
            if name in self._surfaces and is_asked.any():
                T_link_world = invert_transform(self._model.frame_pose(q, str(name)))
                gap[is_asked] = self._gap_to(str(name), transform_points(T_link_world, points[is_asked]))
            is_inside |= gap <= 0
            if self._moving[own].any():
                gaps = np.where(is_asked, np.minimum(gap, gaps), gaps)
        nearest = np.where(self._moving, to_spheres, np.inf).argmin(axis=1)
        return np.where(is_inside, -np.abs(gaps), gaps), nearest

    def _gap_to(self, name: str, points: Float64) -> Float64:
        """Interpolated distance (Q,) [m] to a link's surface, accurate to about a millimetre near it."""
        if name not in self._grids:
            self._grids[name] = self._grid_of(name)
        lower, values = self._grids[name]
        at = (points - lower) / (fixed.NEAR_LATTICE / 2)
        return np.asarray(map_coordinates(values, at.T, order=1, mode="nearest"))

    def _grid_of(self, name: str) -> tuple[Float64, Float64]:
        step, own, reach = fixed.NEAR_LATTICE, self._links == name, self._margin + 2 * fixed.NEAR_LATTICE
        centers, radii = self._model.sphere_set.centers[own], self._radii[own, None] + reach
        lower = (centers - radii).min(axis=0)
        num = np.ceil(((centers + radii).max(axis=0) - lower) / step).astype(int) + 1
        nodes, fine = (np.moveaxis(np.indices(size), 0, -1) for size in (num, 2 * num - 1))
        coarse = self._surfaces[name]((lower + step * nodes).reshape(-1, 3), None).reshape(num)
        values = map_coordinates(coarse, fine.reshape(-1, 3).T / 2, order=1)
        is_near = np.abs(values) < reach
        near = lower + step / 2 * fine.reshape(-1, 3)[is_near]
        values[is_near] = self._surfaces[name](near, values[is_near] > 2 * step)
        return lower, values.reshape(2 * num - 1)

    def _nearest_edge(self, q: Float64, centers: Float64, edges: Float64) -> tuple[float, Float64]:
        reach = self._margin + np.max(edges[:, 3], initial=0.0)
        around = self._radii.max() + reach
        moving = centers[self._moving]
        is_near = np.all((edges[:, :3] > moving.min(0) - around) & (edges[:, :3] < moving.max(0) + around), axis=1)
        balls = edges[is_near]
        away = self._gaps(q, centers, balls[:, :3], reach)[0] - balls[:, 3] if len(balls) else np.array([np.inf])
        least = int(away.argmin())
        return max(float(away[least]), 0.0), balls[least, :3] if len(balls) else np.full(3, np.nan)


def _nearest_of(points: Float64, away: Float64) -> tuple[float, Float64]:
    least = int(away.argmin()) if len(away) else None
    return (np.inf, np.full(3, np.nan)) if least is None else (float(away[least]), points[least])


def _nearest_by(classes: UInt8, gaps: Float64, points: Float64) -> tuple[Float64, Float64]:
    nearest, places = np.full(len(EvidenceClass), np.inf), np.full((len(EvidenceClass), 3), np.nan)
    for each in np.unique(classes):
        mine = np.flatnonzero(classes == each)
        least = mine[gaps[mine].argmin()]
        nearest[each], places[each] = max(gaps[least], 0.0), points[least]
    return nearest, places

"""Coverage of a robot's collision surface by its spheres, with proven bounds.

phi(p) = min_i |p - c_i| - r_i is the distance outside a union of balls. Each term is convex, and so largest at a
triangle's corner:

max over the triangle of phi <= min_i max_k |v_k - c_i| - r_i,

exact if one ball is nearest throughout. Triangles are halved until this bound and the largest corner phi agree.
Triangles (F, 3, 3), centers (S, 3), radii (S,), all [m] in one frame.
"""

import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.distance import cdist

from splatctrl_cli.config.fixed import COVERED_EDGE, DEFICIT_GAP
from splatctrl_cli.errors import refuse_if
from splatctrl_cli.geometry import face_normals, invert_transform, transform_points
from splatctrl_cli.records import Bool, Float64, Index, SphereSet
from splatctrl_cli.robot.link_meshes import Solid, SolidDistance
from splatctrl_cli.robot.urdf import UrdfFile

PAIRS_PER_CHUNK = 1_000_000  # of corners and spheres


@dataclass(frozen=True, kw_only=True)
class Deficit:
    """Largest distance of a surface point outside all spheres: lower <= truth <= proven [m].

    Negative if all of the surface is inside. place (3,): where `lower` is found.
    """

    proven: float
    lower: float
    place: Float64


@dataclass(frozen=True, kw_only=True)
class LinkCoverage:
    """Coverage of one link's collision surface by the spheres of its rigid body.

    area [m2]; uncovered_area [m2], with proven bounds; deficit: None without spheres; protrusion [m]: upper bound of
    a sphere's reach outside the link; worst_sphere: that sphere's index, -1 without spheres; is_closed: False if a
    hull replaced an open surface.
    """

    link: str
    num_spheres: int
    area: float
    uncovered_area: float
    uncovered_bounds: tuple[float, float]
    deficit: Deficit | None
    protrusion: float
    worst_sphere: int
    is_closed: bool

    @property
    def is_covered(self) -> bool:
        return self.deficit is not None and self.deficit.proven <= 0

    @property
    def uncovered_share(self) -> float:
        return self.uncovered_area / self.area


@dataclass(frozen=True, kw_only=True)
class CoverageReport:
    """Coverage by link; stray_spheres: number on bodies without collision geometry."""

    links: tuple[LinkCoverage, ...]
    num_spheres: int
    stray_spheres: int

    @property
    def bare_links(self) -> tuple[str, ...]:
        """Links with collision geometry but no sphere."""
        return tuple(link.link for link in self.links if link.deficit is None)

    @property
    def open_links(self) -> tuple[str, ...]:
        return tuple(link.link for link in self.links if not link.is_closed)

    @property
    def worst(self) -> LinkCoverage | None:
        """The link with the largest proven deficit; None if a link is bare."""
        return None if self.bare_links else max(self.links, key=_proven)

    @property
    def max_deficit(self) -> float | None:
        """Largest proven deficit [m], at least 0; None if a link is bare."""
        return None if self.worst is None else max(0.0, _proven(self.worst))

    @property
    def uncovered_share(self) -> float:
        return sum(link.uncovered_area for link in self.links) / sum(link.area for link in self.links)

    @property
    def max_protrusion(self) -> float:
        """Largest protrusion [m]."""
        return max(link.protrusion for link in self.links)


def coverage_of_solids(
    urdf: UrdfFile, solids: Mapping[str, Sequence[Solid]], spheres: SphereSet, *, resolution: float = COVERED_EDGE
) -> CoverageReport:
    """Measure how spheres cover the `solids` of each link of `urdf`.

    Spheres of a link's whole rigid body count. Cached. Raises InputError for a sphere on an unknown link.
    """
    bodies = urdf.rigid_bodies()
    unknown = [link for link in spheres.links if link not in bodies]
    refuse_if(
        unknown,
        f"sphere set: link '{''.join(unknown[:1])}' is not in {urdf.path}",
        remedy=f"links there: {', '.join(urdf.links)}",
    )
    return _measure_packed(pickle.dumps((bodies, dict(solids), spheres, resolution)))


@lru_cache(maxsize=32)
def _measure_packed(packed: bytes) -> CoverageReport:
    bodies, solids, spheres, resolution = pickle.loads(packed)
    leaders = {link: leader for link, (leader, _) in bodies.items()}
    measured = {leaders[link] for link in solids}
    links = []
    for link, parts in solids.items():
        member = np.array([leaders[owner] == leaders[link] for owner in spheres.links], dtype=bool)
        centers = np.array(
            [
                transform_points(invert_transform(bodies[link][1]) @ bodies[spheres.links[i]][1], spheres.centers[i])
                for i in np.flatnonzero(member)
            ]
        ).reshape(-1, 3)
        own = np.array([spheres.links[i] == link for i in np.flatnonzero(member)], dtype=bool)
        links.append(
            _measure_link(link, parts, centers, spheres.radii[member], np.flatnonzero(member), own, resolution)
        )
    return CoverageReport(
        links=tuple(links),
        num_spheres=len(spheres.radii),
        stray_spheres=sum(leaders[link] not in measured for link in spheres.links),
    )


def deficit_by_sphere(urdf: UrdfFile, spheres: SphereSet, report: CoverageReport) -> Float64:
    """Proven deficit (S,) [m] of each sphere's rigid body; 0 without geometry.

    The body's worst link counts.
    """
    leaders = {link: leader for link, (leader, _) in urdf.rigid_bodies().items()}
    worst: dict[str, float] = {}
    for link in report.links:
        if link.deficit is not None:
            worst[leaders[link.link]] = max(worst.get(leaders[link.link], 0.0), link.deficit.proven)
    return np.array([worst.get(leaders[link], 0.0) for link in spheres.links], dtype=np.float64)


def largest_deficit(
    triangles: Float64, centers: Float64, radii: Float64, *, tolerance: float = DEFICIT_GAP, floor: float = 0.0
) -> Deficit:
    """Largest phi on `triangles`, between bounds that agree to `tolerance` [m].

    Triangles with a bound below `floor` [m] are not refined.
    """
    best, place, proven = -np.inf, np.zeros(3), -np.inf
    pending = triangles
    while len(pending):
        upper, at_corners = _bounds(pending, centers, radii)
        top = np.unravel_index(int(np.argmax(at_corners)), at_corners.shape)
        if at_corners[top] > best:
            best, place = float(at_corners[top]), pending[top].copy()
        is_small = _longest_edges(pending)[0] < tolerance
        is_done = (upper <= max(floor, best + tolerance if best > floor else floor)) | is_small
        proven = max(proven, float(upper[is_done].max(initial=-np.inf)))
        pending = _halves(pending[~is_done])
    return Deficit(proven=max(proven, best), lower=best, place=place)


def uncovered_area(
    triangles: Float64, centers: Float64, radii: Float64, *, resolution: float = COVERED_EDGE
) -> tuple[float, float, float]:
    """Area [m2] with phi > 0: best guess, proven lower and upper bound.

    Triangles are halved until they are in one sphere, outside all, or at most `resolution` [m] long.
    """
    outside = unsure = guess = 0.0
    pending = triangles
    while len(pending):
        upper, _ = _bounds(pending, centers, radii)
        middle = pending.mean(axis=1)
        reach = np.linalg.norm(pending - middle[:, None], axis=2).max(axis=1)
        phi = np.concatenate([(cdist(middle[p], centers) - radii).min(axis=1) for p in _chunks(middle, len(radii))])
        area = areas(pending)
        is_in, is_out = upper <= 0, phi > reach  # 1-Lipschitz: phi > 0 all over the triangle
        is_small = ~is_in & ~is_out & (_longest_edges(pending)[0] <= resolution)
        outside += float(area[is_out].sum())
        unsure += float(area[is_small].sum())
        guess += float(area[is_small & (phi > 0)].sum())
        pending = _halves(pending[~(is_in | is_out | is_small)])
    return outside + guess, outside, outside + unsure


def areas(triangles: Float64) -> Float64:
    """Triangle areas (F,) [m2]."""
    return np.asarray(0.5 * np.linalg.norm(face_normals(triangles), axis=1))


def refine_triangles(triangles: Float64, longest: float) -> Float64:
    """Surface in triangles (F, 3, 3) with edges up to `longest` [m]."""
    parts = []
    pending = triangles
    while len(pending):
        is_small = _longest_edges(pending)[0] <= longest
        parts.append(pending[is_small])
        pending = _halves(pending[~is_small])
    return np.concatenate(parts)


def _measure_link(
    link: str,
    parts: Sequence[Solid],
    centers: Float64,
    radii: Float64,
    indices: Index,
    own: Bool,
    resolution: float,
) -> LinkCoverage:
    area = sum(float(areas(part.surface.corners).sum()) for part in parts)
    deficits = [_measure_part(part, centers, radii) for part in parts if len(radii)]
    shares = [
        uncovered_area(
            part.surface.corners[: 0 if deficit.proven <= 0 else None],
            centers,
            radii - part.slack,
            resolution=resolution,
        )
        for part, deficit in zip(parts, deficits, strict=False)
    ]
    uncovered = tuple(float(sum(column)) for column in zip(*shares, strict=True)) if shares else (area,) * 3
    sticking = SolidDistance(parts)(centers[own]) + radii[own] if own.any() else np.zeros(1)
    worst = int(np.argmax(sticking))
    return LinkCoverage(
        link=link,
        num_spheres=int(own.sum()),
        area=area,
        uncovered_area=uncovered[0],
        uncovered_bounds=(uncovered[1], uncovered[2]),
        deficit=max(deficits, key=lambda deficit: deficit.proven) if deficits else None,
        protrusion=float(sticking[worst]),
        worst_sphere=int(indices[own][worst]) if own.any() else -1,
        is_closed=all(part.surface.is_closed for part in parts),
    )


def _measure_part(part: Solid, centers: Float64, radii: Float64) -> Deficit:
    deficit = largest_deficit(part.surface.corners, centers, radii - part.slack)
    proven = deficit.proven
    if part.ball is not None:
        proven = min(proven, float(np.min(np.linalg.norm(centers - part.ball[0], axis=1) + part.ball[1] - radii)))
    return Deficit(proven=proven, lower=min(proven, deficit.lower - part.slack), place=deficit.place)


def _proven(link: LinkCoverage) -> float:
    return np.inf if link.deficit is None else link.deficit.proven


def _chunks(triangles: Float64, num_spheres: int) -> Iterator[slice]:
    step = max(1, PAIRS_PER_CHUNK // (3 * num_spheres))
    return (slice(start, start + step) for start in range(0, len(triangles), step))


def _bounds(triangles: Float64, centers: Float64, radii: Float64) -> tuple[Float64, Float64]:
    upper, at_corners = np.empty(len(triangles)), np.empty((len(triangles), 3))
    for part in _chunks(triangles, len(radii)):
        gap = (cdist(triangles[part].reshape(-1, 3), centers) - radii).reshape(-1, 3, len(radii))
        upper[part] = gap.max(axis=1).min(axis=1)
        at_corners[part] = gap.min(axis=2)
    return upper, at_corners


def _longest_edges(triangles: Float64) -> tuple[Float64, Index]:
    length = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2)
    return length.max(axis=1), length.argmax(axis=1)


def _halves(triangles: Float64) -> Float64:
    rows = np.arange(len(triangles))
    first = _longest_edges(triangles)[1] if len(triangles) else rows
    a, b, c = (triangles[rows, (first + k) % 3] for k in range(3))
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])

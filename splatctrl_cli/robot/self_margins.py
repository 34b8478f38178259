"""Distances between a robot's link surfaces, and the margins that their spheres can keep.

Spheres decide if far enough apart, else triangles, exactly (coal). T postures, J joints, S spheres, K pairs.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import coal
import numpy as np
from scipy.spatial.distance import cdist

from splatctrl_cli.config.fixed import (
    LEAST_OVERLAP,
    SELF_KEPT,
    SELF_OFTEN,
    SELF_POSTURES,
    SELF_ROUNDING,
    SELF_SHARE,
    SELF_TOLD,
    SELF_TOUCHING,
)
from splatctrl_cli.geometry import face_normals, invert_transform, transform_points
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.link_meshes import Solid, SolidDistance
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import fixtures, joined_links, random_postures

LinkNames = tuple[str, str]
Depth = Callable[[Float64], Float64]

FLAT = 1e-9  # of a solid's size: rounding of a vertex's height above a face's plane


class LinkSurface:
    """Collision surface of one link, in its frame: the triangles of its solids."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        parts = [solid.surface for solid in solids]
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
        self.vertices = np.concatenate([part.vertices for part in parts])
        self.firsts = self.vertices[starts]  # a vertex of each solid
        self.slack = max(solid.slack for solid in solids)
        faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
        self.triangles = coal.BVHModelOBBRSS()
        self.triangles.beginModel(len(faces), len(self.vertices))
        self.triangles.addVertices(self.vertices)
        self.triangles.addTriangles(faces)
        self.triangles.endModel()
        self._closed = [solid for solid in solids if solid.surface.is_closed]
        self._boxes = [(s.surface.vertices.min(axis=0), s.surface.vertices.max(axis=0)) for s in self._closed]
        self._depths: list[Depth] = []

    def depth(self, points: Float64) -> float:
        """Largest depth [m] of points (Q, 3), link frame, in closed solids; 0 outside."""
        is_near = np.zeros(len(points), dtype=np.bool_)
        for lower, upper in self._boxes:
            is_near |= np.all((points >= lower) & (points <= upper), axis=1)
        if not is_near.any():
            return 0.0
        self._depths = self._depths or [depth_in(solid) for solid in self._closed]
        return max(0.0, *(float(depth(points[is_near]).max()) for depth in self._depths))


def depth_in(solid: Solid) -> Depth:
    """A function for depths (Q,) [m] in a closed solid, negative outside.

    In a convex solid, the depth is the least below any face's plane.
    """
    corners = solid.surface.corners
    normals = face_normals(corners)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = np.einsum("fa,fa->f", normals, corners[:, 0])
    above = (solid.surface.vertices @ normals.T - heights).max()
    if solid.ball is None and above <= FLAT * np.ptp(solid.surface.vertices, axis=0).max():
        return lambda points: np.asarray((heights - points @ normals.T).min(axis=1))
    distance = SolidDistance([solid])
    return lambda points: -distance(points)


def surface_gap(a: LinkSurface, b: LinkSurface, T_a_b: Float64) -> float:
    """Gap [m] of two surfaces, b at T_a_b (4, 4); negative where they overlap.

    The gap is exact between triangles, a lower bound for round shapes. An overlap is the deepest vertex's depth, at
    least LEAST_OVERLAP.
    """
    T_a, T_b = coal.Transform3s(), coal.Transform3s(T_a_b[:3, :3], T_a_b[:3, 3])
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    gap = float(coal.distance(a.triangles, T_a, b.triangles, T_b, request, result)) - a.slack - b.slack
    T_b_a = invert_transform(T_a_b)
    if gap > 0 and a.depth(transform_points(T_a_b, b.firsts)) == b.depth(transform_points(T_b_a, a.firsts)) == 0.0:
        return gap
    in_a, in_b = a.depth(transform_points(T_a_b, b.vertices)), b.depth(transform_points(T_b_a, a.vertices))
    return -max(in_a, in_b, LEAST_OVERLAP)


class SelfSurfaces:
    """Pairs of links that may collide, judged by surfaces; without surfaces, by spheres.

    pairs (K): links that may collide, and are apart in some posture; fused: links never apart. names (K + P): of
    `pairs`, and of P pairs of spheres on bodies without geometry.
    """

    def __init__(
        self,
        model: RobotModel,
        solids: Mapping[str, Sequence[Solid]],
        disabled: Collection[frozenset[str]] = (),
        recorded: Float64 | None = None,
    ) -> None:
        """model: with coverage of these solids; recorded: logged postures (R, J)."""
        self._model, self._solids = model, solids
        self._surfaces: dict[str, LinkSurface] = {}  # built when a pair is first near
        self._leaders = leaders = {link: leader for link, (leader, _) in model.urdf.rigid_bodies().items()}
        links = model.sphere_set.links
        names, owner = np.unique([leaders[link] for link in links], return_inverse=True)
        self._body = {str(name): number for number, name in enumerate(names)}
        self._order = np.argsort(owner, kind="stable")  # of the spheres, by rigid body
        self._starts = np.searchsorted(owner[self._order], np.arange(len(names)))
        self._reach = (model.sphere_set.radii + model.sphere_deficit)[self._order]
        solid_bodies = {leaders[link] for link in solids}
        self._bare = np.array(
            [(a, b) for a, b in model.self_pairs() if not {leaders[links[a]], leaders[links[b]]} <= solid_bodies],
            dtype=np.int64,
        ).reshape(-1, 2)
        off = {*disabled, *joined_links(model, tuple(solids))}
        candidates = [(a, b) for a, b in combinations(solids, 2) if frozenset((a, b)) not in off]
        postures = random_postures(self._model, SELF_TOUCHING, seed=0)
        if recorded is not None:
            postures = np.concatenate([recorded, postures])
        bounds = self._bounds(candidates, self._model.sphere_centers_batch(postures)).max(axis=0)
        self.fused = tuple(
            pair
            for pair, bound in zip(candidates, bounds, strict=True)
            if bound <= 0 and all(self.gap(q, pair) <= 0 for q in postures)
        )
        self.pairs: tuple[LinkNames, ...] = tuple(pair for pair in candidates if pair not in self.fused)
        self.names = tuple(f"{a} and {b}" for a, b in (*self.pairs, *((links[a], links[b]) for a, b in self._bare)))

    def gaps(self, q: Float64, centers: Float64, enough: float) -> Float64:
        """Gaps (T, K + P) [m] at postures (T, J).

        centers: (T, S, 3). Links' gaps below `enough` [m] are exact; larger ones may be lower bounds.
        """
        gaps = self._bounds(self.pairs, centers)
        for state, pair in np.argwhere(gaps < enough):
            gaps[state, pair] = self.gap(q[state], self.pairs[pair])
        (a, b), radii = self._bare.T, self._model.sphere_set.radii
        bare = np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radii[a] - radii[b]
        return np.concatenate([gaps, bare], axis=1)

    def _bounds(self, pairs: Sequence[LinkNames], centers: Float64) -> Float64:
        """Gaps (T, K) [m] between rigid bodies' spheres, grown by the uncovered surface."""
        bodies = np.array([[self._body.get(self._leaders[link], -1) for link in pair] for pair in pairs])
        bounds = np.full((len(centers), len(pairs)), -np.inf)
        known = np.flatnonzero((bodies.reshape(-1, 2) >= 0).all(axis=1))
        for state, points in enumerate(centers[:, self._order] if len(known) else ()):
            gap = cdist(points, points) - self._reach[:, None] - self._reach
            least = np.minimum.reduceat(np.minimum.reduceat(gap, self._starts, axis=0), self._starts, axis=1)
            bounds[state, known] = least[bodies[known, 0], bodies[known, 1]]
        return bounds

    def number_of(self, pair: LinkNames) -> int | None:
        """Two links' index in `pairs`, in either order; None if absent."""
        return next((number for number, own in enumerate(self.pairs) if own in (pair, pair[::-1])), None)

    def gaps_of(self, pair: LinkNames, q: Float64, centers: Float64, enough: float = np.inf) -> Float64 | None:
        """Gaps (T,) [m] of one pair, as in `gaps`; None for an unknown pair."""
        if self.number_of(pair) is None:
            return None
        gaps = self._bounds([pair], centers)[:, 0]
        for state in np.flatnonzero(gaps < enough):
            gaps[state] = self.gap(q[state], pair)
        return gaps

    def gap(self, q: Float64, pair: LinkNames) -> float:
        """A pair's gap [m] at q (J,), negative where its surfaces overlap."""
        for link in pair:
            if link not in self._surfaces:
                self._surfaces[link] = LinkSurface(self._solids[link])
        a, b = (self._surfaces[link] for link in pair)
        T_world_a, T_world_b = (self._model.frame_pose(q, link) for link in pair)
        return surface_gap(a, b, invert_transform(T_world_a) @ T_world_b)


@dataclass(frozen=True, kw_only=True)
class KeptMargin:
    """Two links whose spheres have a `margin` [m] of their own.

    margin: negative if the spheres may overlap; None: the configured margin stays. apart: least gap [m] of their
    surfaces (spheres if unknown) that is not *near* (`kept_margins`). is_fixture: one link is in `fixtures`.
    surface_gap: least gap [m] of their surfaces in postures whose sphere gap reaches the margin, None if unknown.
    """

    links: tuple[str, str]
    margin: float | None
    apart: float
    surface_gap: float | None
    is_fixture: bool = False


def fixture_margins(model: RobotModel, surfaces: SelfSurfaces, margin: float) -> tuple[KeptMargin, ...]:
    """Pairs of a moving link and one of `fixtures`, which no map contains.

    Their `apart` is `margin` [m], or SELF_SHARE of their largest gap if that is less.
    """
    standing, postures = fixtures(model), random_postures(model, SELF_TOUCHING, seed=0)
    return tuple(
        KeptMargin(
            links=pair,
            margin=None,
            apart=min(margin, SELF_SHARE * max(surfaces.gap(q, pair) for q in postures)),
            surface_gap=None,
            is_fixture=True,
        )
        for pair in surfaces.pairs
        if not standing.isdisjoint(pair)
    )


def kept_margins(model: RobotModel, margin: float, surfaces: SelfSurfaces | None) -> tuple[KeptMargin, ...]:
    """Pairs whose spheres are often nearer than `margin` [m], with a lower margin.

    Often: in SELF_OFTEN of SELF_POSTURES random postures. A posture is *near* if the surfaces are nearer than the
    margin and half their largest gap. The lower margin is the sphere gap that nearly all other postures exceed. It
    rises to the largest gap of near postures, if most others exceed that. With unknown surfaces no posture is near,
    and it is at least 0.
    """
    names = model.sphere_set.links
    owners = [(names[a], names[b]) for a, b in model.self_pairs()]
    if not owners:
        return ()
    postures = random_postures(model, SELF_POSTURES, seed=0)
    centers = model.sphere_centers_batch(postures)
    margins = []
    for links in dict.fromkeys(owners):
        gap = sphere_gaps(model, links, postures)
        if np.mean(gap < margin) > SELF_OFTEN:
            surface = None if surfaces is None else surfaces.gaps_of(links, postures, centers, margin)
            if surfaces is not None and surface is not None and surface.max() < margin / SELF_SHARE:
                surface = surfaces.gaps_of(links, postures, centers)  # exact, for a share of the largest counts
            margins.append(_fit_margin(links, gap, margin, surface))
    return tuple(pair for pair in margins if pair.margin is None or pair.margin < margin)


def apply_kept_margins(model: RobotModel, margin: float, margins: Sequence[KeptMargin]) -> RobotModel:
    """Robot with self_allowance for these pairs, relative to `margin` [m]."""
    less = {frozenset(pair.links): margin - pair.margin for pair in margins if pair.margin is not None}
    names = model.sphere_set.links
    allowance = [less.get(frozenset((names[a], names[b])), 0.0) for a, b in model.self_pairs()]
    return model.replace_self_allowance(np.array(allowance, dtype=np.float64))


def least_gap(model: RobotModel, surfaces: SelfSurfaces | None, pair: KeptMargin, postures: Float64) -> float:
    """A pair's least gap [m] at postures (T, J), exact below `pair.apart`."""
    gaps = (
        None
        if surfaces is None
        else surfaces.gaps_of(pair.links, postures, model.sphere_centers_batch(postures), pair.apart)
    )
    return float((sphere_gaps(model, pair.links, postures) if gaps is None else gaps).min())


def sphere_gaps(model: RobotModel, links: tuple[str, str], postures: Float64) -> Float64:
    """Least sphere gap (T,) [m] of two links' `self_pairs` at postures (T, J)."""
    names, radii, centers = model.sphere_set.links, model.sphere_set.radii, model.sphere_centers_batch(postures)
    a, b = np.array([(a, b) for a, b in model.self_pairs() if (names[a], names[b]) == links], dtype=np.int64).T
    gaps = np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radii[a] - radii[b]
    return np.asarray(gaps.min(axis=1))


def _fit_margin(links: tuple[str, str], gap: Float64, margin: float, surface: Float64 | None) -> KeptMargin:
    apart = min(margin, SELF_SHARE * float((gap if surface is None else surface).max()))
    if surface is None:
        least = min(margin, float(np.quantile(gap, SELF_KEPT)))
        return KeptMargin(
            links=links, margin=max(least, 0.0) if gap.max() > 0 else None, apart=apart, surface_gap=None
        )
    is_near = surface < apart
    least = min(margin, float(np.quantile(gap[~is_near], SELF_KEPT)))
    excluding = float(gap[is_near].max(initial=-np.inf)) + SELF_ROUNDING
    if np.mean(gap[~is_near] >= excluding) >= SELF_TOLD:
        least = min(margin, max(least, excluding))
    return KeptMargin(links=links, margin=least, apart=apart, surface_gap=float(surface[gap >= least].min()))

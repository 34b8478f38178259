"""The exact distance to a triangle mesh, in float64."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from defusedxml import ElementTree
from scipy.spatial import cKDTree

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import face_normals
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Bool, Float64, Index

POINTS_PER_CHUNK = 20_000
PAIRS_PER_CHUNK = 400_000  # of the (pairs x 3) float64 arrays
ROUNDING = 1e-9  # [m] of the distance to a disc, generously: only what is certainly farther is left out
NEXT, OPPOSITE = np.array([1, 2, 0]), np.array([2, 0, 1])


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """vertices (V, 3) float64 [m]; faces (F, 3) int64, counter-clockwise seen from outside.

    is_closed: every edge has two faces that run through it in opposite directions, so that there is an inside.
    """

    vertices: Float64
    faces: Index
    is_closed: bool

    @property
    def corners(self) -> Float64:
        """(F, 3, 3): the three corners of each face."""
        return self.vertices[self.faces]

    def scaled_to(self, extent: float) -> "TriangleMesh":
        """The mesh about the middle of its box, with `extent` [m] as the longest side of that box."""
        lower, upper = self.vertices.min(axis=0), self.vertices.max(axis=0)
        vertices = (self.vertices - 0.5 * (lower + upper)) * (extent / float((upper - lower).max()))
        return TriangleMesh(vertices=vertices, faces=self.faces, is_closed=self.is_closed)


def load_mesh(path: Path) -> TriangleMesh:
    """The mesh in a file that trimesh reads (OBJ, STL, PLY, OFF, GLB, COLLADA), all its parts as one.

    Vertices at the same place become one, whatever their texture and normal: a seam of a texture is not a hole.
    COLLADA is scaled by the file's unit; its up axis is ignored, as RViz does.
    Raises InputError where the file cannot be read, or holds no triangle or a coordinate that is not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a mesh, got no such file")
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
        scale = _collada_unit(path) if path.suffix.lower() == ".dae" else 1.0
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        raise InputError(
            f"{path}: expected a mesh, got {type(error).__name__}: {error}",
            remedy="give an OBJ, STL, PLY, GLB or COLLADA file",
        ) from None
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(f"{path}: expected a mesh, got no triangle", remedy="give a mesh with faces, not a cloud")
    if not np.isfinite(loaded.vertices).all():
        raise InputError(f"{path}: expected finite vertices, got some that are not")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    loaded.update_faces(loaded.nondegenerate_faces())
    return TriangleMesh(
        vertices=scale * np.array(loaded.vertices, dtype=np.float64),
        faces=np.array(loaded.faces, dtype=np.int64),
        is_closed=bool(loaded.is_watertight and loaded.is_winding_consistent),
    )


def _collada_unit(path: Path) -> float:
    """Metres in a unit of a COLLADA file."""
    unit = ElementTree.parse(path).find("{*}asset/{*}unit")
    return 1.0 if unit is None else float(unit.get("meter", "1"))


class MeshDistance:
    """Exact distance from points to a mesh: every face that may be the nearest is tried.

    Faces go into a k-d tree by their centroids c_f, one tree per octave of size R_f (the largest distance of a corner
    from the centroid), because a face lies within R_f of c_f: where a face is known at distance u, only faces with
    ``|x - c_f| <= u + R_f`` can be nearer, and of those only the ones whose disc about c_f reaches as near as u.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        corners = mesh.corners
        self._centroids = corners.mean(axis=1)
        self._reach = np.linalg.norm(corners - self._centroids[:, None], axis=2).max(axis=1)
        octave = np.floor(np.log2(np.maximum(self._reach, 1e-12))).astype(np.int64)
        self._groups = [np.flatnonzero(octave == value) for value in np.unique(octave)]
        self._trees = [cKDTree(self._centroids[group]) for group in self._groups]
        self._normals = _Normals(mesh)

    def closest(self, points: Float64) -> tuple[Float64, Float64, Bool]:
        """points (Q, 3) [m] -> distance (Q,) [m], the nearest surface point (Q, 3), is_inside (Q,).

        Inside by the angle-weighted normal of the nearest face, edge or vertex (Baerentzen, Aanaes, Signed distance
        computation using the angle weighted pseudonormal, 2005), exact for a closed mesh; all False for an open one.
        """
        distance = np.empty(len(points))
        surface = np.empty((len(points), 3))
        is_inside = np.zeros(len(points), dtype=np.bool_)
        for start in range(0, len(points), POINTS_PER_CHUNK):
            part = slice(start, start + POINTS_PER_CHUNK)
            face, shares = self._nearest(points[part])
            surface[part] = np.einsum("qk,qka->qa", shares, self.mesh.corners[face])
            away = points[part] - surface[part]
            distance[part] = np.linalg.norm(away, axis=1)
            if self.mesh.is_closed:
                is_inside[part] = np.einsum("qa,qa->q", away, self._normals.at(face, shares)) < 0
        return distance, surface, is_inside

    def lower_bound(self, points: Float64) -> Float64:
        """points (Q, 3) [m] -> a length (Q,) [m] that the distance is not below; much faster than the distance."""
        bound = np.full(len(points), np.inf)
        for group, tree in zip(self._groups, self._trees, strict=True):
            bound = np.minimum(bound, tree.query(points)[0] - self._reach[group].max())
        return bound

    def signed(self, points: Float64) -> Float64:
        """points (Q, 3) [m] -> distance (Q,) [m], negative inside a closed mesh."""
        distance, _, is_inside = self.closest(points)
        return np.where(is_inside, -distance, distance)

    def _nearest(self, points: Float64) -> tuple[Index, Float64]:
        """The nearest face (Q,) and the barycentric coordinates (Q, 3) of the nearest point on it."""
        best = np.full(len(points), np.inf)
        face = np.zeros(len(points), dtype=np.int64)
        shares = np.zeros((len(points), 3))
        everyone = np.arange(len(points))
        for group, tree in zip(self._groups, self._trees, strict=True):
            self._improve(points, everyone, group[tree.query(points)[1]], best, face, shares)
        for group, tree in zip(self._groups, self._trees, strict=True):
            for asking, asked in _within(tree, points, best + self._reach[group].max()):
                found = group[asked]
                may_be = self._disc_distance(points[asking], found) <= best[asking] + ROUNDING
                self._improve(points, asking[may_be], found[may_be], best, face, shares)
        return face, shares

    def _disc_distance(self, points: Float64, faces: Index) -> Float64:
        """Distance (P,) to the disc of radius R_f about c_f in the plane of a face, which holds the face."""
        away = points - self._centroids[faces]
        height = _dot(away, self._normals.of_face[faces])
        aside = np.sqrt(np.maximum(_dot(away, away) - height**2, 0.0))
        return np.asarray(np.hypot(height, np.maximum(aside - self._reach[faces], 0.0)))

    def _improve(
        self, points: Float64, asking: Index, faces: Index, best: Float64, face: Index, shares: Float64
    ) -> None:
        """Take each pair (point, face) that is nearer than the best so far; of equals, the first."""
        pair_shares = barycentric_of_closest(points[asking], self.mesh.corners[faces])
        at = np.einsum("pk,pka->pa", pair_shares, self.mesh.corners[faces])
        distance = np.linalg.norm(points[asking] - at, axis=1)
        order = np.lexsort((distance, asking))
        first = order[np.r_[True, np.diff(asking[order]) > 0]] if len(order) else order
        taken = first[distance[first] < best[asking[first]]]
        best[asking[taken]] = distance[taken]
        face[asking[taken]] = faces[taken]
        shares[asking[taken]] = pair_shares[taken]


def _within(tree: cKDTree, points: Float64, radius: Float64) -> Iterator[tuple[Index, Index]]:
    """Pairs (point, entry of the tree) not further apart than the point's radius, a manageable number at a time."""
    counts = np.asarray(tree.query_ball_point(points, radius, return_length=True))
    before = np.cumsum(counts) - counts
    for part in np.split(np.arange(len(points)), np.flatnonzero(np.diff(before // PAIRS_PER_CHUNK)) + 1):
        lists = tree.query_ball_point(points[part], radius[part])
        asked = np.fromiter(chain.from_iterable(lists), dtype=np.int64, count=int(counts[part].sum()))
        yield np.repeat(part, counts[part]), asked


def barycentric_of_closest(points: Float64, corners: Float64) -> Float64:
    """Barycentric coordinates (P, 3) of the point of a triangle (P, 3, 3) nearest to a point (P, 3).

    The cases of Ericson, Real-Time Collision Detection (2005), 5.1.5; a coordinate is exactly zero off a corner or
    an edge.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    zero, one = np.zeros(len(points)), np.ones(len(points))
    with np.errstate(divide="ignore", invalid="ignore"):
        on_ab, on_ac = d1 / (d1 - d3), d2 / (d2 - d6)
        on_bc = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        total = va + vb + vc
        cases: list[tuple[Bool, tuple[Float64, Float64, Float64]]] = [
            ((d1 <= 0) & (d2 <= 0), (one, zero, zero)),
            ((d3 >= 0) & (d4 <= d3), (zero, one, zero)),
            ((d6 >= 0) & (d5 <= d6), (zero, zero, one)),
            ((vc <= 0) & (d1 >= 0) & (d3 <= 0), (1 - on_ab, on_ab, zero)),
            ((vb <= 0) & (d2 >= 0) & (d6 <= 0), (1 - on_ac, zero, on_ac)),
            ((va <= 0) & (d4 >= d3) & (d5 >= d6), (zero, 1 - on_bc, on_bc)),
        ]
        inner = (va / total, vb / total, vc / total)
    conditions = [condition for condition, _ in cases]
    return np.stack([np.select(conditions, [v[k] for _, v in cases], inner[k]) for k in range(3)], axis=1)


class _Normals:
    """Normals of faces, edges and vertices, the last two weighted by angle."""

    def __init__(self, mesh: TriangleMesh) -> None:
        corners, faces = mesh.corners, mesh.faces
        cross = face_normals(corners)
        self.of_face = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
        self._faces = faces
        self._of_vertex = np.zeros_like(mesh.vertices)
        for k in range(3):
            u, v = corners[:, NEXT[k]] - corners[:, k], corners[:, OPPOSITE[k]] - corners[:, k]
            angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), _dot(u, v))
            np.add.at(self._of_vertex, faces[:, k], angle[:, None] * self.of_face)
        ends = np.sort(np.stack([faces, faces[:, NEXT]], axis=2).reshape(-1, 2), axis=1)
        _, edge = np.unique(ends, axis=0, return_inverse=True)
        self._edge = edge.reshape(-1, 3)  # (F, 3): edge k runs from corner k to the next
        self._of_edge = np.zeros((int(edge.max()) + 1, 3))
        np.add.at(self._of_edge, self._edge.reshape(-1), np.repeat(self.of_face, 3, axis=0))

    def at(self, face: Index, shares: Float64) -> Float64:
        """Outward directions (Q, 3), not normalised, where a point of a face has these barycentric coordinates."""
        normal = np.asarray(self.of_face[face])
        num_zero = np.count_nonzero(shares == 0, axis=1)
        for k in range(3):
            on_edge = np.flatnonzero((num_zero == 1) & (shares[:, OPPOSITE[k]] == 0))
            normal[on_edge] = self._of_edge[self._edge[face[on_edge], k]]
            at_vertex = np.flatnonzero((num_zero == 2) & (shares[:, k] != 0))
            normal[at_vertex] = self._of_vertex[self._faces[face[at_vertex], k]]
        return normal


def _dot(a: Float64, b: Float64) -> Float64:
    return np.asarray(np.einsum("pa,pa->p", a, b))

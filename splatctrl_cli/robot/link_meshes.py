"""Collision geometry of links as closed triangle surfaces, and exact distance to them, in float64."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from splatctrl_cli.config.fixed import CYLINDER_SIDES, SPHERE_ROUNDS
from splatctrl_cli.errors import InputError, refuse_if, require
from splatctrl_cli.formats.mesh import TriangleMesh, load_mesh
from splatctrl_cli.geometry import face_normals, transform_points
from splatctrl_cli.kernels.surface_image import TriangleTree
from splatctrl_cli.records import Bool, Float64, Index
from splatctrl_cli.robot.urdf import MeshShape, Shape, UrdfFile

NEXT, OPPOSITE = np.array([1, 2, 0]), np.array([2, 0, 1])


class MeshDistance:
    """Exact distances [m] of points (Q, 3) [m] to a mesh."""

    def __init__(self, mesh: TriangleMesh) -> None:
        corners, faces = mesh.corners, mesh.faces
        self.mesh, self._tree = mesh, TriangleTree(corners)
        cross = face_normals(corners)
        self._of_face = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
        self._of_vertex = np.zeros_like(mesh.vertices)
        for k in range(3):
            u, v = corners[:, NEXT[k]] - corners[:, k], corners[:, OPPOSITE[k]] - corners[:, k]
            angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("pa,pa->p", u, v))
            np.add.at(self._of_vertex, faces[:, k], angle[:, None] * self._of_face)
        ends = np.sort(np.stack([faces, faces[:, NEXT]], axis=2).reshape(-1, 2), axis=1)
        _, edge = np.unique(ends, axis=0, return_inverse=True)
        self._edge = edge.reshape(-1, 3)  # (F, 3): edge k runs from corner k to the next
        self._of_edge = np.zeros((int(edge.max()) + 1, 3))
        np.add.at(self._of_edge, self._edge.reshape(-1), np.repeat(self._of_face, 3, axis=0))

    def closest(self, points: Float64) -> tuple[Float64, Float64, Bool]:
        """Distance (Q,), nearest surface point (Q, 3) and is_inside (Q,).

        The angle-weighted normal of the nearest face, edge or vertex decides is_inside, exactly for a closed mesh
        (Baerentzen, Aanaes, Signed distance computation using the angle weighted pseudonormal, 2005). For an open
        mesh it is False.
        """
        distance, face, shares = self._tree.closest(points)
        surface = np.einsum("qk,qka->qa", shares, self.mesh.corners[face])
        if not self.mesh.is_closed:
            return distance, surface, np.zeros(len(points), dtype=np.bool_)
        return distance, surface, np.einsum("qa,qa->q", points - surface, self._normals(face, shares)) < 0

    def distance(self, points: Float64, within: float = np.inf) -> Float64:
        """Distances (Q,), infinite beyond `within`."""
        return self._tree.closest(points, within)[0]

    def signed(self, points: Float64) -> Float64:
        """Distances (Q,), negative inside a closed mesh."""
        distance, _, is_inside = self.closest(points)
        return np.where(is_inside, -distance, distance)

    def _normals(self, face: Index, shares: Float64) -> Float64:
        normal = np.asarray(self._of_face[face])
        num_zero = np.count_nonzero(shares == 0, axis=1)
        for k in range(3):
            on_edge = np.flatnonzero((num_zero == 1) & (shares[:, OPPOSITE[k]] == 0))
            normal[on_edge] = self._of_edge[self._edge[face[on_edge], k]]
            at_vertex = np.flatnonzero((num_zero == 2) & (shares[:, k] != 0))
            normal[at_vertex] = self._of_vertex[self.mesh.faces[face[at_vertex], k]]
        return normal


MESH_LENGTHS = (0.001, 10.0)  # [m] of a link's mesh; any other length means another unit
LINK_LENGTHS = (0.01, 3.0)  # [m] of a link in the right unit
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "metres": 1.0}


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A piece of a link's collision geometry, in the frame of `link` [m].

    slack: largest distance of `surface` from the true one. body: closed mesh for inside tests, or an open surface's
    convex hull, None if flat. ball: centre (3,), radius.
    """

    link: str
    surface: TriangleMesh
    slack: float
    body: TriangleMesh | None
    ball: tuple[Float64, float] | None = None


def read_solids(urdf: UrdfFile, folders: Sequence[Path] = ()) -> dict[str, tuple[Solid, ...]]:
    """Read each link's solids, in the file's order.

    folders: for ``package://``, tried before those above the URDF. Raises InputError for an unreadable mesh, an
    unknown shape, or no collision geometry.
    """
    if urdf.other_shapes:
        link, tag = urdf.other_shapes[0]
        raise InputError(
            f"{urdf.path}: link '{link}': expected mesh, box, cylinder, capsule or sphere, got <{tag}>",
            remedy="write it as a cylinder and spheres",
        )
    by_link: dict[str, list[Solid]] = {link: [] for link in urdf.collision_links}
    refuse_if(
        not by_link,
        f"{urdf.path}: expected collision geometry, got none",
        remedy="give a URDF with <collision> elements",
    )
    for shape in urdf.shapes:
        by_link[shape.link].append(_primitive(shape))
    load = cache(load_mesh)
    for mesh in urdf.meshes:
        whole = place_mesh(mesh, load(mesh_path(urdf.path, mesh, folders)))
        pieces = [whole] if whole.is_closed else _taken_apart(whole)
        by_link[mesh.link] += [
            Solid(link=mesh.link, surface=piece, slack=0.0, body=piece if piece.is_closed else _hull(piece.vertices))
            for piece in pieces
        ]
    return {link: tuple(solids) for link, solids in by_link.items()}


def mesh_path(urdf: Path, mesh: MeshShape, folders: Iterable[Path] = ()) -> Path:
    """A mesh's file.

    ``package://NAME/REST`` is NAME/REST, or REST in a folder NAME, among `folders` and folders above the URDF. A path
    without scheme is relative to the URDF. Raises InputError if not found.
    """
    name = mesh.filename
    above = [Path(urdf).resolve().parent, *Path(urdf).resolve().parent.parents]
    if name.startswith("package://"):
        parts = Path(name.removeprefix("package://")).parts
        refuse_if(
            ".." in parts or name.startswith("package:///"),
            f"{urdf}: link '{mesh.link}': mesh {name} lies outside its package",
            remedy="correct the path",
        )
        roots = [*folders, *above]
        tried = [root.joinpath(*parts) for root in roots]
        tried += [root.joinpath(*parts[1:]) for root in roots if parts and root.name == parts[0]]
    else:
        tried = [Path(name.removeprefix("file://")) if name.startswith("file://") else above[0] / name]
    return require(
        next(filter(Path.is_file, tried), None),
        f"{urdf}: link '{mesh.link}': mesh {name} was not found",
        remedy="give the folder that holds its package with --packages DIR"
        if name.startswith("package://")
        else f"expected {tried[0]}",
    )


class SolidDistance:
    """Upper bound on the signed distance (Q,) [m] of points (Q, 3), link frame, to solids.

    It is exact outside, inside no deeper than the truth, and unsigned for an open, flat surface.
    """

    def __init__(self, solids: Sequence[Solid]) -> None:
        meshes = [solid for solid in solids if solid.ball is None]
        self._meshes = [MeshDistance(solid.surface if solid.body is None else solid.body) for solid in meshes]
        self._balls = [solid.ball for solid in solids if solid.ball is not None]

    def __call__(self, points: Float64) -> Float64:
        to_meshes = [mesh.signed(points) for mesh in self._meshes]
        to_balls = [np.linalg.norm(points - center, axis=1) - radius for center, radius in self._balls]
        return np.asarray(np.min([*to_meshes, *to_balls], axis=0))


def _primitive(shape: Shape) -> Solid:
    if shape.kind == "box":
        vertices, faces, slack = *_box(np.array(shape.size)), 0.0
    elif shape.kind == "cylinder":
        vertices, faces = _prism(*shape.size)
        slack = shape.size[0] * (1 - np.cos(np.pi / CYLINDER_SIDES))
    else:
        corners, faces, gap = _unit_ball()
        vertices, slack = shape.size[0] * corners, shape.size[0] * gap + 1e-12
    mesh = TriangleMesh(vertices=transform_points(shape.T_link_shape, vertices), faces=faces, is_closed=True)
    return Solid(
        link=shape.link,
        surface=mesh,
        slack=float(slack),
        body=mesh,
        ball=(shape.T_link_shape[:3, 3].copy(), shape.size[0]) if shape.kind == "sphere" else None,
    )


def place_mesh(shape: MeshShape, mesh: TriangleMesh) -> TriangleMesh:
    """Mesh in the link's frame. Raises InputError for an implausible length (another unit)."""
    vertices = transform_points(shape.T_link_mesh, mesh.vertices * np.array(shape.scale))
    length = float(np.ptp(vertices, axis=0).max())
    raw, signs = length / float(np.abs(shape.scale).max()), np.sign(shape.scale)
    words = [
        f'{name}: scale="{" ".join(f"{unit * sign:g}" for sign in signs)}"'
        for name, unit in UNITS.items()
        if LINK_LENGTHS[0] <= raw * unit < LINK_LENGTHS[1]
    ]
    refuse_if(
        not MESH_LENGTHS[0] <= length <= MESH_LENGTHS[1],
        f"link '{shape.link}': mesh {shape.filename}: expected a length of 1 mm to 10 m, got {length:g} m",
        remedy=f"looks like {', or '.join(words)}" if words else "correct its scale",
    )
    return replace(
        mesh,
        vertices=vertices,
        faces=np.ascontiguousarray(mesh.faces if np.prod(shape.scale) > 0 else mesh.faces[:, ::-1]),
    )


def _taken_apart(mesh: TriangleMesh) -> Iterator[TriangleMesh]:
    size = len(mesh.vertices)
    ends = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    _, label = connected_components(coo_matrix((np.ones(len(ends[0])), ends), shape=(size, size)), directed=False)
    of_face = label[mesh.faces[:, 0]]
    closed = [value for value in np.unique(of_face) if _is_closed(mesh.faces[of_face == value])]
    parts = [of_face == value for value in closed]
    is_open = ~np.isin(of_face, closed)
    for part in [*parts, *([is_open] if is_open.any() else [])]:
        used, inverse = np.unique(mesh.faces[part], return_inverse=True)
        local = inverse.reshape(-1, 3).astype(np.int64)
        yield replace(mesh, vertices=mesh.vertices[used], faces=local, is_closed=_is_closed(local))


def _is_closed(faces: Index) -> bool:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth = np.unique(edges, axis=0)
    return len(forth) == len(edges) and np.array_equal(forth, np.unique(edges[:, ::-1], axis=0))


def _hull(vertices: Float64) -> TriangleMesh | None:
    try:
        hull = ConvexHull(vertices)
    except QhullError:
        return None
    faces = hull.simplices.astype(np.int64)
    is_inward = np.einsum("fa,fa->f", face_normals(vertices[faces]), hull.equations[:, :3]) < 0
    faces[is_inward] = faces[is_inward][:, ::-1]
    return TriangleMesh(vertices=vertices, faces=faces, is_closed=True)


def _box(size: Float64) -> tuple[Float64, Index]:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners, np.array([face for a, b, c, d in quads for face in ([a, b, c], [a, c, d])], dtype=np.int64)


def _prism(radius: float, length: float) -> tuple[Float64, Index]:
    angle = 2 * np.pi * np.arange(CYLINDER_SIDES) / CYLINDER_SIDES
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(CYLINDER_SIDES)], axis=1)
    up = np.array([0.0, 0.0, length / 2])
    vertices = np.concatenate([ring - up, ring + up, [-up, up]])
    i = np.arange(CYLINDER_SIDES)
    j = (i + 1) % CYLINDER_SIDES
    low, high = np.full(CYLINDER_SIDES, 2 * CYLINDER_SIDES), np.full(CYLINDER_SIDES, 2 * CYLINDER_SIDES + 1)
    faces = np.concatenate(
        [
            np.stack([i, j, j + CYLINDER_SIDES], axis=1),
            np.stack([i, j + CYLINDER_SIDES, i + CYLINDER_SIDES], axis=1),
            np.stack([low, j, i], axis=1),
            np.stack([high, i + CYLINDER_SIDES, j + CYLINDER_SIDES], axis=1),
        ]
    )
    return vertices, faces.astype(np.int64)


@cache
def _unit_ball() -> tuple[Float64, Index, float]:
    """A polyhedron inside the unit sphere, and the sphere's largest distance from it."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = axes[np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])]
    for _ in range(SPHERE_ROUNDS):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=1, keepdims=True) for p, q in ((a, b), (b, c), (c, a)))
        corners = np.concatenate(
            [np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    normal = face_normals(corners)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("fa,fa->f", normal, corners[:, 0])  # of each face's plane above the centre
    vertices, inverse = np.unique(corners.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    return vertices, inverse.reshape(-1, 3).astype(np.int64), float(1 - height.min())

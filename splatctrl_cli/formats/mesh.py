"""The exact distance to a triangle mesh, in float64."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from defusedxml import ElementTree

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import face_normals
from splatctrl_cli.kernels.triangles import TriangleTree
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Bool, Float64, Index

STL_HEADER, STL_FACE = 84, 50  # bytes; the header ends with the number of faces
NEXT, OPPOSITE = np.array([1, 2, 0]), np.array([2, 0, 1])


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """vertices (V, 3) float64 [m]; faces (F, 3) int64, counter-clockwise seen from outside.

    is_closed: every edge has two faces that run through it in opposite directions, so that there is an inside.
    note: what of its file was ignored, in words.
    """

    vertices: Float64
    faces: Index
    is_closed: bool
    note: str = ""

    @property
    def corners(self) -> Float64:
        """(F, 3, 3): the three corners of each face."""
        return self.vertices[self.faces]


def load_mesh(path: Path) -> TriangleMesh:
    """The mesh in a file that trimesh reads (OBJ, STL, PLY, OFF, GLB, COLLADA), all its parts as one.

    Vertices at the same place become one, whatever their texture and normal: a seam of a texture is not a hole.
    COLLADA is scaled by the file's unit; its up axis is ignored, as RViz does. What follows the faces of a binary STL
    is ignored, with a note.
    Raises InputError where the file cannot be read, or holds no triangle or a coordinate that is not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a mesh, got no such file")
    kind = path.suffix.lower()
    source, note = _opened(path) if kind in {".stl", ".obj", ".off"} else (path, "")
    try:
        loaded = trimesh.load(source, file_type=kind[1:], force="mesh", process=False)
        scale = _collada_unit(path) if kind == ".dae" else 1.0
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
        note=note,
    )


def _opened(path: Path) -> tuple[BytesIO | Path, str]:
    """A binary STL less what follows its faces, whatever its header begins with, and how much that is; a text, other
    than in UTF-8 without the letters that are not.
    """
    content = path.read_bytes()
    num = int.from_bytes(content[STL_HEADER - 4 : STL_HEADER], "little")
    end = STL_HEADER + STL_FACE * num  # of a text: gigabytes
    if path.suffix.lower() == ".stl" and len(content) >= STL_HEADER:
        if end <= len(content):
            rest = len(content) - end
            words = f"{path.name}: {rest} bytes after its {num} faces are ignored" if rest else ""
            return BytesIO(content[:end]), words
        if b"facet" not in content.lower():
            raise InputError(
                f"{path}: expected {end} bytes for {num} faces, got {len(content)}",
                remedy="copy or write the file again",
            )
    try:
        content.decode()
    except UnicodeDecodeError:
        return BytesIO(content.decode("utf-8", "replace").encode()), ""
    return path, ""


def _collada_unit(path: Path) -> float:
    """Metres in a unit of a COLLADA file."""
    unit = ElementTree.parse(path).find("{*}asset/{*}unit")
    return 1.0 if unit is None else float(unit.get("meter", "1"))


class MeshDistance:
    """Exact distance from points to a mesh."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self._tree = TriangleTree(mesh.corners)
        self._normals = _Normals(mesh)

    def closest(self, points: Float64) -> tuple[Float64, Float64, Bool]:
        """points (Q, 3) [m] -> distance (Q,) [m], the nearest surface point (Q, 3), is_inside (Q,).

        Inside by the angle-weighted normal of the nearest face, edge or vertex (Baerentzen, Aanaes, Signed distance
        computation using the angle weighted pseudonormal, 2005), exact for a closed mesh; all False for an open one.
        """
        distance, face, shares = self._tree.closest(points)
        surface = np.einsum("qk,qka->qa", shares, self.mesh.corners[face])
        is_inside = np.zeros(len(points), dtype=np.bool_)
        if self.mesh.is_closed:
            is_inside = np.einsum("qa,qa->q", points - surface, self._normals.at(face, shares)) < 0
        return distance, surface, is_inside

    def distance(self, points: Float64, within: float = np.inf) -> Float64:
        """points (Q, 3) [m] -> distance (Q,) [m], infinite where it is more than `within` [m]."""
        return self._tree.closest(points, within)[0]

    def signed(self, points: Float64) -> Float64:
        """points (Q, 3) [m] -> distance (Q,) [m], negative inside a closed mesh."""
        distance, _, is_inside = self.closest(points)
        return np.where(is_inside, -distance, distance)


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
            angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("pa,pa->p", u, v))
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

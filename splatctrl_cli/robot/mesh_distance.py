"""Exact distance to a triangle mesh, in float64."""

import numpy as np

from splatctrl_cli.formats.mesh import TriangleMesh
from splatctrl_cli.geometry import face_normals
from splatctrl_cli.kernels.triangles import TriangleTree
from splatctrl_cli.records import Bool, Float64, Index

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
        """Return distance (Q,), nearest surface point (Q, 3) and is_inside (Q,).

        Inside by the angle-weighted normal of the nearest face, edge or vertex (Baerentzen, Aanaes, Signed distance
        computation using the angle weighted pseudonormal, 2005), exact for a closed mesh; all False for an open one.
        """
        distance, face, shares = self._tree.closest(points)
        surface = np.einsum("qk,qka->qa", shares, self.mesh.corners[face])
        is_inside = np.zeros(len(points), dtype=np.bool_)
        if self.mesh.is_closed:
            is_inside = np.einsum("qa,qa->q", points - surface, self._normals(face, shares)) < 0
        return distance, surface, is_inside

    def distance(self, points: Float64, within: float = np.inf) -> Float64:
        """Return distances (Q,), infinite beyond `within`."""
        return self._tree.closest(points, within)[0]

    def signed(self, points: Float64) -> Float64:
        """Return distances (Q,), negative inside a closed mesh."""
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

"""Evenly spaced samples of a surface, and the largest balls that touch them from inside."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.held_out_depth import draw_on
from splatctrl_cli.formats.mesh import TriangleMesh
from splatctrl_cli.geometry import face_normals
from splatctrl_cli.records import Float64, Index

CANDIDATES = 24  # per square of one spacing: what is left between samples then has little room for another
SHRINKS = 30  # of an inscribed ball; each reaches further into the corner, and a few do


@dataclass(frozen=True, kw_only=True)
class SurfaceSamples:
    """points (N, 3) [m] on a surface and its outward unit normals (N, 3) there."""

    points: Float64
    normals: Float64

    def __len__(self) -> int:
        return len(self.points)


def sample_mesh(mesh: TriangleMesh, spacing: float, *, seed: int) -> SurfaceSamples:
    """Samples of a mesh, no two nearer than `spacing` [m]: candidates uniform by area, thinned (`thin`).

    Raises UsageError for a spacing that is not above 0.
    """
    check_spacing(spacing)
    cross = face_normals(mesh.corners)
    doubled = np.linalg.norm(cross, axis=1)
    num = int(np.ceil(CANDIDATES * 0.5 * doubled.sum() / spacing**2)) + 1
    points, face = draw_on(mesh, num, np.random.default_rng(seed))
    kept = thin(points, spacing)
    return SurfaceSamples(points=points[kept], normals=cross[face[kept]] / doubled[face[kept], None])


def check_spacing(spacing: float) -> None:
    """Raises UsageError for a spacing that is not above 0."""
    if not (np.isfinite(spacing) and spacing > 0):
        raise UsageError(f"spacing: expected a distance above 0 m, got {spacing}")


def thin(points: Float64, spacing: float) -> Index:
    """Indices of points (N, 3) that are pairwise at least `spacing` [m] apart; each omitted point is nearer to one of
    these.

    Points are taken in their order: random points give a Poisson-disk sample.
    """
    tree = cKDTree(points)
    is_free = np.ones(len(points), dtype=np.bool_)
    kept = []
    for i in range(len(points)):
        if is_free[i]:
            kept.append(i)
            is_free[tree.query_ball_point(points[i], spacing)] = False
    return np.array(kept, dtype=np.int64)


def inscribed_radii(
    samples: SurfaceSamples, largest: float, nearest_surface: Callable[[Float64], Float64], *, tolerance: float = 2e-4
) -> Float64:
    """Radii (N,) [m] of balls inside the surface that touch it at the samples: at most `largest`, else the largest
    that fits.

    The centres are ``p - r n``. A ball with a surface point q deeper inside than `tolerance` [m] shrinks to
    ``|p - q|^2 / (2 n . (p - q))``, the one through p and q (shrinking ball: Ma, Bae, Choi, 3D medial axis point
    approximation using nearest neighbors and the normal field, 2012). nearest_surface: (Q, 3) -> (Q, 3). The
    tolerance keeps the edges between the facets of a smooth shape from reading as corners.
    """
    radii = np.full(len(samples), float(largest))
    active = np.arange(len(samples))
    for _ in range(SHRINKS):
        p, n = samples.points[active], samples.normals[active]
        centers = p - radii[active, None] * n
        q = nearest_surface(centers)
        pokes_out = np.linalg.norm(centers - q, axis=1) < radii[active] - tolerance
        active, p, n, q = active[pokes_out], p[pokes_out], n[pokes_out], q[pokes_out]
        if not len(active):
            break
        through = np.einsum("na,na->n", p - q, p - q) / (2 * np.einsum("na,na->n", n, p - q))
        radii[active] = np.minimum(through, radii[active])
    return radii

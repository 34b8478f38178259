"""Distances to triangles and winding numbers, one at a time, in float64."""

import numpy as np

from splatctrl_cli.records import Bool, Float64


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


def distance_to_triangles(points: Float64, corners: Float64) -> Float64:
    """(Q,) [m] of points (Q, 3), every triangle (F, 3, 3) tried."""
    distances = []
    for point in points:
        shares = barycentric_of_closest(np.broadcast_to(point, (len(corners), 3)), corners)
        distances.append(np.linalg.norm(np.einsum("fk,fka->fa", shares, corners) - point, axis=1).min())
    return np.array(distances)


def winding_number(points: Float64, corners: Float64) -> Float64:
    """Solid angles of all faces over 4 pi: 1 inside, 0 outside (van Oosterom and Strackee's formula)."""
    numbers = []
    for point in points:
        a, b, c = (corners[:, k] - point for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        triple = np.einsum("fa,fa->f", a, np.cross(b, c))
        rest = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        numbers.append(2 * np.arctan2(triple, rest).sum() / (4 * np.pi))
    return np.array(numbers)


def _dot(a: Float64, b: Float64) -> Float64:
    return np.asarray(np.einsum("pa,pa->p", a, b))

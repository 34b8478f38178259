"""The distance of two triangle surfaces, face by face and edge by edge."""

from itertools import product

import numpy as np

from splatctrl_cli.records import Float64


def surface_distance(a: Float64, b: Float64) -> float:
    """The least distance of triangles (F, 3, 3) and (G, 3, 3); 0 where they meet.

    Two triangles that do not meet are nearest at a corner of one and a face of the other, or at an edge of either.
    """
    return min(_triangles(one, other) for one, other in product(a, b))


def _triangles(a: Float64, b: Float64) -> float:
    if any(_crosses(a[[i, (i + 1) % 3]], b) or _crosses(b[[i, (i + 1) % 3]], a) for i in range(3)):
        return 0.0
    corners = [_to_face(p, t) for t, points in ((b, a), (a, b)) for p in points]
    edges = [_edges(a[i], a[(i + 1) % 3], b[j], b[(j + 1) % 3]) for i, j in product(range(3), repeat=2)]
    return min(*corners, *edges)


def _crosses(edge: Float64, triangle: Float64) -> bool:
    """Whether an edge (2, 3) goes through a triangle: where they meet is within both."""
    u, v, w = triangle[1] - triangle[0], triangle[2] - triangle[0], edge[0] - edge[1]
    A = np.stack([u, v, w], axis=1)
    if abs(np.linalg.det(A)) < 1e-18:
        return False
    s, t, r = np.linalg.solve(A, edge[0] - triangle[0])
    return bool(s >= 0 and t >= 0 and s + t <= 1 and 0 <= r <= 1)


def _to_face(p: Float64, t: Float64) -> float:
    """From a point to a triangle's inside, where its foot is there; else infinite: edges and corners count apart."""
    u, v = t[1] - t[0], t[2] - t[0]
    s, r = np.linalg.lstsq(np.stack([u, v], axis=1), p - t[0], rcond=None)[0]
    if s < 0 or r < 0 or s + r > 1:
        return np.inf
    return float(np.linalg.norm(t[0] + s * u + r * v - p))


def _edges(a: Float64, b: Float64, c: Float64, d: Float64) -> float:
    """Of two segments: at their common perpendicular, or at an end of one."""
    u, v, w = b - a, d - c, a - c
    A = np.array([[u @ u, -(u @ v)], [u @ v, -(v @ v)]])
    found = [_to_segment(a, c, d), _to_segment(b, c, d), _to_segment(c, a, b), _to_segment(d, a, b)]
    if abs(np.linalg.det(A)) > 1e-18:
        s, t = np.linalg.solve(A, -np.array([u @ w, v @ w]))
        if 0 <= s <= 1 and 0 <= t <= 1:
            found.append(float(np.linalg.norm(w + s * u - t * v)))
    return min(found)


def _to_segment(p: Float64, a: Float64, b: Float64) -> float:
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return float(np.linalg.norm(a + t * (b - a) - p))

"""The depth of solids along a camera's rays, and whether a measured depth lies inside one; one ray at a time."""

import numpy as np

from splatctrl_cli.records import Float64


def span(kind: str, size: tuple[float, ...], origin: Float64, direction: Float64) -> tuple[float, float]:
    """Where origin + t direction is inside a solid in its own frame: t from, t to; (inf, -inf) where it never is.

    size: half edges of a box, (radius, half length) of a cylinder or capsule, (radius,) of a sphere.
    """
    if kind == "capsule":
        radius, half = size
        spans = [span("cylinder", size, origin, direction)]
        spans += [span("sphere", (radius,), origin - [0, 0, z], direction) for z in (-half, half)]
        return min(s[0] for s in spans), max(s[1] for s in spans)
    pairs = []
    if kind in {"sphere", "cylinder"}:
        n = 3 if kind == "sphere" else 2
        o, d = origin[:n], direction[:n]
        roots = np.roots([d @ d, 2 * o @ d, o @ o - size[0] ** 2])
        if np.iscomplex(roots).any():
            return np.inf, -np.inf
        pairs.append((roots.real.min(), roots.real.max()))
    faces = {"box": (0, 1, 2), "cylinder": (2,), "sphere": ()}[kind]
    for axis in faces:
        half = size[axis] if kind == "box" else size[1]
        pairs.append(sorted(((s * half - origin[axis]) / direction[axis]) for s in (-1, 1)))
    near, far = max(p[0] for p in pairs), min(p[1] for p in pairs)
    return (near, far) if near <= far else (np.inf, -np.inf)


def triangle_depth(corners: Float64, direction: Float64) -> float:
    """t where t direction is on a triangle (3, 3), from whichever side; infinite where it never is."""
    try:
        t, across, along = np.linalg.solve(np.column_stack([direction, *(corners[0] - corners[1:])]), corners[0])
    except np.linalg.LinAlgError:
        return np.inf
    return float(t) if min(t, across, along, 1 - across - along) >= 0 else np.inf


def is_inside_spans(measured: float, tolerance: float, spans: list[tuple[float, float]]) -> bool:
    """Whether a measured depth lies by more than `tolerance` behind the front and before the back of one solid."""
    return any(near < measured - tolerance and measured + tolerance < far and near > 0 for near, far in spans)

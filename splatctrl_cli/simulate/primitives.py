"""Boxes, cylinders and spheres: exact signed distance, nearest surface point, ray hits and normals.

A primitive's own frame has its origin in its middle; a cylinder stands along z. R rays, Q points.
"""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Float64
from splatctrl_cli.simulate.textures import Texture

ALWAYS = (-(2**62), 2**62)  # [ns] a span of time that holds every stamp


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """One solid: kind `box` (size = full x, y, z), `cylinder` (radius, height) or `sphere` (radius) [m].

    T_world_shape (4, 4) places it; it is there while from_ns <= stamp < to_ns.
    """

    name: str
    kind: str
    size: tuple[float, ...]
    T_world_shape: Float64
    texture: Texture
    from_ns: int = ALWAYS[0]
    to_ns: int = ALWAYS[1]

    def is_present(self, stamp_ns: int) -> bool:
        """True while the solid is in the scene."""
        return self.from_ns <= stamp_ns < self.to_ns

    @property
    def bounding_radius(self) -> float:
        """Radius [m] of the ball about its middle that holds it."""
        if self.kind == "box":
            return float(np.linalg.norm(self.size)) / 2
        return float(np.hypot(self.size[0], self.size[1] / 2)) if self.kind == "cylinder" else self.size[0]


def closest_point(primitive: Primitive, points_world: Float64) -> tuple[Float64, Float64]:
    """Signed distance (Q,) [m], negative inside, and the nearest surface point (Q, 3), world, of points (Q, 3)."""
    p = transform_points(invert_transform(primitive.T_world_shape), points_world)
    if primitive.kind == "sphere":
        surface = p / np.maximum(np.linalg.norm(p, axis=1, keepdims=True), 1e-300) * primitive.size[0]
        surface[np.linalg.norm(p, axis=1) == 0] = [primitive.size[0], 0, 0]
        distance = np.linalg.norm(p, axis=1) - primitive.size[0]
    elif primitive.kind == "box":
        distance, surface = _box_closest(p, np.array(primitive.size) / 2)
    else:
        distance, surface = _cylinder_closest(p, primitive.size[0], primitive.size[1] / 2)
    return distance, transform_points(primitive.T_world_shape, surface)


def signed_distance(primitive: Primitive, points_world: Float64) -> Float64:
    """Signed distance (Q,) [m], negative inside, of points (Q, 3), world."""
    return closest_point(primitive, points_world)[0]


def _box_closest(p: Float64, half: Float64) -> tuple[Float64, Float64]:
    surface = np.clip(p, -half, half)
    outside = np.linalg.norm(p - surface, axis=1)
    gap = half - np.abs(p)  # to each pair of faces, positive inside
    inner = np.flatnonzero(np.all(gap > 0, axis=1))
    axis = np.argmin(gap[inner], axis=1)
    surface[inner, axis] = np.where(p[inner, axis] < 0, -half[axis], half[axis])
    outside[inner] = -gap[inner, axis]
    return outside, surface


def _cylinder_closest(p: Float64, radius: float, half: float) -> tuple[Float64, Float64]:
    rho = np.hypot(p[:, 0], p[:, 1])
    flat = np.stack([rho, np.zeros_like(rho), p[:, 2]], axis=1)
    section = np.array([radius, np.inf, half])  # rho >= 0, so only the outer side of the section is ever nearest
    distance, surface = _box_closest(flat, section)
    direction = np.where(rho[:, None] > 0, p[:, :2] / np.maximum(rho, 1e-300)[:, None], [1.0, 0.0])
    return distance, np.column_stack([direction * surface[:, :1], surface[:, 2]])


def hit(primitive: Primitive, origin_world: Float64, directions_world: Float64) -> Float64:
    """The ray parameter t (R,) of the first hit of origin + t * directions (R, 3), inf where there is none."""
    T_shape_world = invert_transform(primitive.T_world_shape)
    origin = T_shape_world[:3, :3] @ origin_world + T_shape_world[:3, 3]
    directions = directions_world @ T_shape_world[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        if primitive.kind == "sphere":
            near, far = _round_span(origin, directions, primitive.size[0])
        elif primitive.kind == "box":
            near, far = _slab_span(origin, directions, np.array(primitive.size) / 2)
        else:
            side = _round_span(origin[:2], directions[:, :2], primitive.size[0])
            caps = _slab_span(origin[2:], directions[:, 2:], np.array([primitive.size[1] / 2]))
            near, far = np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])
        return np.where((near <= far) & (near > 1e-6), near, np.inf)


def normals(primitive: Primitive, points_shape: Float64) -> Float64:
    """Outward unit normals (R, 3) at surface points (R, 3), both in the primitive's own frame."""
    if primitive.kind == "sphere":
        return points_shape / primitive.size[0]
    out = np.zeros_like(points_shape)
    rows = np.arange(len(points_shape))
    if primitive.kind == "box":
        axis = np.argmax(np.abs(points_shape) - np.array(primitive.size) / 2, axis=1)
        out[rows, axis] = np.sign(points_shape[rows, axis])
        return out
    radius, height = primitive.size
    is_cap = np.abs(points_shape[:, 2]) - height / 2 > np.hypot(points_shape[:, 0], points_shape[:, 1]) - radius
    out[:, :2] = np.where(is_cap[:, None], 0, points_shape[:, :2] / radius)
    out[:, 2] = np.where(is_cap, np.sign(points_shape[:, 2]), 0)
    return out


def _round_span(origin: Float64, directions: Float64, radius: float) -> tuple[Float64, Float64]:
    """Where rays (2-D or 3-D) are inside a circle or ball about 0: t from, t to; NaN where they miss."""
    a = np.sum(directions**2, axis=1)
    b = directions @ origin
    root = np.sqrt(b**2 - a * (origin @ origin - radius**2))
    near, far = (-b - root) / a, (-b + root) / a
    is_inside = (a == 0) & (origin @ origin <= radius**2)
    return np.where(is_inside, -np.inf, near), np.where(is_inside, np.inf, far)


def _slab_span(origin: Float64, directions: Float64, half: Float64) -> tuple[Float64, Float64]:
    """Where rays are between the faces at -half and half of every axis: t from, t to."""
    a, b = (-half - origin) / directions, (half - origin) / directions
    return np.max(np.minimum(a, b), axis=1), np.min(np.maximum(a, b), axis=1)

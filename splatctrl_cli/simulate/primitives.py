"""Textured boxes, cylinders, capsules and spheres: exact distance, surface points, ray hits, normals.

Frames have their origin in the middle; cylinders and capsules stand along z. R rays, Q points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.errors import refuse_if
from splatctrl_cli.geometry import interpolate_transform, invert_transform, pose_at, transform_points, turn_about_z
from splatctrl_cli.records import Float64, Stamps

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709
ALWAYS = (-(2**62), 2**62)  # [ns] a span of time that holds every stamp


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A pattern of two colours, RGB in [0, 1], in the solid's frame.

    pattern: `noise`, `stripes` or `checks`; feature [m]: noise cell, or width of a stripe or check.
    """

    pattern: str
    feature: float
    dark: tuple[float, float, float]
    bright: tuple[float, float, float]
    seed: int = 0

    def color(self, points_shape: Float64) -> Float64:
        """RGB (R, 3) in [0, 1] at points (R, 3) [m] in the solid's frame."""
        p = points_shape / self.feature
        if self.pattern == "noise":
            share = _value_noise(p + 0.37, self.seed)
            share = 0.5 + 0.5 * np.tanh(3.6 * (share - 0.5))
        elif self.pattern == "stripes":
            wave = np.sin(np.pi * (p @ np.array([0.62, 0.48, 0.62])) + self.seed)
            share = 0.5 + 0.5 * np.tanh(1.5 * wave) / np.tanh(1.5)
        else:
            wave = np.prod(np.sin(np.pi * (p + 0.25)), axis=1)
            share = 0.5 + 0.5 * np.tanh(4.0 * wave)
        dark, bright = np.array(self.dark), np.array(self.bright)
        return np.asarray(dark + (bright - dark) * share[:, None])


def luminance_std(color: np.ndarray) -> float:
    """Standard deviation of luminance (0 to 1) of 8-bit RGB (H, W, 3)."""
    return float(np.std(color.astype(np.float64) @ LUMINANCE / 255))


def _value_noise(p: Float64, seed: int) -> Float64:
    """Smooth noise (R,) in [0, 1]: lattice values, blended by smoothstep."""
    cell = np.floor(p)
    t = p - cell
    t = t * t * (3 - 2 * t)
    lattice = cell.astype(np.int64)
    total = np.zeros(len(p))
    for corner in range(8):
        step = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        weight = np.prod(np.where(step, t, 1 - t), axis=1)
        total += weight * _hash(lattice + step, seed)
    return total


def _hash(lattice: np.ndarray, seed: int) -> Float64:
    x, y, z = (lattice[:, i].astype(np.uint64) for i in range(3))
    key = x * np.uint64(0x9E3779B97F4A7C15) ^ y * np.uint64(0xC2B2AE3D27D4EB4F) ^ z * np.uint64(0x165667B19E3779F9)
    key ^= np.uint64(seed * 0x27D4EB2F + 0x85EBCA6B)
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        key ^= key >> np.uint64(33)
        key *= np.uint64(factor)
    key ^= key >> np.uint64(33)
    return np.asarray((key >> np.uint64(11)).astype(np.float64) / 2.0**53)


@dataclass(frozen=True, kw_only=True)
class Track:
    """Poses (K, 4, 4) at increasing stamps (K,) int64 [ns]; at rest outside.

    Between stamps, the origin moves linearly; the solid rotates about one axis, uniformly.
    """

    stamp_ns: Stamps
    T_world_shape: Float64

    def __post_init__(self) -> None:
        refuse_if(
            len(self.stamp_ns) == 0 or len(self.stamp_ns) != len(self.T_world_shape),
            f"track: expected a pose for every stamp, got {len(self.T_world_shape)} for {len(self.stamp_ns)}",
        )
        refuse_if(np.any(np.diff(self.stamp_ns) <= 0), "track: expected stamps that increase")

    def at(self, stamp_ns: int) -> Float64:
        """T_world_shape (4, 4) at a stamp."""
        after = int(np.searchsorted(self.stamp_ns, stamp_ns, side="right"))
        if after in (0, len(self.stamp_ns)):
            return np.asarray(self.T_world_shape[max(after - 1, 0)])
        first, last = int(self.stamp_ns[after - 1]), int(self.stamp_ns[after])
        return interpolate_transform(
            self.T_world_shape[after - 1], self.T_world_shape[after], (stamp_ns - first) / (last - first)
        )


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """One solid: box, cylinder, sphere or capsule.

    size [m]: full x, y, z of a box; radius, height of a cylinder; radius of a sphere; radius, axis length of a
    capsule. T_world_shape (4, 4): its first pose. Present while from_ns <= stamp < to_ns.
    """

    name: str
    kind: str
    size: tuple[float, ...]
    T_world_shape: Float64
    texture: Texture
    from_ns: int = ALWAYS[0]
    to_ns: int = ALWAYS[1]
    track: Track | None = None

    def at(self, stamp_ns: int) -> "Primitive":
        """The solid at a stamp, without its track."""
        if self.track is None:
            return self
        return replace(self, T_world_shape=self.track.at(stamp_ns), track=None)

    def is_present(self, stamp_ns: int) -> bool:
        return self.from_ns <= stamp_ns < self.to_ns

    @property
    def bounding_radius(self) -> float:
        """Bounding radius [m] about its middle."""
        if self.kind == "box":
            return float(np.linalg.norm(self.size)) / 2
        if self.kind == "capsule":
            return self.size[0] + self.size[1] / 2
        return float(np.hypot(self.size[0], self.size[1] / 2)) if self.kind == "cylinder" else self.size[0]


def solid(
    name: str, kind: str, size: tuple[float, ...], middle: Sequence[float], texture: Texture, yaw: float | None = None
) -> Primitive:
    """A solid, upright or rotated by yaw [rad] about z."""
    return Primitive(
        name=name,
        kind=kind,
        size=size,
        T_world_shape=pose_at(middle, None if yaw is None else turn_about_z(yaw)),
        texture=texture,
    )


def box(name: str, size: tuple[float, ...], middle: Sequence[float], texture: Texture, yaw: float = 0.0) -> Primitive:
    """A box rotated by yaw [rad] about z."""
    return solid(name, "box", size, middle, texture, yaw)


def closest_point(primitive: Primitive, points_world: Float64) -> tuple[Float64, Float64]:
    """Signed distance (Q,) [m], negative inside, and nearest surface point (Q, 3) of points (Q, 3), world."""
    p = transform_points(invert_transform(primitive.T_world_shape), points_world)
    if primitive.kind == "sphere":
        surface = p / np.maximum(np.linalg.norm(p, axis=1, keepdims=True), 1e-300) * primitive.size[0]
        surface[np.linalg.norm(p, axis=1) == 0] = [primitive.size[0], 0, 0]
        distance = np.linalg.norm(p, axis=1) - primitive.size[0]
    elif primitive.kind == "box":
        distance, surface = _box_closest(p, np.array(primitive.size) / 2)
    else:
        closest = _capsule_closest if primitive.kind == "capsule" else _cylinder_closest
        distance, surface = closest(p, primitive.size[0], primitive.size[1] / 2)
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


def _capsule_closest(p: Float64, radius: float, half: float) -> tuple[Float64, Float64]:
    on_axis = np.zeros_like(p)
    on_axis[:, 2] = np.clip(p[:, 2], -half, half)
    away = p - on_axis
    length = np.linalg.norm(away, axis=1)
    away[length == 0] = [1.0, 0.0, 0.0]
    return length - radius, on_axis + away * (radius / np.where(length > 0, length, 1.0))[:, None]


def hit(primitive: Primitive, origin_world: Float64, directions_world: Float64) -> Float64:
    """Parameter t (R,) of rays' first hits, origin + t * directions (R, 3), else inf."""
    T_shape_world = invert_transform(primitive.T_world_shape)
    origin = T_shape_world[:3, :3] @ origin_world + T_shape_world[:3, 3]
    directions = directions_world @ T_shape_world[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        if primitive.kind == "sphere":
            near, far = _round_span(origin, directions, primitive.size[0])
        elif primitive.kind == "box":
            near, far = _slab_span(origin, directions, np.array(primitive.size) / 2)
        else:
            span = _capsule_span if primitive.kind == "capsule" else _cylinder_span
            near, far = span(origin, directions, primitive.size[0], primitive.size[1] / 2)
        return np.where((near <= far) & (near > 1e-6), near, np.inf)


def normals(primitive: Primitive, points_shape: Float64) -> Float64:
    """Outward unit normals (R, 3) at surface points (R, 3), own frame."""
    if primitive.kind == "sphere":
        return points_shape / primitive.size[0]
    if primitive.kind == "capsule":
        half = np.array([0.0, 0.0, primitive.size[1] / 2])
        return np.asarray((points_shape - np.clip(points_shape, -half, half)) / primitive.size[0])
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


def _cylinder_span(origin: Float64, directions: Float64, radius: float, half: float) -> tuple[Float64, Float64]:
    side = _round_span(origin[:2], directions[:, :2], radius)
    caps = _slab_span(origin[2:], directions[:, 2:], np.array([half]))
    return np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])


def _capsule_span(origin: Float64, directions: Float64, radius: float, half: float) -> tuple[Float64, Float64]:
    """Interval of t inside a capsule: of its cylinder and balls."""
    end = np.array([0.0, 0.0, half])
    spans = [
        _cylinder_span(origin, directions, radius, half),
        *(_round_span(origin - side * end, directions, radius) for side in (-1.0, 1.0)),
    ]
    near = [np.where(a <= b, a, np.inf) for a, b in spans]
    far = [np.where(a <= b, b, -np.inf) for a, b in spans]
    return np.min(near, axis=0), np.max(far, axis=0)


def _round_span(origin: Float64, directions: Float64, radius: float) -> tuple[Float64, Float64]:
    """Interval of t inside a circle or ball about 0; NaN for misses."""
    a = np.sum(directions**2, axis=1)
    b = directions @ origin
    root = np.sqrt(b**2 - a * (origin @ origin - radius**2))
    near, far = (-b - root) / a, (-b + root) / a
    is_inside = (a == 0) & (origin @ origin <= radius**2)
    return np.where(is_inside, -np.inf, near), np.where(is_inside, np.inf, far)


def _slab_span(origin: Float64, directions: Float64, half: Float64) -> tuple[Float64, Float64]:
    """Interval of t between -half and half of every axis."""
    near, far = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
    for axis, size in enumerate(half):
        a, b = (-size - origin[axis]) / directions[:, axis], (size - origin[axis]) / directions[:, axis]
        near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
    return near, far

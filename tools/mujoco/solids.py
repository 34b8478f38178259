"""Solids with an exact signed distance, and how they move: boxes, cylinders, balls, capsules and turned profiles."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tools.mujoco.poses import Float64

CONVEX = ("box", "cylinder", "ball", "capsule", "frustum")
AWAY = np.array([0.0, 0.0, -30.0])  # [m] where what is not there is kept


@dataclass(frozen=True, kw_only=True)
class Track:
    """Poses (K, 4, 4) at times (K,) [s]; at rest before and after them, with constant velocity between them."""

    times: Float64
    poses: Float64

    def at(self, times: Float64) -> Float64:
        """T_world_solid (T, 4, 4)."""
        if len(self.times) == 1:
            return np.repeat(self.poses, len(times), axis=0)
        clipped = np.clip(times, self.times[0], self.times[-1])
        out = np.tile(np.eye(4), (len(times), 1, 1))
        out[:, :3, :3] = Slerp(self.times, Rotation.from_matrix(self.poses[:, :3, :3]))(clipped).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(clipped, self.times, self.poses[:, axis, 3])
        return out


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A solid: `box` (half sizes), `cylinder` or `capsule` (radius, half length along z), `ball` (radius) or `lathe`.

    A lathe turns a `profile` (P, 2) of radii and rising heights [m], whose ends lie on the axis, about z. link: the
    link that it is fixed to, with `track` in that link's frame. held: from, to [s] while it moves with the robot
    although its track is in the world. lost: share of the solid's pixels that return no depth.
    """

    name: str
    kind: str
    size: tuple[float, ...] = ()
    profile: Float64 = field(default_factory=lambda: np.zeros((0, 2)))
    track: Track
    rgb: tuple[float, float, float] = (0.6, 0.5, 0.4)
    lost: float = 0.0
    link: str | None = None
    held: tuple[float, float] | None = None

    @property
    def radius(self) -> float:
        """Radius [m] of a ball about its origin that holds it."""
        if self.kind == "box":
            return float(np.linalg.norm(self.size))
        if self.kind == "lathe":
            return float(np.linalg.norm(self.profile, axis=1).max())
        if self.kind == "ball":
            return self.size[0]
        return float(np.linalg.norm(self.size)) if self.kind == "cylinder" else sum(self.size)


def fixed(T_world_solid: Float64) -> Track:
    """A solid that never moves."""
    return Track(times=np.zeros(1), poses=T_world_solid[None])


def signed_distance(solid: Solid, points: Float64) -> tuple[Float64, Float64]:
    """Signed distance (Q,) [m] of points (Q, 3) in the solid's own frame, negative inside, and its gradient (Q, 3).

    For convex kinds, the distance is a convex function, and the gradient is a subgradient.
    """
    if solid.kind in ("lathe", "frustum"):
        return _of_profile(points, solid.profile)
    if solid.kind == "box":
        return _of_box(points, np.array(solid.size))
    if solid.kind == "cylinder":
        rho = np.hypot(points[:, 0], points[:, 1])
        flat, slope = _of_box(np.stack([rho, points[:, 2]], axis=1), np.array(solid.size))
        outward = points[:, :2] / np.maximum(rho, 1e-12)[:, None]
        return flat, np.column_stack([outward * slope[:, :1], slope[:, 1:]])
    half = solid.size[1] if solid.kind == "capsule" else 0.0
    away = points.copy()
    away[:, 2] -= np.clip(points[:, 2], -half, half)
    length = np.linalg.norm(away, axis=1)
    return length - solid.size[0], away / np.maximum(length, 1e-12)[:, None]


def _of_box(points: Float64, half: Float64) -> tuple[Float64, Float64]:
    """Signed distance and gradient of an axis-aligned box in two or three dimensions."""
    past = np.abs(points) - half
    outside = np.maximum(past, 0)
    length = np.linalg.norm(outside, axis=1)
    nearest = np.eye(len(half))[np.argmax(past, axis=1)]
    slope = np.where((length > 0)[:, None], outside / np.maximum(length, 1e-300)[:, None], nearest)
    return length + np.minimum(past.max(axis=1), 0), slope * np.where(points < 0, -1.0, 1.0)


def frusta(solid: Solid) -> tuple[Solid, ...]:
    """The convex frusta that compose a lathe; outside the lathe, its distance is the least of their distances."""
    return tuple(
        replace(solid, kind="frustum", profile=np.array([[0.0, a[1]], a, b, [0.0, b[1]]]))
        for a, b in pairwise(solid.profile)
        if b[1] > a[1]
    )


def _of_profile(points: Float64, profile: Float64) -> tuple[Float64, Float64]:
    """Signed distance and gradient of a profile (P, 2) turned about z; a frustum's gradient is exact."""
    rho, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    best = np.full(len(points), np.inf)
    toward = np.zeros((len(points), 2))
    is_inside = np.zeros(len(points), dtype=bool)
    for a, b in pairwise(profile):
        dr, dz = b - a
        x, y = rho - a[0], z - a[1]
        share = np.clip((x * dr + y * dz) / max(dr * dr + dz * dz, 1e-300), 0, 1)
        x, y = x - share * dr, y - share * dz
        square = x * x + y * y
        is_nearer = square < best
        best = np.where(is_nearer, square, best)
        toward = np.where(is_nearer[:, None], np.stack([x, y], axis=1), toward)
        if dz != 0:
            is_inside ^= ((a[1] > z) != (b[1] > z)) & (rho < a[0] + (z - a[1]) / dz * dr)
    distance = np.sqrt(best)
    slope = np.where(is_inside, -1.0, 1.0)[:, None] * toward / np.maximum(distance, 1e-12)[:, None]
    outward = points[:, :2] / np.maximum(rho, 1e-12)[:, None]
    return np.where(is_inside, -distance, distance), np.column_stack([outward * slope[:, :1], slope[:, 1:]])

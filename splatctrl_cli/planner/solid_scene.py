"""A scene of exact solids: spheres, boxes, cylinders and capsules.

Q points, P solids of one kind; rods lie along their own z axis, centred. World, [m], float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Float64

STEP = 1e-6  # [m] of the differences that give a gradient


@dataclass(frozen=True, kw_only=True)
class Ball:
    """A ball at center (3,)."""

    center: Float64
    radius: float


@dataclass(frozen=True, kw_only=True)
class Cuboid:
    """A box of full size (3,) along its axes, placed by T_world_shape (4, 4)."""

    size: Float64
    T_world_shape: Float64


@dataclass(frozen=True, kw_only=True)
class Rod:
    """A cylinder; `is_round`: a capsule, with caps of its radius on both ends."""

    radius: float
    length: float
    T_world_shape: Float64
    is_round: bool = False


Solid = Ball | Cuboid | Rod


@dataclass(frozen=True, kw_only=True)
class Solids:
    """A `DistanceField` of solids: signed distance, negative inside, 1-Lipschitz.

    Inside several solids: the depth in the deepest, at most the way out. Raises InputError for a size not above zero.
    """

    solids: Sequence[Solid]
    _balls: tuple[Float64, Float64] = field(init=False, repr=False)
    _boxes: tuple[Float64, Float64, Float64] = field(init=False, repr=False)
    _rods: tuple[Float64, Float64, Float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for index, solid in enumerate(self.solids):
            if not min(_sizes(solid)) > 0:
                raise InputError(f"solid {index}: expected sizes above 0 m, got {_sizes(solid)}")
        balls = [s for s in self.solids if isinstance(s, Ball)]
        boxes = [s for s in self.solids if isinstance(s, Cuboid)]
        rods = [s for s in self.solids if isinstance(s, Rod)]
        centers = np.array([s.center for s in balls], dtype=np.float64).reshape(-1, 3)
        object.__setattr__(self, "_balls", (centers, np.array([s.radius for s in balls], dtype=np.float64)))
        half = np.array([s.size for s in boxes], dtype=np.float64).reshape(-1, 3).T / 2
        object.__setattr__(self, "_boxes", (*_into([s.T_world_shape for s in boxes]), half))
        shape = np.array([_core(s) for s in rods], dtype=np.float64)
        object.__setattr__(self, "_rods", (*_into([s.T_world_shape for s in rods]), shape.reshape(-1, 3).T))

    def rows(self) -> tuple[Float64, Float64, Float64]:
        """Return balls (., 4), boxes (., 15), rods (., 15) for `kernels.joint_edges.EdgeRoom`."""
        centers, radii = self._balls
        return np.column_stack([centers, radii]), _placed_rows(*self._boxes), _placed_rows(*self._rods)

    def distance(self, points: Float64) -> Float64:
        """Return signed distances (Q,) at points (Q, 3), inf without solids."""
        least = np.full(len(points), np.inf)
        if len(self._balls[0]):
            least = np.minimum(least, np.min(_to_balls(points, *self._balls), axis=0))
        if len(self._boxes[0]):
            least = np.minimum(least, np.min(_to_boxes(points, *self._boxes), axis=0))
        if len(self._rods[0]):
            least = np.minimum(least, np.min(_to_rods(points, *self._rods), axis=0))
        return least

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Return distance (Q,) and central-difference gradient (Q, 3)."""
        steps = STEP * np.eye(3)
        gradient = [(self.distance(points + step) - self.distance(points - step)) / (2 * STEP) for step in steps]
        return self.distance(points), np.stack(gradient, axis=1)


def _to_balls(points: Float64, centers: Float64, radii: Float64) -> Float64:
    return np.asarray(np.linalg.norm(points - centers[:, None], axis=2) - radii[:, None])


def _to_boxes(points: Float64, turn: Float64, shift: Float64, half: Float64) -> Float64:
    """(P, Q): distance outside, minus the way to the nearest face inside."""
    out = np.abs(_local(points, turn, shift)) - half[:, :, None]
    inside = np.minimum(np.max(out, axis=0), 0.0)
    np.maximum(out, 0.0, out=out)
    return np.asarray(np.sqrt(np.einsum("kpq,kpq->pq", out, out)) + inside)


def _to_rods(points: Float64, turn: Float64, shift: Float64, shape: Float64) -> Float64:
    """(P, Q): as for a box, in the half plane through the axis."""
    x, y, z = _local(points, turn, shift)
    across = np.sqrt(x * x + y * y) - shape[0][:, None]
    along = np.abs(z) - shape[1][:, None]
    inside = np.minimum(np.maximum(across, along), 0.0)
    return np.asarray(np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0)) + inside - shape[2][:, None])


def _local(points: Float64, turn: Float64, shift: Float64) -> Float64:
    return np.asarray((turn @ points.T).reshape(3, -1, len(points)) + shift[:, :, None])


def _into(placements: Sequence[Float64]) -> tuple[Float64, Float64]:
    maps = np.array([invert_transform(T) for T in placements]).reshape(-1, 4, 4)
    return np.ascontiguousarray(np.swapaxes(maps[:, :3, :3], 0, 1)).reshape(-1, 3), maps[:, :3, 3].T


def _placed_rows(turn: Float64, shift: Float64, shape: Float64) -> Float64:
    rotations = np.swapaxes(turn.reshape(3, -1, 3), 0, 1).reshape(-1, 9)
    return np.ascontiguousarray(np.column_stack([rotations, shift.T, shape.T]))


def _core(rod: Rod) -> tuple[float, float, float]:
    """Cylinder radius, half length, distance of the surface outside it."""
    return (0.0, rod.length / 2, rod.radius) if rod.is_round else (rod.radius, rod.length / 2, 0.0)


def _sizes(solid: Solid) -> tuple[float, ...]:
    if isinstance(solid, Ball):
        return (float(solid.radius),)
    if isinstance(solid, Cuboid):
        return tuple(float(v) for v in solid.size)
    return float(solid.radius), float(solid.length)

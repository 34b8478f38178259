"""Scenes of solids for the planner: exact signed distances."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splatctrl_cli import InputError
from splatctrl_cli.blocks import (
    BALL,
    BOX,
    CAPSULE,
    CYLINDER,
    DistanceField,
    Float64,
    invert_transform,
    pose_at,
    solid_distance,
)

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

    Inside several solids, it is the depth in the deepest. Raises InputError for a size not above zero.
    """

    solids: Sequence[Solid]
    _packed: Float64 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for index, solid in enumerate(self.solids):
            if not min(_sizes(solid)) > 0:
                raise InputError(f"solid {index}: expected sizes above 0 m, got {_sizes(solid)}")
        object.__setattr__(self, "_packed", np.array([_packed(solid) for solid in self.solids]).reshape(-1, 16))

    def rows(self) -> tuple[Float64, Float64, Float64]:
        """Balls (., 4), boxes (., 15), rods (., 15) for `kernels.chain.EdgeRoom`."""
        balls, boxes, cylinders, capsules = (
            self._packed[self._packed[:, 0] == kind, 1:] for kind in (BALL, BOX, CYLINDER, CAPSULE)
        )
        # A capsule is a line padded by its radius, a cylinder has no padding.
        rods = np.concatenate([cylinders, capsules[:, [*range(12), 14, 13, 12]]])
        return np.column_stack([-balls[:, 9:12], balls[:, 12]]), boxes, rods

    def distance(self, points: Float64) -> Float64:
        """Signed distances (Q,) at points (Q, 3), inf without solids."""
        return solid_distance(points, self._packed)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) and central-difference gradient (Q, 3)."""
        steps = STEP * np.eye(3)
        gradient = [(self.distance(points + step) - self.distance(points - step)) / (2 * STEP) for step in steps]
        return self.distance(points), np.stack(gradient, axis=1)


def _packed(solid: Solid) -> Float64:
    if isinstance(solid, Ball):
        kind, T, sizes = BALL, pose_at(solid.center), np.array([solid.radius, 0.0, 0.0])
    elif isinstance(solid, Cuboid):
        kind, T, sizes = BOX, solid.T_world_shape, solid.size / 2
    else:
        kind, T = CAPSULE if solid.is_round else CYLINDER, solid.T_world_shape
        sizes = np.array([solid.radius, solid.length / 2, 0.0])
    into = invert_transform(T)
    return np.concatenate([[kind], into[:3, :3].ravel(), into[:3, 3], sizes])


def _sizes(solid: Solid) -> tuple[float, ...]:
    if isinstance(solid, Ball):
        return (float(solid.radius),)
    sizes = solid.size if isinstance(solid, Cuboid) else (solid.radius, solid.length)
    return tuple(float(size) for size in sizes)


@dataclass(frozen=True, kw_only=True)
class OnlyDistance:
    """A field (splats, or baked) as a scene for planning."""

    field: DistanceField

    def distance(self, points: Float64) -> Float64:
        return self.field.query(points)[0]

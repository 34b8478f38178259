"""Rooms of solids around the planar arm."""

import numpy as np

from experiments.solids import Ball, Cuboid, Solids
from splatctrl_cli.planner.configuration_clearance import Clearance
from tests.control.fakes import PlanarArm


def wall(x: float, y: float, size: tuple[float, float], angle: float = 0.0) -> Cuboid:
    """A wall of a size in the plane, 1 m high, turned about z."""
    T = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], [x, y]
    return Cuboid(size=np.array([*size, 1.0]), T_world_shape=T)


def one_wall() -> Solids:
    """A wall along the x axis, beyond the elbow: the arm passes it folded."""
    return Solids(solids=[wall(0.85, 0.0, (0.4, 0.02))])


def closed_ring() -> Solids:
    """A wall from the shoulder outwards on either side of y > 0: no way round for any posture."""
    return Solids(solids=[wall(0.6, 0.0, (1.0, 0.02)), wall(-0.6, 0.0, (1.0, 0.02))])


def clearance(solids: Solids, margin: float = 0.0) -> Clearance:
    return Clearance.of(PlanarArm(), solids, margin=margin)


def thin_post(radius: float = 0.002) -> Solids:
    """A needle that samples step over."""
    return Solids(solids=[Ball(center=np.array([0.62, 0.31, 0.0]), radius=radius)])

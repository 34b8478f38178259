"""A planar arm that knows its lever arms, and rooms of solids around it."""

import numpy as np

from splatctrl_cli.control.clearance import Clearance
from splatctrl_cli.control.solids import Ball, Cuboid, Solids
from splatctrl_cli.kernels.chain import Chain
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm


class LeveredArm(PlanarArm):
    """`PlanarArm` with exact lever arms: each sphere's greatest distance to the joint."""

    chain: Chain | None = None

    def lever_arms(self) -> Float64:
        x = self.sphere_set.centers[:, 0]
        is_fore = np.array([link == "fore" for link in self.sphere_set.links])
        return np.stack([np.where(is_fore, self.lengths[0] + x, x), np.where(is_fore, x, 0.0)], axis=1)

    def sphere_centers_batch(self, q: Float64) -> Float64:
        elbow = np.array([0.0, 0.0, 0.0, self.lengths[0], self.lengths[0]])
        turn, bent = q[:, :1], q.sum(axis=1)[:, None]
        along = self.sphere_set.centers[:, 0]
        upper, fore = np.where(elbow > 0, elbow, along), np.where(elbow > 0, along, 0.0)
        x = upper * np.cos(turn) + fore * np.cos(bent)
        y = upper * np.sin(turn) + fore * np.sin(bent)
        return np.stack([x, y, np.zeros_like(x)], axis=2)


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
    return Clearance.of(LeveredArm(), solids, margin=margin)


def thin_post(radius: float = 0.002) -> Solids:
    """A needle that samples step over."""
    return Solids(solids=[Ball(center=np.array([0.62, 0.31, 0.0]), radius=radius)])

"""Control barrier rows of III-E: ``G v - s <= h``, one slack s >= 0 per row."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels.chain import pair_gaps
from splatctrl_cli.records import Float64

Index = NDArray[np.integer]

IMMOVABLE = 1e-9  # [m/s] a row that the fastest allowed motion changes by less than this cannot be acted on


@dataclass(frozen=True, kw_only=True)
class Barrier:
    """M barrier rows ``G v - s <= h`` with ``G = -dd/dq`` (M, J) and ``h = alpha (d - epsilon) + dd/dt`` (M,).

    distance d (M,) [m]; index (M,) is each row's place in its catalogue of names (sphere, or sphere pair).
    The cost of slack is ``slack_cost * s + slack_weight * s^2`` per row [s in m/s].
    """

    index: Index
    G: Float64
    h: Float64
    distance: Float64
    slack_cost: float
    slack_weight: float

    def __len__(self) -> int:
        return len(self.h)

    def select(self, rows: NDArray[np.bool_]) -> "Barrier":
        """The rows where `rows` (M,) is true, in order."""
        return replace(self, index=self.index[rows], G=self.G[rows], h=self.h[rows], distance=self.distance[rows])

    def joined(self, other: "Barrier") -> "Barrier":
        """These rows and then those of `other`, at the same cost of slack."""
        return replace(
            self,
            index=np.concatenate([self.index, other.index]),
            G=np.concatenate([self.G, other.G]),
            h=np.concatenate([self.h, other.h]),
            distance=np.concatenate([self.distance, other.distance]),
        )


def external_gradient(gradient: Float64, jacobians: Float64) -> Float64:
    """``dd/dq`` (M, J) of field distances: gradient (M, 3), not normalised, times sphere Jacobians (M, 3, J)."""
    return np.asarray(np.matmul(gradient[:, None, :], jacobians)[:, 0, :])


def pair_distance(centers: Float64, radii: Float64, pairs: Index) -> tuple[Float64, Float64]:
    """Distance (P,) [m] between sphere surfaces and the unit direction (P, 3) from the second to the first.

    centers (S, 3), radii (S,) [m]; pairs (P, 2). The direction is zero where two centres coincide.
    """
    return pair_gaps(centers, radii, np.asarray(pairs, dtype=np.int64))


def pair_gradient(direction: Float64, jacobians: Float64, pairs: Index) -> Float64:
    """``dd/dq`` (P, J) of sphere pair distances; jacobians (S, 3, J)."""
    relative = jacobians[pairs[:, 0]] - jacobians[pairs[:, 1]]
    return np.asarray(np.matmul(direction[:, None, :], relative)[:, 0, :])


def barrier_bound(distance: Float64, *, margin: float | Float64, gain: float, rate: float | Float64 = 0.0) -> Float64:
    """h (M,) of the rows: ``alpha (d - epsilon) + dd/dt`` [m/s]; rate is dd/dt of a field that changes with time."""
    return np.asarray(gain * (distance - margin) + rate)


def fastest_approach(G: Float64, lowest: Float64, highest: Float64) -> Float64:
    """The largest G v (M,) over the box of joint velocities: how fast each row can be used up [m/s]."""
    return np.asarray(np.maximum(G * lowest, G * highest).sum(axis=1))


def can_bind(G: Float64, h: Float64, lowest: Float64, highest: Float64) -> NDArray[np.bool_]:
    """Rows (M,) that some velocity of the box violates; the others hold for all of them and drop out exactly."""
    return np.asarray(fastest_approach(G, lowest, highest) > h)


def fastest_spheres(jacobians: Float64, lowest: Float64, highest: Float64) -> Float64:
    """How fast each sphere (S,) can go over the box of joint velocities, at most [m/s]; jacobians (S, 3, J)."""
    speed = np.abs(jacobians) @ np.maximum(np.abs(lowest), np.abs(highest))
    return np.asarray(np.sqrt(np.einsum("si,si->s", speed, speed)))


def is_immovable(G: Float64, velocity_limit: Float64) -> NDArray[np.bool_]:
    """Rows (M,) that no joint velocity changes: no sphere of theirs moves, or the field is flat there."""
    return np.asarray(np.abs(G) @ velocity_limit < IMMOVABLE)

"""Spheres on a kinematic tree, and gaps between them.

Shapes: B bodies, the base first, J = B - 1 joints, S spheres, T postures, P pairs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import Float64, Int64, native, num_threads

REVOLUTE, PRISMATIC = 0, 1


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Body b > 0 hangs on its parent by joint b - 1: ``T_b = T_parent placement_b joint(q)``.

    parent, kind (B,): parents first, `REVOLUTE` or `PRISMATIC`; placement (B, 3, 4), the base's in world; axis (B,
    3), unit; sphere_body (S,); offset (S, 3) [m], in its body.
    """

    parent: Int64
    kind: Int64
    placement: Float64
    axis: Float64
    sphere_body: Int64
    offset: Float64

    def centers(self, q: Float64, *, threads: int = 1) -> Float64:
        """Sphere centres (T, S, 3) [m], world, at q (T, J)."""
        out = np.empty((len(q), len(self.sphere_body), 3))
        native.chain_centers(*self._arrays, np.ascontiguousarray(q), num_threads(threads), out)
        return out

    def jacobians(self, q: Float64) -> tuple[Float64, Float64]:
        """Sphere centres (S, 3) [m] and d centre / d q (S, 3, J), world, at q (J,)."""
        num = len(self.sphere_body)
        centers, jacobians = np.empty((num, 3)), np.empty((num, 3, len(q)))
        native.chain_jacobians(*self._arrays, np.ascontiguousarray(q), centers, jacobians)
        return centers, jacobians

    def frame(self, q: Float64, body: int, in_body: Float64) -> tuple[Float64, Float64]:
        """World pose (3, 4) of a frame at `in_body` (3, 4) in `body`, and its Jacobian (6, J), linear first."""
        pose, jacobian = np.empty((3, 4)), np.empty((6, len(q)))
        native.chain_frame(*self._arrays, np.ascontiguousarray(q), body, in_body, pose, jacobian)
        return pose, jacobian

    @property
    def _arrays(self) -> tuple[NDArray[np.generic], ...]:
        return self.parent, self.kind, self.placement, self.axis, self.sphere_body, self.offset


def pair_gaps(centers: Float64, radii: Float64, pairs: Int64) -> tuple[Float64, Float64]:
    """Gaps (P,) [m] of sphere surfaces, unit directions (P, 3) from second to first centre.

    centers (S, 3), radii (S,) [m]; pairs (P, 2). A direction is zero where the centres coincide.
    """
    gap, direction = np.empty(len(pairs)), np.empty((len(pairs), 3))
    native.pair_gaps(np.ascontiguousarray(centers), radii, pairs, gap, direction)
    return gap, direction

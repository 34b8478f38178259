"""Spheres on a kinematic tree, gaps between them, and edges proved free.

B bodies, the base first, J = B - 1 joints, S spheres, T postures, P pairs; E straight edges in joint space, R rows (M
moving spheres, then P pairs).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from splatctrl_cli.kernels import Float64, Int64, native, num_threads

REVOLUTE, PRISMATIC = 0, 1


class Chain(NamedTuple):
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
        native.chain_centers(*self, np.ascontiguousarray(q), num_threads(threads), out)
        return out

    def jacobians(self, q: Float64) -> tuple[Float64, Float64]:
        """Sphere centres (S, 3) [m] and d centre / d q (S, 3, J), world, at q (J,)."""
        num = len(self.sphere_body)
        centers, jacobians = np.empty((num, 3)), np.empty((num, 3, len(q)))
        native.chain_jacobians(*self, np.ascontiguousarray(q), centers, jacobians)
        return centers, jacobians

    def frame(self, q: Float64, body: int, in_body: Float64) -> tuple[Float64, Float64]:
        """World pose (3, 4) of a frame at `in_body` in `body`, and its Jacobian (6, J)."""
        pose, jacobian = np.empty((3, 4)), np.empty((6, len(q)))
        native.chain_frame(*self, np.ascontiguousarray(q), body, in_body, pose, jacobian)
        return pose, jacobian


def pair_gaps(centers: Float64, radii: Float64, pairs: Int64) -> tuple[Float64, Float64]:
    """Gaps (P,) [m] of sphere surfaces, unit directions (P, 3) from second to first centre.

    centers (S, 3), radii (S,) [m]; pairs (P, 2). Zero direction where centres coincide.
    """
    gap, direction = np.empty(len(pairs)), np.empty((len(pairs), 3))
    native.pair_gaps(np.ascontiguousarray(centers), radii, pairs, gap, direction)
    return gap, direction


PART = 10  # most spheres that one ball skips together


@dataclass(frozen=True, kw_only=True)
class EdgeRoom:
    """An arm among solids; made by `of`.

    chain: its last K spheres are centres of body parts; balls of radius (K,) [m] around them contain the parts'
    sphere centres. moving (M,), pairs (P, 2) spheres, ordered by part; taken (R,) [m] off rows; levers (R, J)
    [m/rad]. groups (G, 4): first part, second part (-1: solids), first row, one past the last; group_taken (G,),
    group_levers (G, J): their rows' largest. balls (., 4): center, radius; boxes (., 15): rotation and shift from
    world, half sizes; rods (., 15): likewise, with radius, half length along z, padding.
    """

    chain: Chain
    moving: Int64
    pairs: Int64
    taken: Float64
    levers: Float64
    radius: Float64
    groups: Int64
    group_taken: Float64
    group_levers: Float64
    balls: Float64
    boxes: Float64
    rods: Float64

    @classmethod
    def of(cls, chain: Chain, moving: Int64, pairs: Int64, taken: Float64, levers: Float64) -> "EdgeRoom":
        """Make an arm without solids from rows in any order."""
        part, part_body, middles, radius = _parts(chain)
        between = np.concatenate(
            [np.stack([part[moving], np.full(len(moving), -1)], axis=1), part[pairs].reshape(-1, 2)]
        )
        is_pair = np.arange(len(between)) >= len(moving)
        order = np.lexsort((between[:, 1], between[:, 0], is_pair))
        between, taken, levers = between[order], taken[order], np.ascontiguousarray(levers[order])
        is_first = np.r_[True, np.any(between[1:] != between[:-1], axis=1)][: len(between)]
        first = np.flatnonzero(is_first)
        return cls(
            chain=chain._replace(
                sphere_body=np.concatenate([chain.sphere_body, part_body]),
                offset=np.concatenate([chain.offset, middles]),
            ),
            moving=moving[order[: len(moving)]],
            pairs=np.ascontiguousarray(pairs[order[len(moving) :] - len(moving)]),
            taken=taken,
            levers=levers,
            radius=radius,
            groups=np.column_stack([between[first], first, np.r_[first[1:], len(between)]]).astype(np.int64),
            group_taken=np.maximum.reduceat(taken, first),
            group_levers=np.maximum.reduceat(levers, first, axis=0),
            balls=np.empty((0, 4)),
            boxes=np.empty((0, 15)),
            rods=np.empty((0, 15)),
        )

    def among(self, balls: Float64, boxes: Float64, rods: Float64) -> "EdgeRoom":
        """Arm among other solids."""
        return replace(self, balls=balls, boxes=boxes, rods=rods)

    def advance(
        self,
        start: Float64,
        end: Float64,
        *,
        contact: float,
        give_up: float,
        rounding: float,
        still: float,
        only_whole: bool,
        threads: int = 1,
    ) -> tuple[Float64, Int64]:
        """Share (E,) proved free of edges start (E, J) to end (E, J), and checks (E,).

        A row whose value less `rounding` is below `contact` [m] collides; one that an edge does not move loses
        `still` [m] over it. Less than `give_up` [rad] before a collision stays unproved. With only_whole, other edges
        have share 0.
        """
        share, num_checks = np.empty(len(start)), np.empty(len(start), np.int64)
        native.advance_edges(
            *self.chain,
            self.moving,
            self.pairs,
            self.taken,
            self.levers,
            self.radius,
            self.groups,
            self.group_taken,
            self.group_levers,
            self.balls,
            self.boxes,
            self.rods,
            np.ascontiguousarray(start, dtype=np.float64),
            np.ascontiguousarray(end, dtype=np.float64),
            contact,
            give_up,
            rounding,
            still,
            only_whole,
            num_threads(threads),
            share,
            num_checks,
        )
        return share, num_checks


def _parts(chain: Chain) -> tuple[Int64, Int64, Float64, Float64]:
    """Part (S,) of each sphere; body (K,), middle (K, 3), radius (K,) [m] of each part."""
    part = np.empty(len(chain.sphere_body), np.int64)
    parts: list[tuple[int, Float64, float]] = []
    for body in np.unique(chain.sphere_body):
        for own in _split(chain.offset, np.flatnonzero(chain.sphere_body == body)):
            at = chain.offset[own]
            middle = (at.min(axis=0) + at.max(axis=0)) / 2
            part[own] = len(parts)
            parts.append((int(body), middle, float(np.linalg.norm(at - middle, axis=1).max())))
    middles = np.array([middle for _, middle, _ in parts]).reshape(-1, 3)
    radii = np.array([radius for _, _, radius in parts], np.float64)
    return part, np.array([body for body, _, _ in parts], np.int64), middles, radii


def _split(offset: Float64, spheres: Int64) -> list[Int64]:
    if len(spheres) <= PART:
        return [spheres]
    axis = int(np.argmax(np.ptp(offset[spheres], axis=0)))
    order = spheres[np.argsort(offset[spheres, axis], kind="stable")]
    half = len(order) // 2
    return [*_split(offset, order[:half]), *_split(offset, order[half:])]

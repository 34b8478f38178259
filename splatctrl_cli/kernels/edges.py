"""Straight edges in joint space proved free of solids and of the arm itself: a typed wrapper, numpy in, numpy out.

Shapes: E edges, J joints, R rows (M moving spheres, then P pairs). All float64.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import native, num_threads
from splatctrl_cli.kernels.chain import Chain

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class EdgeRoom:
    """An arm among solids.

    moving (M,), pairs (P, 2) spheres; taken (R,) [m] off each row; levers (J, R) [m/rad], C-contiguous. Solids are
    rows: balls (., 4) center and radius; boxes (., 15) the rotation and shift from world into their own axes and
    half sizes; rods (., 15) the same with radius, half length along z, and what is added to the surface all about.
    """

    chain: Chain
    moving: Int64
    pairs: Int64
    taken: Float64
    levers: Float64
    balls: Float64
    boxes: Float64
    rods: Float64

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
        """The share (E,) of edges start (E, J) to end (E, J) that is proved free from the start, and the postures
        (E,) that were asked.

        A row less `rounding` that is below `contact` [m] is in collision; one that an edge does not move is taken to
        lose `still` [m] over it. Less than `give_up` [rad] before a collision is left. Where only_whole, an edge that
        is not all free has share 0.
        """
        share, num_checks = np.empty(len(start)), np.empty(len(start), np.int64)
        native.advance_edges(
            self.chain.parent,
            self.chain.kind,
            self.chain.placement,
            self.chain.axis,
            self.chain.sphere_body,
            self.chain.offset,
            self.moving,
            self.pairs,
            self.taken,
            self.levers,
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

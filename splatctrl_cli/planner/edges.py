"""Conservative advancement: straight edges in joint space proved free everywhere, not only where they were sampled.

At a posture with row distances d, and with no row able to lose more than v over the whole edge, the edge is free for
d / v of its length to both sides. So the middle of what is not yet covered is asked, for all edges at once, until all
is covered or a posture is in collision. Shapes: E edges, J joints, R rows of the clearance.
"""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import SHORTEST_EDGE, STILL_ROW
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.solid_scene import Solids
from splatctrl_cli.records import Bool, Float64

ROUNDING = 1e-9  # [m] taken off every clearance: far above the rounding of the distances


@dataclass(frozen=True, kw_only=True)
class EdgeCheck:
    """What was proved of E edges: each is free from its start to `free_share` (E,) of its length (0 if not even the
    start was proved), num_checks postures were asked for all of them.
    """

    free_share: Float64
    num_checks: int

    @property
    def is_free(self) -> Bool:
        """(E,) True where the whole edge is proved free."""
        return self.free_share >= 1.0


def check_edges(
    clearance: Clearance,
    start: Float64,
    end: Float64,
    *,
    contact: float,
    give_up: float = 0.0,
    only_whole: bool = True,
) -> EdgeCheck:
    """Prove edges start (E, J) to end (E, J) free.

    A posture with less than `contact` [m] to go counts as in collision: it bounds the number of checks, and makes the
    check refuse edges that graze, never accept one that does not hold. Less than `give_up`
    [rad] before a collision is left unproved. Where `only_whole`, an edge is dropped at its first collision, and its
    free_share is 0.
    """
    if clearance.compiled is None or not isinstance(clearance.scene, Solids):
        return check_sampled_edges(clearance, start, end, contact=contact, give_up=give_up, only_whole=only_whole)
    share, num_checks = clearance.compiled.advance(
        start,
        end,
        contact=contact,
        give_up=max(give_up, SHORTEST_EDGE),
        rounding=ROUNDING,
        still=STILL_ROW,
        only_whole=only_whole,
    )
    return EdgeCheck(free_share=share, num_checks=int(num_checks.sum()))


def check_sampled_edges(
    clearance: Clearance, start: Float64, end: Float64, *, contact: float, give_up: float, only_whole: bool
) -> EdgeCheck:
    """`check_edges` by the clearance's own postures, of any scene: what the kernel is held to."""
    motion = end - start
    speeds = np.maximum(clearance.speeds(motion), STILL_ROW)
    length = np.linalg.norm(motion, axis=1)
    free = np.ones(len(start))
    edge, low, high = np.arange(len(start)), np.zeros(len(start)), np.ones(len(start))
    num_checks = 0
    while len(edge):
        middle = (low + high) / 2
        rows = clearance.rows(start[edge] + middle[:, None] * motion[edge]) - ROUNDING
        num_checks += len(edge)
        covered = np.min(rows / speeds[edge], axis=1)
        is_hit = np.min(rows, axis=1) < contact
        covered[is_hit] = 0.0
        np.minimum.at(free, edge[is_hit], 0.0 if only_whole else middle[is_hit])
        edge = np.concatenate([edge, edge])
        low, high = np.concatenate([low, middle + covered]), np.concatenate([middle - covered, high])
        high = np.minimum(high, free[edge])
        is_open = low < high
        is_last = (high >= free[edge]) & (free[edge] < 1.0)  # what is left before a collision
        is_short = is_open & is_last & ((high - low) * length[edge] < max(give_up, SHORTEST_EDGE))
        np.minimum.at(free, edge[is_short], 0.0 if only_whole else low[is_short])
        keep = is_open & ~is_short & (low < free[edge])
        edge, low, high = edge[keep], low[keep], high[keep]
    return EdgeCheck(free_share=free, num_checks=num_checks)

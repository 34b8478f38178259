"""The QP of III-E from its terms: the variables are the joint velocities and one slack per barrier row."""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.control.barriers import Barrier
from splatctrl_cli.control.limits import box_rows
from splatctrl_cli.control.qp import QuadraticProgram
from splatctrl_cli.control.tasks import Cost
from splatctrl_cli.records import Float64


def assemble_hard(
    costs: Sequence[Cost], lowest: Float64, highest: Float64, barriers: Sequence[Barrier]
) -> QuadraticProgram:
    """The program over v alone; rows: upper and lower box (2 J), barriers (M), none giving way. It may be infeasible.

    Where it has a solution and no barrier's multiplier exceeds its slack cost, that is the solution of `assemble`,
    with all slacks zero: an L1 penalty above the multipliers is exact, and the slacks' signs take the rest.
    """
    J = len(lowest)
    H, c = _objective(costs, J)
    G, h = box_rows(lowest, highest)
    rows = [barrier for barrier in barriers if len(barrier)]
    return QuadraticProgram(
        H=H, c=c, G=np.vstack([G, *(b.G for b in rows)]), h=np.concatenate([h, *(b.h for b in rows)])
    )


def _objective(costs: Sequence[Cost], J: int) -> tuple[Float64, Float64]:
    H, c = np.zeros((J, J)), np.zeros(J)
    for cost_H, cost_c in costs:
        H += cost_H
        c += cost_c
    return H, c


def assemble(
    costs: Sequence[Cost], lowest: Float64, highest: Float64, barriers: Sequence[Barrier]
) -> QuadraticProgram:
    """The program over ``z = (v, s)``; rows: upper and lower box (2 J), barriers (M), slack signs (M).

    The program always has a feasible point: the box is not empty and every barrier row has its own slack.
    """
    J, M = len(lowest), sum(len(barrier) for barrier in barriers)
    H, c = np.zeros((J + M, J + M)), np.zeros(J + M)
    H[:J, :J], c[:J] = _objective(costs, J)
    slack = np.arange(J, J + M)
    H[slack, slack] = np.concatenate([np.full(len(b), 2.0 * b.slack_weight) for b in barriers] or [np.zeros(0)])
    c[J:] = np.concatenate([np.full(len(b), b.slack_cost) for b in barriers] or [np.zeros(0)])
    G, h = np.zeros((2 * J + 2 * M, J + M)), np.zeros(2 * J + 2 * M)
    G[: 2 * J, :J], h[: 2 * J] = box_rows(lowest, highest)
    if M:
        rows = np.arange(2 * J, 2 * J + M)
        G[rows, :J] = np.vstack([barrier.G for barrier in barriers])
        G[rows, slack] = -1.0
        h[rows] = np.concatenate([barrier.h for barrier in barriers])
        G[rows + M, slack] = -1.0
    return QuadraticProgram(H=H, c=c, G=G, h=h)

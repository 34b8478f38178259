"""The program of III-E as printed, beside the reduced one that the controller solves otherwise.

``min over (v, x, e)  (u - x)' Q (u - x) + (x - J v)' R (x - J v) + e' S e`` with x the end-effector velocity, e one
slack per external row, of either sign, and ``x - J v`` the paper's delta_x, which its first constraint defines.
"""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.fallbacks import Choice, Rung, held, is_usable
from splatctrl_cli.control.limits import box_rows
from splatctrl_cli.control.qp import QpSolver, QuadraticProgram
from splatctrl_cli.control.terms import Barrier, Cost, State, configured_weights
from splatctrl_cli.records import Float64

PRINTED = "printed"


def assemble_printed(
    state: State, weights: tuple[Float64, Float64], posture: Cost, external: Barrier, firm: Sequence[Barrier]
) -> QuadraticProgram:
    """The program over ``z = (v, x, e)``; rows: upper and lower box (2 J), external rows (M), firm rows.

    As printed: an external row is ``grad d v >= -(d - epsilon) + e``, a self-collision row has no slack, nor has
    a row of a further term. weights: the diagonals (6,) of Q and R; posture is the "home pose bias" of III-E, without
    which seven joints on six dimensions are undetermined.
    """
    J, M = len(state.q), len(external)
    v, x, e = slice(0, J), slice(J, J + 6), slice(J + 6, J + 6 + M)
    H, c = np.zeros((J + 6 + M, J + 6 + M)), np.zeros(J + 6 + M)
    Q, R, A = np.diag(weights[0]), np.diag(weights[1]), state.jacobian
    H[v, v] = 2.0 * A.T @ R @ A + posture[0]
    H[v, x] = -2.0 * A.T @ R
    H[x, v] = H[v, x].T
    H[x, x] = 2.0 * (Q + R)
    H[e, e] = 2.0 * external.slack_weight * np.eye(M)
    c[v], c[x] = posture[1], -2.0 * Q @ state.reference
    num_rows = 2 * J + M + sum(len(rows) for rows in firm)
    G, h = np.zeros((num_rows, len(c))), np.zeros(num_rows)
    G[: 2 * J, v], h[: 2 * J] = box_rows(*state.box)
    rows, last = slice(2 * J, 2 * J + M), slice(2 * J + M, None)
    G[rows, v], G[rows, e], h[rows] = external.G, np.eye(M), external.h
    if firm:
        G[last, v], h[last] = np.concatenate([b.G for b in firm]), np.concatenate([b.h for b in firm])
    return QuadraticProgram(H=H, c=c, G=G, h=h)


def solve_printed(
    solver: QpSolver, state: State, posture: Cost, barriers: Sequence[Barrier], config: ControlConfig
) -> Choice:
    """The printed program's answer where it is solved and checks, else standstill: the paper has no second rung.

    slack is what a row gave way by, ``-e``; a row may also be asked for more than it needs, which costs.
    """
    external, *firm = barriers
    J, M, num_firm = len(state.q), len(external), sum(len(rows) for rows in firm)
    solution = solver.solve(assemble_printed(state, configured_weights(config), posture, external, firm))
    if not is_usable(solution, config.max_residual):
        return held(J, M + num_firm, solution, num_refused=1)
    slack = np.concatenate([np.maximum(-solution.z[J + 6 :], 0.0), np.zeros(num_firm)])
    return Choice(
        velocity=solution.z[:J],
        rung=Rung.RELAXED if np.any(slack > config.slack_tolerance) else Rung.SOLVED,
        slack=slack,
        box_multipliers=solution.multipliers[: 2 * J],
        row_multipliers=solution.multipliers[2 * J :],
        solution=solution,
        num_refused=0,
    )

"""The program of III-E as printed, beside the reduced one that the controller solves otherwise.

``min over (v, x, e)  (u - x)' Q (u - x) + (x - J v)' R (x - J v) + e' S e`` with x the end-effector velocity, e one
slack per external row, of either sign, and ``x - J v`` the paper's delta_x, which its first constraint defines.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config import Config, ControlConfig
from splatctrl_cli.control.barriers import Barrier
from splatctrl_cli.control.ladder import Choice, Rung, is_usable
from splatctrl_cli.control.limits import box_rows
from splatctrl_cli.control.qp import QpSolver, QuadraticProgram
from splatctrl_cli.control.tasks import Cost
from splatctrl_cli.records import Float64

PAPER = "paper"


def applied(config: ControlConfig) -> ControlConfig:
    """The configuration with the numbers that its preset fixes: as printed, every row has a gain of 1 per second."""
    return replace(config, barrier_gain=1.0) if config.preset == PAPER else config


def with_preset(config: Config) -> Config:
    """The whole configuration with its preset applied."""
    return replace(config, control=applied(config.control))


@dataclass(frozen=True, kw_only=True)
class PrintedTask:
    """The first two terms of III-E: reference u (6,), jacobian J (6, J), diagonals of Q and R (6,)."""

    reference: Float64
    jacobian: Float64
    weight_task: Float64
    weight_kinematics: Float64


def assemble_printed(
    task: PrintedTask,
    posture: Cost,
    box: tuple[Float64, Float64],
    external: Barrier,
    own: Barrier,
) -> QuadraticProgram:
    """The program over ``z = (v, x, e)``; rows: upper and lower box (2 J), external rows (M), self-collision rows.

    As printed: an external row is ``grad d v >= -(d - epsilon) + e``, a self-collision row has no slack. posture is
    the "home pose bias" of III-E, without which seven joints on six dimensions are undetermined.
    """
    J, M = len(box[0]), len(external)
    v, x, e = slice(0, J), slice(J, J + 6), slice(J + 6, J + 6 + M)
    H, c = np.zeros((J + 6 + M, J + 6 + M)), np.zeros(J + 6 + M)
    Q, R, A = np.diag(task.weight_task), np.diag(task.weight_kinematics), task.jacobian
    H[v, v] = 2.0 * A.T @ R @ A + posture[0]
    H[v, x] = -2.0 * A.T @ R
    H[x, v] = H[v, x].T
    H[x, x] = 2.0 * (Q + R)
    H[e, e] = 2.0 * external.slack_weight * np.eye(M)
    c[v], c[x] = posture[1], -2.0 * Q @ task.reference
    G, h = np.zeros((2 * J + M + len(own), len(c))), np.zeros(2 * J + M + len(own))
    G[: 2 * J, v], h[: 2 * J] = box_rows(*box)
    rows, last = slice(2 * J, 2 * J + M), slice(2 * J + M, None)
    G[rows, v], G[rows, e], h[rows] = external.G, np.eye(M), external.h
    G[last, v], h[last] = own.G, own.h
    return QuadraticProgram(H=H, c=c, G=G, h=h)


def solve_printed(
    solver: QpSolver,
    task: PrintedTask,
    posture: Cost,
    box: tuple[Float64, Float64],
    barriers: Sequence[Barrier],
    config: ControlConfig,
) -> Choice:
    """The printed program's answer where it is solved and checks, else standstill: the paper has no second rung.

    slack is what a row gave way by, ``-e``; a row may also be asked for more than it needs, which costs.
    """
    external, own = barriers
    J, M = len(box[0]), len(external)
    solution = solver.solve(assemble_printed(task, posture, box, external, own))
    if not is_usable(solution, config.max_residual):
        return Choice(
            velocity=np.zeros(J),
            rung=Rung.HOLD,
            slack=np.zeros(M + len(own)),
            box_multipliers=np.zeros(2 * J),
            row_multipliers=np.zeros(M + len(own)),
            solution=solution,
            num_refused=1,
        )
    slack = np.concatenate([np.maximum(-solution.z[J + 6 :], 0.0), np.zeros(len(own))])
    return Choice(
        velocity=solution.z[:J],
        rung=Rung.RELAXED if np.any(slack > config.slack_tolerance) else Rung.SOLVED,
        slack=slack,
        box_multipliers=solution.multipliers[: 2 * J],
        row_multipliers=solution.multipliers[2 * J :],
        solution=solution,
        num_refused=0,
    )

"""From the rows of III-E to a velocity: the first rung whose solution checks, down to standing still."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.limits import box_rows
from splatctrl_cli.control.qp import QpSolution, QpSolver, QuadraticProgram
from splatctrl_cli.control.terms import Barrier, Cost, stray_cost, summed
from splatctrl_cli.records import Float64


class Rung(StrEnum):
    """How a step came about."""

    SOLVED = "solved"
    RELAXED = "relaxed"
    MINIMUM_VIOLATION = "minimum-violation"
    HOLD = "hold"
    OUTSIDE = "outside"  # given by a controller that is not ours


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The ladder's answer: velocity (J,), slack (M,) of the barrier rows, multipliers of the box (2 J,) and of the
    barrier rows (M,); solution is the last that was asked for, num_refused how many were not used.
    """

    velocity: Float64
    rung: Rung
    slack: Float64
    box_multipliers: Float64
    row_multipliers: Float64
    solution: QpSolution
    num_refused: int


def is_usable(solution: QpSolution, max_residual: float) -> bool:
    """True for a solution that is exactly solved and whose residuals, computed by us, check."""
    return solution.is_solved and solution.residuals.worst <= max_residual


def descend(
    solver: QpSolver,
    costs: Sequence[Cost],
    box: tuple[Float64, Float64],
    barriers: Sequence[Barrier],
    config: ControlConfig,
) -> Choice:
    """Solved, or relaxed where a slack remains; else the least violation; else hold still.

    First without slacks, which is far smaller: where that is solved and no multiplier exceeds its row's slack cost,
    it is the answer. The programs with slacks have a feasible point by construction, so the lower rungs are for a
    solver that fails.
    """
    J, M = len(box[0]), sum(len(barrier) for barrier in barriers)
    firm = solver.solve(assemble_hard(costs, *box, barriers))
    price = np.concatenate([np.full(len(barrier), barrier.slack_cost) for barrier in barriers] or [np.zeros(0)])
    if is_usable(firm, config.max_residual) and bool(np.all(firm.multipliers[2 * J :] <= price)):
        return Choice(
            velocity=firm.z,
            rung=Rung.SOLVED,
            slack=np.zeros(M),
            box_multipliers=firm.multipliers[: 2 * J],
            row_multipliers=firm.multipliers[2 * J :],
            solution=firm,
            num_refused=0,
        )
    least_violation = [stray_cost(np.zeros(J), 1.0)]
    for num_refused, (rung, terms) in enumerate(((Rung.SOLVED, costs), (Rung.MINIMUM_VIOLATION, least_violation))):
        solution = solver.solve(assemble(terms, *box, barriers))
        if is_usable(solution, config.max_residual):
            slack = np.maximum(solution.z[J:], 0.0)
            has_given_way = bool(np.any(slack > config.slack_tolerance))
            return Choice(
                velocity=solution.z[:J],
                rung=Rung.RELAXED if rung is Rung.SOLVED and has_given_way else rung,
                slack=slack,
                box_multipliers=solution.multipliers[: 2 * J],
                row_multipliers=solution.multipliers[2 * J : 2 * J + M],
                solution=solution,
                num_refused=num_refused,
            )
    return held(J, M, solution, num_refused=2)


def held(num_joints: int, num_rows: int, solution: QpSolution, *, num_refused: int) -> Choice:
    """To hold still, because no solution is usable."""
    return Choice(
        velocity=np.zeros(num_joints),
        rung=Rung.HOLD,
        slack=np.zeros(num_rows),
        box_multipliers=np.zeros(2 * num_joints),
        row_multipliers=np.zeros(num_rows),
        solution=solution,
        num_refused=num_refused,
    )


def assemble_hard(
    costs: Sequence[Cost], lowest: Float64, highest: Float64, barriers: Sequence[Barrier]
) -> QuadraticProgram:
    """The program over v alone; rows: upper and lower box (2 J), barriers (M), none giving way. It may be infeasible.

    Where it has a solution and no barrier's multiplier exceeds its slack cost, that is the solution of `assemble`,
    with all slacks zero: an L1 penalty above the multipliers is exact, and the slacks' signs take the rest.
    """
    H, c = summed(costs)
    G, h = box_rows(lowest, highest)
    rows = [barrier for barrier in barriers if len(barrier)]
    return QuadraticProgram(
        H=H, c=c, G=np.vstack([G, *(b.G for b in rows)]), h=np.concatenate([h, *(b.h for b in rows)])
    )


def assemble(
    costs: Sequence[Cost], lowest: Float64, highest: Float64, barriers: Sequence[Barrier]
) -> QuadraticProgram:
    """The program over ``z = (v, s)``; rows: upper and lower box (2 J), barriers (M), slack signs (M).

    The program always has a feasible point: the box is not empty and every barrier row has its own slack.
    """
    J, M = len(lowest), sum(len(barrier) for barrier in barriers)
    H, c = np.zeros((J + M, J + M)), np.zeros(J + M)
    H[:J, :J], c[:J] = summed(costs)
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

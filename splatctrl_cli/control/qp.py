"""Quadratic programs, checked solvers, and the fallback ladder."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import clarabel
import daqp
import numpy as np
from scipy import sparse

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.terms import Barrier, Cost, box_rows, stray_cost, sum_costs
from splatctrl_cli.records import Float64


@dataclass(frozen=True, kw_only=True)
class QuadraticProgram:
    """``min 1/2 z' H z + c' z`` subject to ``G z <= h``.

    H (V, V) symmetric, c (V,), G (M, V), h (M,).
    """

    H: Float64
    c: Float64
    G: Float64
    h: Float64


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """KKT residuals: primal in the rows' units, dual and gap relative to the terms' size."""

    primal: float
    dual: float
    gap: float

    @property
    def worst(self) -> float:
        return max(self.primal, self.dual, self.gap)


@dataclass(frozen=True, kw_only=True)
class QpSolution:
    """z (V,), row multipliers (M,) >= 0, the solver's status, and our residuals."""

    z: Float64
    multipliers: Float64
    status: str
    is_solved: bool
    residuals: Residuals


QpSolver = Callable[[QuadraticProgram], QpSolution]
"""A non-finite program is unsolved. `is_solved` is True only if the solver's status is exactly solved."""


def residuals(program: QuadraticProgram, z: Float64, multipliers: Float64) -> Residuals:
    """A candidate's KKT residuals; infinite for a non-finite candidate."""
    if not (np.all(np.isfinite(z)) and np.all(np.isfinite(multipliers))):
        return Residuals(primal=np.inf, dual=np.inf, gap=np.inf)
    Hz, Gy = program.H @ z, program.G.T @ multipliers
    primal = max(float(np.max(program.G @ z - program.h, initial=0.0)), 0.0)
    negative = float(np.max(-multipliers, initial=0.0))
    scale = 1.0 + max(float(np.max(np.abs(v), initial=0.0)) for v in (Hz, program.c, Gy))
    dual = max(float(np.max(np.abs(Hz + program.c + Gy))), negative) / scale
    quadratic, linear, bound = float(z @ Hz), float(program.c @ z), float(program.h @ multipliers)
    gap = abs(quadratic + linear + bound) / (1.0 + abs(quadratic) + abs(linear) + abs(bound))
    return Residuals(primal=primal, dual=dual, gap=gap)


def solve_clarabel(program: QuadraticProgram, *, tolerance: float | None = None) -> QpSolution:
    """Solve by Clarabel, an interior point method, on one thread for identical bits.

    tolerance: of feasibility, gap and linear refinement (default: Clarabel's, 1e-8).
    """
    if not is_finite(program):
        return unsolved(len(program.c), len(program.h), "NotFinite")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.presolve_enable = False  # every row keeps its multiplier
    if tolerance is not None:
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = tolerance
        settings.iterative_refinement_reltol = settings.iterative_refinement_abstol = 0.1 * tolerance
        settings.iterative_refinement_max_iter = 30
    H, G = sparse.csc_matrix(np.triu(program.H)), sparse.csc_matrix(program.G)
    answer = clarabel.DefaultSolver(
        H, program.c, G, program.h, [clarabel.NonnegativeConeT(len(program.h))], settings
    ).solve()
    z, multipliers = np.asarray(answer.x), np.asarray(answer.z)
    return QpSolution(
        z=z,
        multipliers=multipliers,
        status=str(answer.status),
        is_solved=answer.status == clarabel.SolverStatus.Solved,
        residuals=residuals(program, z, multipliers),
    )


DAQP_TOLERANCE = 1e-10  # [of the rows' own units]
DAQP_STATUS: Mapping[int, str] = {
    1: "Optimal",
    -1: "Infeasible",
    -2: "Cycling",
    -3: "Unbounded",
    -4: "IterationLimit",
    -5: "NonConvex",
    -6: "Overdetermined",
}


def solve_daqp(program: QuadraticProgram) -> QpSolution:
    """Solve by DAQP, a dual active-set method: exact to rounding, several times faster than Clarabel."""
    if not is_finite(program):
        return unsolved(len(program.c), len(program.h), "NotFinite")
    arrays = (np.ascontiguousarray(a) for a in (program.H, program.c, program.G, program.h))
    z, _, flag, info = daqp.solve(*arrays, primal_tol=DAQP_TOLERANCE)
    z, multipliers = np.array(z), np.array(info["lam"])
    return QpSolution(
        z=z,
        multipliers=multipliers,
        status=DAQP_STATUS.get(flag, f"exit flag {flag}"),
        is_solved=flag == 1,
        residuals=residuals(program, z, multipliers),
    )


SOLVERS: Mapping[str, QpSolver] = {"clarabel": solve_clarabel, "daqp": solve_daqp}


def is_finite(program: QuadraticProgram) -> bool:
    return all(bool(np.isfinite(a).all()) for a in (program.H, program.c, program.G, program.h))


def unsolved(num_variables: int, num_rows: int, status: str) -> QpSolution:
    return QpSolution(
        z=np.full(num_variables, np.nan),
        multipliers=np.full(num_rows, np.nan),
        status=status,
        is_solved=False,
        residuals=Residuals(primal=np.inf, dual=np.inf, gap=np.inf),
    )


class Rung(StrEnum):
    """The program that gave a step, from best to last resort."""

    SOLVED = "solved"
    RELAXED = "relaxed"
    MINIMUM_VIOLATION = "minimum-violation"
    HOLD = "hold"
    OUTSIDE = "outside"  # from an external controller


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The fallback ladder's answer.

    velocity (J,); slack (M,) of barrier rows; multipliers of the box (2 J,) and barrier rows (M,); solution: the
    last one computed; num_refused: number of unusable solutions with slacks.
    """

    velocity: Float64
    rung: Rung
    slack: Float64
    box_multipliers: Float64
    row_multipliers: Float64
    solution: QpSolution
    num_refused: int


def is_usable(solution: QpSolution, max_residual: float) -> bool:
    """True for a solution reported solved, with residuals up to `max_residual`."""
    return solution.is_solved and solution.residuals.worst <= max_residual


def descend(
    solver: QpSolver,
    costs: Sequence[Cost],
    box: tuple[Float64, Float64],
    barriers: Sequence[Barrier],
    config: ControlConfig,
) -> Choice:
    """Solve the program, else minimise the rows' violation, else stand still.

    The program without slacks is solved first. Its solution counts if no multiplier exceeds its row's slack cost.
    Else rows get slacks, which always makes it feasible. RELAXED means that a slack remains.
    """
    J, M = len(box[0]), sum(len(barrier) for barrier in barriers)
    firm = solver(assemble_hard(costs, *box, barriers))
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
        solution = solver(assemble(terms, *box, barriers))
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
    return stand_still(J, M, solution, num_refused=2)


def stand_still(num_joints: int, num_rows: int, solution: QpSolution, *, num_refused: int) -> Choice:
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
    """Program over v alone, which may be infeasible.

    Rows: upper, lower box limits (2 J), barriers (M). If no barrier's multiplier exceeds its slack cost, the solution
    solves `assemble`, too: an L1 penalty above the multipliers is exact.
    """
    H, c = sum_costs(costs)
    G, h = box_rows(lowest, highest)
    rows = [barrier for barrier in barriers if len(barrier)]
    return QuadraticProgram(
        H=H, c=c, G=np.vstack([G, *(b.G for b in rows)]), h=np.concatenate([h, *(b.h for b in rows)])
    )


def assemble(
    costs: Sequence[Cost], lowest: Float64, highest: Float64, barriers: Sequence[Barrier]
) -> QuadraticProgram:
    """Program over ``z = (v, s)``, always feasible.

    Rows: upper, lower box limits (2 J), barriers (M), ``s >= 0`` (M).
    """
    J, M = len(lowest), sum(len(barrier) for barrier in barriers)
    H, c = np.zeros((J + M, J + M)), np.zeros(J + M)
    H[:J, :J], c[:J] = sum_costs(costs)
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

"""Quadratic programs, and solvers whose answer is used only when it is solved and its residuals check."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import clarabel
import daqp
import numpy as np
from scipy import sparse

from splatctrl_cli.records import Float64


@dataclass(frozen=True, kw_only=True)
class QuadraticProgram:
    """``min 1/2 z' H z + c' z`` subject to ``G z <= h``; H (V, V) symmetric, c (V,), G (M, V), h (M,)."""

    H: Float64
    c: Float64
    G: Float64
    h: Float64


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """How far (z, y) is from optimal: primal in the rows' own units, dual and gap relative to the terms' size."""

    primal: float
    dual: float
    gap: float

    @property
    def worst(self) -> float:
        return max(self.primal, self.dual, self.gap)


@dataclass(frozen=True, kw_only=True)
class QpSolution:
    """z (V,), row multipliers (M,) >= 0, the solver's own status word, and residuals that we computed."""

    z: Float64
    multipliers: Float64
    status: str
    is_solved: bool
    residuals: Residuals
    iterations: int


class QpSolver(Protocol):
    """Solves a QuadraticProgram; `is_solved` only if the solver says exactly so, residuals always ours."""

    def solve(self, program: QuadraticProgram) -> QpSolution: ...


def residuals(program: QuadraticProgram, z: Float64, multipliers: Float64) -> Residuals:
    """The KKT residuals of a candidate; infinite where it is not finite."""
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


class ClarabelSolver:
    """Clarabel, an interior point method; one thread, so that the same program gives the same bits."""

    def __init__(self, *, tolerance: float | None = None) -> None:
        """tolerance: of feasibility, gap and the refinement of each linear solve (default: Clarabel's own, 1e-8)."""
        self._settings = clarabel.DefaultSettings()
        self._settings.verbose = False
        self._settings.max_threads = 1
        self._settings.presolve_enable = False  # every row keeps its multiplier
        if tolerance is not None:
            self._settings.tol_feas = self._settings.tol_gap_abs = self._settings.tol_gap_rel = tolerance
            self._settings.iterative_refinement_reltol = self._settings.iterative_refinement_abstol = 0.1 * tolerance
            self._settings.iterative_refinement_max_iter = 30

    def solve(self, program: QuadraticProgram) -> QpSolution:
        """Solve; a program whose numbers are not finite comes back unsolved."""
        num_rows = len(program.h)
        if not is_finite(program):
            return unsolved(len(program.c), len(program.h), "NotFinite")
        solver = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(program.H)),
            program.c,
            sparse.csc_matrix(program.G),
            program.h,
            [clarabel.NonnegativeConeT(num_rows)],
            self._settings,
        )
        answer = solver.solve()
        z, multipliers = np.asarray(answer.x), np.asarray(answer.z)
        return QpSolution(
            z=z,
            multipliers=multipliers,
            status=str(answer.status),
            is_solved=answer.status == clarabel.SolverStatus.Solved,
            residuals=residuals(program, z, multipliers),
            iterations=int(answer.iterations),
        )


class DaqpSolver:
    """DAQP, a dual active-set method: exact to rounding on programs of this size, and several times as fast."""

    PRIMAL_TOLERANCE = 1e-10  # [of the rows' own units]
    STATUS: Mapping[int, str] = {
        1: "Optimal",
        -1: "Infeasible",
        -2: "Cycling",
        -3: "Unbounded",
        -4: "IterationLimit",
        -5: "NonConvex",
        -6: "Overdetermined",
    }

    def solve(self, program: QuadraticProgram) -> QpSolution:
        """Solve; a program whose numbers are not finite comes back unsolved."""
        if not is_finite(program):
            return unsolved(len(program.c), len(program.h), "NotFinite")
        z, _, flag, info = daqp.solve(
            np.ascontiguousarray(program.H),
            np.ascontiguousarray(program.c),
            np.ascontiguousarray(program.G),
            np.ascontiguousarray(program.h),
            primal_tol=self.PRIMAL_TOLERANCE,
        )
        z, multipliers = np.array(z), np.array(info["lam"])
        return QpSolution(
            z=z,
            multipliers=multipliers,
            status=self.STATUS.get(flag, f"exit flag {flag}"),
            is_solved=flag == 1,
            residuals=residuals(program, z, multipliers),
            iterations=int(info["iterations"]),
        )


SOLVERS: Mapping[str, Callable[[], QpSolver]] = {"clarabel": ClarabelSolver, "daqp": DaqpSolver}


def is_finite(program: QuadraticProgram) -> bool:
    return all(bool(np.isfinite(a).all()) for a in (program.H, program.c, program.G, program.h))


def unsolved(num_variables: int, num_rows: int, status: str) -> QpSolution:
    """A solution that says why there is none."""
    return QpSolution(
        z=np.full(num_variables, np.nan),
        multipliers=np.full(num_rows, np.nan),
        status=status,
        is_solved=False,
        residuals=Residuals(primal=np.inf, dual=np.inf, gap=np.inf),
        iterations=0,
    )

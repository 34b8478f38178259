"""The QP of random steps by both solvers, and by CVXPY if installed.

The programs are those of an arm of seven joints with up to 40 barrier rows, some of which contradict each other.
"""

import importlib.util
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.measure import Options, Result, seconds
from splatctrl_cli.control.qp import QpSolver, QuadraticProgram, assemble, solve_clarabel, solve_daqp
from splatctrl_cli.control.terms import Barrier, reach_cost, stray_cost
from splatctrl_cli.records import Float64

JOINTS, SPEED, MAX_ROWS = 7, 1.0, 40
NUM_STEPS, CVXPY_EVERY = 10_000, 50


def run(options: Options) -> Result:
    """How far the solvers are apart, and how long they take."""
    rng, num = np.random.default_rng(0), NUM_STEPS // (50 if options.is_quick else 1)
    programs = [random_program(rng) for _ in range(num)]
    solvers: dict[str, QpSolver] = {
        "daqp": solve_daqp,
        "clarabel": solve_clarabel,
        "clarabel, tolerance 1e-14": partial(solve_clarabel, tolerance=1e-14),
    }
    exact, rows = [solvers["daqp"](program) for program in programs], []
    for name, solver in solvers.items():
        answers, times = [], []
        for program in programs:
            start = time.perf_counter()
            answers.append(solver(program))
            times.append(time.perf_counter() - start)
        compared = zip(programs, exact, answers, strict=True)
        apart = np.array([differences(p, e.z, a.z) for p, e, a in compared if a.is_solved])
        solved = sum(answer.is_solved for answer in answers)
        rows.append(
            [name, str(solved), *[f"{v:.1e}" for v in apart.max(axis=0)], f"{1e6 * statistics.median(times):.0f}"]
        )
    return Result(
        title=f"solvers: {num} programs; apart from daqp, at most: relative objective, joint velocity",
        columns=("solver", "solved", "objective apart", "velocity apart [rad/s]", "median [us]"),
        rows=rows,
        notes=[_beside_cvxpy(programs[::CVXPY_EVERY])],
    )


def random_program(rng: np.random.Generator) -> QuadraticProgram:
    """One step's program."""
    jacobian, velocity = rng.normal(size=(6, JOINTS)), 0.3 * rng.normal(size=6)
    costs = [reach_cost(jacobian, velocity, rng.uniform(1, 9, 6)), stray_cost(np.full(JOINTS, 0.1), 1e-3)]
    num_rows = int(rng.integers(0, MAX_ROWS))
    bound = rng.uniform(-0.2, 0.6, num_rows)
    rows = Barrier(
        index=np.arange(num_rows),
        G=0.4 * rng.normal(size=(num_rows, JOINTS)),
        h=bound,
        distance=bound,
        slack_cost=1e3,
        slack_weight=100.0,
    )
    return assemble(costs, np.full(JOINTS, -SPEED), np.full(JOINTS, SPEED), [rows])


def differences(program: QuadraticProgram, exact: Float64, other: Float64) -> tuple[float, float]:
    """Relative difference of the objectives, and the largest of the joint velocities [rad/s]."""
    values = [float(0.5 * z @ program.H @ z + program.c @ z) for z in (exact, other)]
    return abs(values[0] - values[1]) / (1 + abs(values[0])), float(np.abs(exact - other)[:JOINTS].max())


def _beside_cvxpy(programs: list[QuadraticProgram]) -> str:
    if importlib.util.find_spec("cvxpy") is None:
        return "CVXPY is not installed: not compared"
    times = [seconds(_cvxpy_task(program)) for program in programs]
    took = f"{1e6 * statistics.median(times):.0f} us (median of {len(programs)})"
    return f"CVXPY's own formulation with Clarabel: {took}"


def _cvxpy_task(program: QuadraticProgram) -> Callable[[], object]:
    import cvxpy

    def solve() -> object:
        z = cvxpy.Variable(len(program.c))
        objective = 0.5 * cvxpy.quad_form(z, cvxpy.psd_wrap(program.H)) + program.c @ z
        return cvxpy.Problem(cvxpy.Minimize(objective), [program.G @ z <= program.h]).solve(solver="CLARABEL")

    return solve

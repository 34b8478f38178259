"""OMPL's RRTConnect on the planner's problems, if installed: `pip install ompl`, only for this benchmark.

It calls the same clearance from Python in two ways. OMPL's own edge check calls it for one state at a time, at fixed
steps. Conservative advancement calls it once for a whole edge, as our planner does.
"""

import importlib.util
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np

from experiments.drawn_task import solids_of
from experiments.paths import joint_length
from experiments.problems import Problem
from splatctrl_cli.config import PlannerConfig
from splatctrl_cli.planner.configuration_clearance import Clearance, check_edges
from splatctrl_cli.planner.planned import resample
from splatctrl_cli.records import Float64

STEP, FINE = 0.05, 0.01  # [rad] of OMPL's edge check, and of the recheck
MAX_TIME = 10.0  # [s]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A path (W, J), CPU seconds to the first path and with OMPL's simplification, and calls into Python. num_hit:
    edges of the path that fine samples find in collision.
    """

    path: Float64
    search: float
    total: float
    num_calls: int
    num_hit: int


def notes_beside_ompl(clearance: Clearance, problems: Sequence[Problem]) -> list[str]:
    """A line for each way to check edges, or one line if OMPL is not installed."""
    if importlib.util.find_spec("ompl") is None:
        return ["OMPL is not installed: not compared"]
    from ompl import util

    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(1)
    rooms = [(problem, clearance.replace_scene(solids_of(problem.things))) for problem in problems]
    valid = [(p, room) for p, room in rooms if min(room.at(np.array([p.start, p.goal]))) > 0]
    notes = []
    for way, by_edges in (("states", False), ("edges", True)):
        answers = [solved(problem, room, by_edges=by_edges) for problem, room in valid]
        found = [answer for answer in answers if answer is not None]
        notes.append(
            f"OMPL RRTConnect, {way} checked from Python: {len(found)}/{len(valid)} solved, "
            f"{sum(a.num_hit > 0 for a in found)} paths with an edge in collision at {FINE} rad, medians "
            f"{1e3 * statistics.median(a.search for a in found):.0f} ms CPU to the first path, "
            f"{1e3 * statistics.median(a.total for a in found):.0f} with simplification, "
            f"{statistics.median(a.num_calls for a in found):.0f} calls, "
            f"mean path {statistics.mean(joint_length(a.path) for a in found):.2f} rad"
        )
    return notes


def solved(problem: Problem, room: Clearance, *, by_edges: bool) -> Answer | None:
    """What OMPL finds, simplified; None within no `MAX_TIME`."""
    from ompl import base, geometric

    J, contact, calls = len(room.model.lower), PlannerConfig().contact, [0]

    def is_free(start: Float64, end: Float64) -> bool:
        calls[0] += 1
        return bool(check_edges(room, start[None], end[None], contact=contact).is_free[0])

    class Edges(base.MotionValidator):
        def checkMotion(self, a: Any, b: Any, last: Any = None) -> bool:
            return is_free(_posture(a, J), _posture(b, J))

    space, bounds = base.RealVectorStateSpace(J), base.RealVectorBounds(J)
    for j in range(J):
        bounds.setLow(j, float(room.model.lower[j]))
        bounds.setHigh(j, float(room.model.upper[j]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: is_free(_posture(state, J), _posture(state, J)))
    about = setup.getSpaceInformation()
    about.setStateValidityCheckingResolution(STEP / space.getMaximumExtent())
    validator = Edges(about)
    if by_edges:
        about.setMotionValidator(validator)
    ends = [space.allocState() for _ in range(2)]
    for end, q in zip(ends, (problem.start, problem.goal), strict=True):
        for j in range(J):
            end[j] = float(q[j])
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(about))
    began = process_time()
    setup.solve(MAX_TIME)
    search = process_time() - began
    if not setup.haveExactSolutionPath():
        return None
    setup.simplifySolution()
    total = process_time() - began
    path = np.array([_posture(state, J) for state in setup.getSolutionPath().getStates()])
    num_hit = sum(bool(np.min(room.at(resample(path[i : i + 2], FINE))) < 0) for i in range(len(path) - 1))
    return Answer(path=path, search=search, total=total, num_calls=calls[0], num_hit=num_hit)


def _posture(state: Any, num_joints: int) -> Float64:
    return np.array([state[j] for j in range(num_joints)])

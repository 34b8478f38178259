"""The planner on the 350 Panda problems of MotionBenchMaker, and its edge check against fixed steps."""

import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np

from benchmarks.measure import Limit, Options, Result
from benchmarks.ompl_planner import notes_beside_ompl
from experiments.drawn_task import solids_of
from experiments.paths import effector_length, joint_length, least_clearance
from experiments.problems import Problem, panda, read_archive
from experiments.tracking import follow_joints, follow_with_controller
from splatctrl_cli.config import ControlConfig, PlannerConfig
from splatctrl_cli.control.goals import TimedPath, pose_error
from splatctrl_cli.control.replay import is_at_goal
from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.planner.birrt import Plan, plan
from splatctrl_cli.planner.configuration_clearance import Clearance, check_edges
from splatctrl_cli.planner.planned import resample, time_path
from splatctrl_cli.records import Bool, Float64

FRAME = "panda_grasptarget"
ROBOT = Path("vamp_panda/resources/panda")  # the Panda with its 59 spheres, and the archive
FINE, COARSE = 0.01, 0.05  # [rad] of the recheck, and of the fixed steps compared with
NUM_EDGES = 40  # random edges per scene, for the comparison with fixed steps
EVERY_TRACKED = 25  # problems per one that is followed


@dataclass(frozen=True, kw_only=True)
class Solved:
    """A problem, its plan, CPU seconds, number of path edges that fine samples find in collision, and figures."""

    problem: Problem
    plan: Plan
    cpu: float
    num_hit: int
    clearance: float
    effector: tuple[float, float]


def run(options: Options) -> Result:
    """Solve all problems, recheck every edge of every path at 0.01 rad, and list unsolved problems."""
    root = os.environ.get("SPLATCTRL_REAL_DATA")
    if root is None or not (Path(root) / ROBOT).is_dir():
        return _skipped()
    model = panda(Path(root) / ROBOT)
    problems = read_archive(Path(root) / ROBOT, model)[:: 10 if options.is_quick else 1]
    clearance = Clearance.of(model, solids_of(problems[0].things))
    solved: list[Solved] = []
    failed, invalid = [], []
    for problem in problems:
        room = clearance.replace_scene(solids_of(problem.things))
        start = process_time()
        try:
            answer = plan(room, problem.start, problem.goal, PlannerConfig())
        except SplatCtrlError as error:
            invalid.append(f"{_name(problem)}: {error.message}")
            continue
        if not answer.is_solved:
            failed.append(f"{_name(problem)}: {answer.outcome} after {answer.num_iterations} iterations")
            continue
        solved.append(_solved(problem, answer, process_time() - start, room))
    runs = [_followed(s, clearance.replace_scene(solids_of(s.problem.things))) for s in solved[::EVERY_TRACKED]]
    edges = _edge_checks(clearance, problems[::10])
    notes = notes_beside_ompl(clearance, problems if options.is_quick else problems[::10])
    return _result(solved, failed, invalid, edges, runs, notes)


def _name(problem: Problem) -> str:
    return f"{problem.environment} {problem.number:04d}"


def _solved(problem: Problem, answer: Plan, cpu: float, room: Clearance) -> Solved:
    path = answer.waypoints
    num_hit = sum(bool(np.min(room.at(resample(path[i : i + 2], FINE))) < 0) for i in range(len(path) - 1))
    return Solved(
        problem=problem,
        plan=answer,
        cpu=cpu,
        num_hit=num_hit,
        clearance=least_clearance(room, path).lower,
        effector=effector_length(room.model, resample(path, COARSE), FRAME),
    )


@dataclass(frozen=True, kw_only=True)
class Followed:
    """Figures of a path that was followed: effector [m], [degrees]; joint_length [rad]; least_clearance [m]."""

    is_success: bool
    joint_length: float
    effector: tuple[float, float]
    least_clearance: float
    duration: float


def _followed(solved: Solved, room: Clearance) -> tuple[Followed, Followed]:
    """Figures of the path followed in joint space, and by QP-IK without a margin."""
    planner, control = PlannerConfig(), ControlConfig(margin=0.0, self_margin=0.0, max_time=60.0, solver="daqp")
    path = time_path(solved.plan.waypoints, room.model.velocity_limit, planner.max_acceleration)
    slow = time_path(solved.plan.waypoints, room.model.velocity_limit / 4, planner.max_acceleration)
    joints, scene = follow_joints(path, room.model, control), solids_of(solved.problem.things)
    guided, _ = follow_with_controller(slow, room.model, lambda stamp_ns: scene, FRAME, planner, control)
    return _figures(joints, path, room, control), _figures(guided, slow, room, control)


def _figures(position: Float64, path: TimedPath, room: Clearance, control: ControlConfig) -> Followed:
    """Figures of a followed path; success means that the goal was reached without a posture in collision."""
    model, least = room.model, float(np.min(room.at(position)))
    error = pose_error(model.frame_pose(position[-1], FRAME), model.frame_pose(path.waypoints[-1], FRAME))
    return Followed(
        is_success=is_at_goal(error, control) and least > 0,
        joint_length=joint_length(position),
        effector=effector_length(model, position, FRAME),
        least_clearance=least,
        duration=control.period * (len(position) - 1),
    )


def _edge_checks(clearance: Clearance, problems: Sequence[Problem]) -> dict[str, float]:
    """Checks per edge and false accepts of advancement and of fixed steps, on random edges of 0.3 to 1.5 rad.

    Fixed steps are taken in order from the start and end at the first collision. The truth is 1 mrad sampling.
    """
    random = np.random.default_rng(0)
    counts = dict.fromkeys(("edges", "free", "checks", "false", "fixed_checks", "fixed_false", "refused"), 0)
    for problem in problems:
        room, model = clearance.replace_scene(solids_of(problem.things)), clearance.model
        start = _free_postures(room, random)
        way = random.normal(size=start.shape)
        way *= random.uniform(0.3, 1.5, (len(way), 1)) / np.linalg.norm(way, axis=1, keepdims=True)
        end = np.clip(start + way, model.lower, model.upper)
        check = check_edges(room, start, end, contact=PlannerConfig().contact)
        truth = np.array([np.min(room.at(resample(np.array(e), 1e-3))) >= 0 for e in zip(start, end, strict=True)])
        fixed, num_fixed = _fixed_steps(room, start, end)
        counts["edges"] += len(start)
        counts["free"] += int(truth.sum())
        counts["checks"] += check.num_checks
        counts["fixed_checks"] += num_fixed
        counts["false"] += int(np.sum(check.is_free & ~truth))
        counts["fixed_false"] += int(np.sum(fixed & ~truth))
        counts["refused"] += int(np.sum(~check.is_free & truth))
    return {key: float(value) for key, value in counts.items()}


def _free_postures(room: Clearance, random: np.random.Generator) -> Float64:
    """`NUM_EDGES` random postures (NUM_EDGES, J) that are free."""
    model = room.model
    q = random.uniform(model.lower, model.upper, (40 * NUM_EDGES, len(model.lower)))
    return q[room.at(q) > 0][:NUM_EDGES]


def _fixed_steps(room: Clearance, start: Float64, end: Float64) -> tuple[Bool, int]:
    """Edges that samples `COARSE` apart find free, and the number of samples."""
    is_free, num_checks = np.ones(len(start), dtype=bool), 0
    for e, edge in enumerate(zip(start, end, strict=True)):
        is_hit = room.at(resample(np.array(edge), COARSE)[1:]) < 0
        is_free[e] = not np.any(is_hit)
        num_checks += int(np.argmax(is_hit)) + 1 if np.any(is_hit) else len(is_hit)
    return is_free, num_checks


def _skipped() -> Result:
    return Result(
        title="planner: skipped",
        columns=("", ""),
        rows=[],
        figures={},
        notes=["set SPLATCTRL_REAL_DATA to a folder with vamp_panda to solve its 350 problems"],
    )


def _result(
    solved: Sequence[Solved],
    failed: Sequence[str],
    invalid: Sequence[str],
    edges: dict[str, float],
    runs: Sequence[tuple[Followed, Followed]],
    notes: Sequence[str],
) -> Result:
    families = sorted({s.problem.environment for s in solved})
    groups = {name: [s for s in solved if s.problem.environment == name] for name in families} | {"all": list(solved)}
    times = [s.plan.search_time + s.plan.shortcut_time for s in solved]
    num_valid = len(solved) + len(failed)
    num_hit = sum(s.num_hit for s in solved)
    return Result(
        title=f"planner: {num_valid} valid problems of {num_valid + len(invalid)}, {len(solved)} solved",
        columns=(
            "family", "solved", "first path [ms]", "with shortcuts [ms]", "95 %", "CPU [ms]", "checks",
            "path [rad]", "[m]", "[deg]", "least clearance [mm]",
        ),
        rows=[_row(name, group, failed) for name, group in groups.items() if group],
        figures={
            "solved_share": len(solved) / max(num_valid, 1),
            "edges_in_collision": float(num_hit),
            "search_ms": 1e3 * statistics.median(s.plan.search_time for s in solved),
            "plan_ms": 1e3 * statistics.median(times),
            "plan_95_ms": 1e3 * float(np.percentile(times, 95)),
            "plan_cpu_ms": 1e3 * statistics.median(s.cpu for s in solved),
            "checks": statistics.median(s.plan.num_checks for s in solved),
            **{f"edge_{key}": value for key, value in edges.items()},
        },
        limits=[
            Limit(figure="solved_share", bound=0.99, is_least=True),
            Limit(figure="edges_in_collision", bound=0.0),
            Limit(figure="edge_false", bound=0.0),
            Limit(figure="plan_ms", bound=50.0),
        ],
        notes=[
            *_edge_notes(edges), *notes, *_tracking_notes(runs),
            *_named("not solved", failed), *_named("not valid", invalid),
        ],
    )  # fmt: skip


def _row(name: str, group: Sequence[Solved], failed: Sequence[str]) -> list[str]:
    num_failed = sum(name in ("all", line.partition(" ")[0]) for line in failed)
    total = [1e3 * (s.plan.search_time + s.plan.shortcut_time) for s in group]
    return [
        name,
        f"{len(group)}/{len(group) + num_failed}",
        f"{1e3 * statistics.median(s.plan.search_time for s in group):.0f}",
        f"{statistics.median(total):.0f}",
        f"{np.percentile(total, 95):.0f}",
        f"{1e3 * statistics.median(s.cpu for s in group):.0f}",
        f"{statistics.median(s.plan.num_checks for s in group):.0f}",
        f"{statistics.mean(joint_length(s.plan.waypoints) for s in group):.2f}",
        f"{statistics.mean(s.effector[0] for s in group):.2f}",
        f"{statistics.mean(s.effector[1] for s in group):.0f}",
        f"{1e3 * statistics.median(s.clearance for s in group):.1f}",
    ]


def _edge_notes(edges: dict[str, float]) -> list[str]:
    num = max(edges["edges"], 1.0)
    return [
        f"{num:.0f} random edges, {edges['free']:.0f} of them free at 1 mrad: advancement "
        f"{edges['checks'] / num:.1f} checks per edge, {edges['false']:.0f} false accepts, "
        f"{edges['refused']:.0f} free ones refused; steps of {COARSE} rad {edges['fixed_checks'] / num:.1f} checks, "
        f"{edges['fixed_false']:.0f} false accepts"
    ]


def _tracking_notes(runs: Sequence[tuple[Followed, Followed]]) -> list[str]:
    notes = []
    for way, kind in (("in joint space", 0), ("by QP-IK, a quarter of the speed, no margin", 1)):
        chosen = [pair[kind] for pair in runs]
        good = [r for r in chosen if r.is_success]
        if good:
            notes.append(
                f"followed {way}: {len(good)}/{len(chosen)} succeed, means of these: "
                f"{statistics.mean(r.joint_length for r in good):.2f} rad, "
                f"{statistics.mean(r.effector[0] for r in good):.2f} m, "
                f"{statistics.mean(r.effector[1] for r in good):.0f} deg, "
                f"least clearance {1e3 * statistics.mean(r.least_clearance for r in good):.1f} mm, "
                f"{statistics.mean(r.duration for r in good):.1f} s"
            )
    return notes


def _named(what: str, lines: Sequence[str]) -> list[str]:
    return [f"{what}: {line}" for line in lines]

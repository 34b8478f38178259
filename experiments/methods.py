"""The methods of ``--baseline`` beside the closed loop and the log: one task, one scene, one table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.audit import DistanceFunction
from splatctrl_cli.control.goals import PlanDetour
from splatctrl_cli.control.open_loop import is_shaped
from splatctrl_cli.control.replay import ReplayTask, ReplayTrace
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.metrics import DESCRIBES, GAP, TIME, Better, Scale
from splatctrl_cli.files.output import finite
from splatctrl_cli.jobs.progress import Progress
from splatctrl_cli.jobs.replays.goal import goal_waypoints
from splatctrl_cli.jobs.replays.known_scene import KnownFields
from splatctrl_cli.jobs.replays.request import ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replays.result import Comparison, Replay
from splatctrl_cli.planner.comparison import Motion, MotionFigures, Yardstick
from splatctrl_cli.planner.planned import PlannedPath, planned_detours, planned_path
from splatctrl_cli.planner.tracking import follow_joints, follow_with_controller
from splatctrl_cli.records import Float64
from splatctrl_cli.report.replay_pictures import methods_picture

BIRRT, BIRRT_IK, QP_IK = "birrt", "birrt-ik", "qp-ik"
ALWAYS = ("closed_loop", "log")  # what stands in every comparison
ROUNDING = 1e-5  # [m] taken off distances to splats, far above what float32 rounds within 8 m
MOTION = {
    "success": Scale(better=Better.HIGHER),
    "goal_reached": Scale(better=Better.HIGHER),
    "duration_s": Scale(unit="s", better=Better.LOWER, absolute=0.05, relative=0.02),
    "joint_path_rad": Scale(unit="rad", better=Better.LOWER, absolute=0.01, relative=0.02),
    "effector_path_m": Scale(unit="m", better=Better.LOWER, absolute=0.005, relative=0.02),
    "effector_path_deg": Scale(unit="degrees", better=Better.LOWER, absolute=0.5, relative=0.02),
    **dict.fromkeys(("min_clearance_barrier", "min_clearance", "min_clearance_proved", "min_clearance_true"), GAP),
    "num_interventions": DESCRIBES,
}
PLAN = {
    "planning_time_s": TIME,  # wall clock
    "planned_margin": GAP,
    "planned_self_margin": GAP,
    "num_edges": DESCRIBES,
    "num_edges_proved": DESCRIBES,
}


def method_named(baseline: str) -> str:
    """The method of a baseline, as metrics begin with it."""
    return baseline.replace("-", "_")


def figure_scales(baselines: Sequence[str], *, has_truth: bool) -> dict[str, Scale]:
    """How two runs are compared by the figures that `figures_of` gives; none without a baseline."""
    if not baselines:
        return {}
    methods = (*ALWAYS, *map(method_named, baselines))
    plans = {method_named(name) for name in (BIRRT, BIRRT_IK)}
    of_method = {method: MOTION | (PLAN if method in plans else {}) for method in methods}
    return {
        f"{method}_{name}": scale
        for method, scales in of_method.items()
        for name, scale in scales.items()
        if has_truth or name != "min_clearance_true"
    }


def figures_of(comparison: Comparison) -> dict[str, float | None]:
    """Every figure of every method, by the names of `figure_scales`."""
    has_truth = any(figures.true_clearance is not None for figures in comparison.figures.values())
    found: dict[str, float | None] = {}
    for method in comparison.methods:
        values = _motion_values(comparison.figures.get(method))
        if not has_truth:
            del values["min_clearance_true"]
        if method in comparison.plans:
            plan = comparison.plans[method]
            of_plan = (plan.seconds, finite(plan.margin), finite(plan.self_margin), plan.num_edges, plan.num_proved)
            values |= dict(zip(PLAN, of_plan, strict=True))
        found |= {f"{method}_{name}": value for name, value in values.items()}
    return found


def document_of(comparison: Comparison) -> dict[str, Any]:
    """methods.json: figures by method, and what was planned."""
    figures = figures_of(comparison)
    by_method = {
        method: {name: figures[f"{method}_{name}"] for name in (*MOTION, *PLAN) if f"{method}_{name}" in figures}
        for method in comparison.methods
    }
    plans = {
        method: {"outcome": str(plan.outcome), "waypoints": plan.path.waypoints.tolist() if plan.path else []}
        for method, plan in comparison.plans.items()
    }
    return {"units": "m, rad, s, degrees where the name says so", "methods": by_method, "plans": plans}


def draw_methods(folder: Path, comparison: Comparison, period: float, margin: float) -> None:
    """Write methods.png, where there is more than the replay itself."""
    if comparison.figures:
        barrier = {method: figures.barrier for method, figures in comparison.figures.items()}
        methods_picture(folder / "methods.png", barrier, period, margin)


def check_comparable(request: ReplayRequest, baselines: Sequence[str]) -> None:
    """Raise UsageError where a planner is asked for more than one goal, or our own controller beside itself."""
    if QP_IK in baselines and request.controller is None and request.controller_command is None:
        raise UsageError(
            f"--baseline {QP_IK}: the closed loop is that already",
            remedy="leave it out, or give --controller or --controller-command",
        )
    if not {BIRRT, BIRRT_IK} & set(baselines):
        return
    for option, given in (
        ("--waypoints", request.waypoints),
        ("--follow", request.follow),
        ("--re-anchor", request.re_anchor),
    ):
        if given:
            raise UsageError(f"--baseline birrt: expected a single goal, got {option}", remedy=f"leave out {option}")


def compared(
    request: ReplayRequest,
    baselines: Sequence[str],
    inputs: ReplayInputs,
    replay: Replay,
    config: Config,
    console: Progress,
) -> Comparison:
    """The closed loop, the log and every baseline, each in the scene as it was known at its time.

    Planned paths are those of the scene known at the start; they begin there and then, as if planning took no time.
    """
    trace = replay.closed_loop
    if not baselines or trace is None:
        return Comparison()
    start_ns, control = int(trace.stamp_ns[0]), config.control
    log = inputs.motion()
    task = _task(request, inputs, trace.position[0], start_ns, log.position[-1])
    num = max(math.ceil((log.last_ns - start_ns) * 1e-9 / control.period - 1e-6), 0) + 1
    stamps = _stamps(start_ns, num, control.period)
    motions = {
        "closed_loop": _driven(trace, is_ours=replay.outside is None),
        "log": Motion(stamp_ns=stamps, position=np.array([log.at(int(stamp))[0] for stamp in stamps])),
    }
    if "standstill" in baselines:
        held = replay.separations["standstill"]
        motions["standstill"] = Motion(stamp_ns=held.stamp_ns, position=held.position, is_intervened=held.is_stopped)
    if replay.ours is not None:
        motions[method_named(QP_IK)] = _driven(replay.ours, is_ours=True)
    plans: dict[str, PlannedPath] = {}
    if {BIRRT, BIRRT_IK} & set(baselines):
        plans, followed = _planned(baselines, inputs, task, config, console)
        motions |= followed
    yardstick = _yardstick(inputs, task, config)
    order = (*ALWAYS, *map(method_named, baselines))
    motions = {method: motions[method] for method in order if method in motions}
    return Comparison(
        motions=motions,
        figures={method: yardstick.figures(motion) for method, motion in motions.items()},
        plans=plans,
    )


def _driven(trace: ReplayTrace, *, is_ours: bool) -> Motion:
    """The motion of a closed loop; where a user's own controller intervened is not known."""
    shaped = np.array([is_shaped(step) for step in trace.steps], dtype=np.bool_)
    position = np.asarray(trace.position)
    return Motion(stamp_ns=trace.stamp_ns, position=position, is_intervened=shaped if is_ours else None)


def _planned(
    baselines: Sequence[str], inputs: ReplayInputs, task: ReplayTask, config: Config, console: Progress
) -> tuple[dict[str, PlannedPath], dict[str, Motion]]:
    """One plan for both ways to follow it, and how each went."""
    scene, control, planner = inputs.scene, config.control, config.planner
    known = Certified(distance=certified_distance(scene.at(task.stamp_ns)))
    plan = planned_path(inputs.model, known, task, planner, control)
    console.log(f"replay: planned in {plan.seconds:.2f} s: {plan.outcome}")
    plans, motions = {}, {}
    for baseline in (name for name in baselines if name in (BIRRT, BIRRT_IK)):
        plans[method_named(baseline)] = plan
        if plan.path is None:
            continue
        if baseline == BIRRT:
            position, shaped = follow_joints(plan.path, plan.clearance.model, planner, control), None
        else:
            position, steps = follow_with_controller(
                plan.path, plan.clearance.model, lambda stamp: scene.at(stamp).barrier, task.frame, planner, control,
                stamp_ns=task.stamp_ns, scene_step_at=scene.step_at,
            )  # fmt: skip
            shaped = np.array([is_shaped(step) for step in steps], dtype=np.bool_)
        motions[method_named(baseline)] = Motion(
            stamp_ns=_stamps(task.stamp_ns, len(position), control.period),
            position=position,
            is_intervened=shaped,
        )
    return plans, motions


def planned_ways_out(inputs: ReplayInputs, task: ReplayTask, config: Config) -> PlanDetour | None:
    """What plans the closed loop's ways out of local minima; None where it may take none."""
    if config.control.max_detours == 0:
        return None
    return planned_detours(
        inputs.model,
        lambda stamp_ns: Certified(distance=certified_distance(inputs.scene.at(stamp_ns))),
        task.frame,
        config.planner,
        config.control,
        home=task.home,
    )


@dataclass(frozen=True, kw_only=True)
class Certified:
    """A scene to plan in: a lower bound of the exact distance to the splats."""

    distance: DistanceFunction


def certified_distance(fields: KnownFields) -> DistanceFunction:
    """A lower bound of a 1-Lipschitz distance: of a grid its certified one, of splats the exact one less rounding.

    Both bound the exact distance to the splats, so what is proved of an edge is proved of that. Of the kernel fields
    nothing can be proved from samples: their slope has no useful bound.
    """
    certified = fields.distances.get("certified")
    if certified is not None:
        return certified
    exact = fields.distances["exact"]
    return lambda points: exact(points) - ROUNDING


def _yardstick(inputs: ReplayInputs, task: ReplayTask, config: Config) -> Yardstick:
    scene, truth = inputs.scene, inputs.truth
    known: list[tuple[KnownFields, DistanceFunction]] = []  # the scene in use

    def certified_at(stamp_ns: int) -> DistanceFunction:
        fields = scene.at(stamp_ns)
        if not known or known[0][0] is not fields:
            known[:] = [(fields, certified_distance(fields))]
        return known[0][1]

    return Yardstick(
        model=inputs.model,
        frame=task.frame,
        T_world_goal=task.T_world_goal,
        config=config.control,
        distances_at=lambda stamp: scene.at(stamp).distances,
        certified_at=certified_at,
        truth=None if truth is None else lambda points, stamp: truth.closest(points, stamp)[0],
    )


def _task(
    request: ReplayRequest, inputs: ReplayInputs, start: Float64, stamp_ns: int, logged_end: Float64
) -> ReplayTask:
    """What the closed loop was asked for; without a posture the logged one at the end is where goals are sought."""
    frame = request.frame or inputs.model.frame_names[-1]
    goal = goal_waypoints(request, inputs.model, frame, logged_end)[-1]
    return ReplayTask(
        start=start,
        T_world_goal=goal.T_world_goal,
        frame=frame,
        stamp_ns=stamp_ns,
        home=logged_end if goal.posture is None else goal.posture,
    )


def _stamps(start_ns: int, num: int, period: float) -> Any:
    return start_ns + np.round(np.arange(num) * period * 1e9).astype(np.int64)


def _motion_values(figures: MotionFigures | None) -> dict[str, float | None]:
    if figures is None:
        return {"success": 0, "goal_reached": 0, **dict.fromkeys([*MOTION][2:])}
    return {
        "success": int(figures.is_success),
        "goal_reached": int(figures.has_arrived),
        "duration_s": figures.duration,
        "joint_path_rad": figures.joint_path,
        "effector_path_m": figures.effector_path,
        "effector_path_deg": figures.effector_turn,
        "min_clearance_barrier": finite(figures.clearance["barrier"]),
        "min_clearance": finite(figures.clearance["exact"]),
        "min_clearance_proved": finite(figures.proved),
        "min_clearance_true": None if figures.true_clearance is None else finite(figures.true_clearance),
        "num_interventions": figures.num_interventions,
    }

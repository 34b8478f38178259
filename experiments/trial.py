"""One problem of a study by each method: its map, plan, motion and result."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from experiments import failures, judge
from experiments.environments import ENVIRONMENTS
from experiments.maps import (
    Fitted,
    Map,
    fitted,
    gaussian_map,
    occupancy_map,
    printed_map,
    splat_map,
    tsdf_map,
)
from experiments.paths import approach_to, joint_length
from experiments.problems import Problem, ProblemRequest, Views, read_problem, views_of
from experiments.tracking import follow_joints
from experiments.ways import Way, plain_ways
from splatctrl_cli import Config, SplatCtrlError, load_config
from splatctrl_cli import Outcome as Judgement
from splatctrl_cli.blocks import (
    GOAL_BLOCKED,
    START_BLOCKED,
    Detour,
    Float64,
    HasDistance,
    MeasuredRobot,
    PlanDetour,
    ReplayTask,
    Stopwatch,
    closed_loop,
    planned_detours,
    planned_path,
)
from splatctrl_cli.blocks import MotionOutcome as Outcome

OURS, TSDF, TRUTH = "ours", "tsdf", "truth"
QP_IK, QP_IK_DETOURS, PAPER, OCCUPANCY = "qp-ik", "qp-ik-detours", "paper", "occupancy"
GAUSSIANS = "3dgs"
FULL = (OURS, TSDF, TRUTH)  # methods of every problem; the others are of the first drawn ones
METHODS = (*FULL, QP_IK, QP_IK_DETOURS, PAPER, GAUSSIANS, OCCUPANCY)
SUBSET = 7  # problems of each drawn environment that go through every method: 63 trials each
CAMERAS = (2, 4, 6)
DETOURS = 3
APPROACH = 0.12  # [m] that the hand comes straight to its goal: as deep as it reaches about a thing
NO_MARGIN = 1e-4  # [m]
PLANS, LITTLE = 6, 1e-4  # of a way through unseen space; [m^3] of that for which one plan does
SEARCH = 1500  # iterations for each of a map's ways
BLOCKED = {START_BLOCKED: judge.START_BLOCKED, GOAL_BLOCKED: judge.GOAL_BLOCKED}
NUM_STEPS = 5  # of each camera, the arm at rest


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One method on one problem with a number of cameras (0: it needs none); a row of the published table.

    success: by the paper's rule; verdict: the house's label, empty without one; cause: of `judge.CAUSES`, empty for a
    success; is_false_green: judged safe, and something was touched. true_clearance [m]: the least on the whole way;
    margin [m]: what the planner kept; in_known_space: the way planned keeps out of space that no camera saw.
    """

    environment: str
    number: int
    cameras: int
    method: str
    success: bool
    cause: str
    verdict: str = ""
    is_false_green: bool = False
    outcome: str = ""
    reason: str = ""
    true_clearance: float | None = None
    margin: float | None = None
    in_known_space: bool | None = None
    position_error: float | None = None
    rotation_error: float | None = None
    duration_s: float | None = None
    joint_path_rad: float | None = None
    num_parts: int | None = None

    @property
    def label(self) -> str:
        """Which trial it is."""
        return f"{self.environment} {self.number}, {self.cameras} cameras, {self.method}"

    @property
    def told(self) -> str:
        """What came of it, in a few words."""
        cameras = f"{self.cameras} cameras, " if self.cameras else ""
        verdict = f"; {self.verdict.upper()}" if self.verdict else ""
        return f"{cameras}{self.method}: {self.cause or 'success'}{verdict}"


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """A method's motion (T, J); None without one, for `cause`."""

    position: Float64 | None
    cause: str = ""
    outcome: str = ""
    margin: float | None = None
    in_known_space: bool | None = None


@dataclass(frozen=True, kw_only=True)
class Rig:
    """A problem seen by its first cameras; config: of all methods but the paper's literal one; out: the folder for
    pictures of failures, None for none.
    """

    problem: Problem
    views: Views
    config: Config
    threads: int
    stopwatch: Stopwatch
    out: Path | None = None

    @cached_property
    def task(self) -> ReplayTask:
        """The task from the start to the tip's pose at the goal; the goal's posture is tried first."""
        frame = self.problem.model.frame_names[-1]
        return ReplayTask(
            start=self.problem.start,
            T_world_goal=self.problem.model.frame_pose(self.problem.goal, frame),
            frame=frame,
            stamp_ns=self.views.frames[-1].stamp_ns,
            home=self.problem.goal,
        )

    @cached_property
    def fitted(self) -> Fitted:
        """The reconstruction."""
        return fitted(self.problem, self.views, self.config, self.threads)

    @cached_property
    def splats(self) -> Map:
        """Our map."""
        return splat_map(self.problem, self.fitted, self.config, self.threads)


Drive = Callable[[Rig, Map], Attempt]


def trials_of(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[Trial]:
    """Trials of a problem by every method, with every number of cameras."""
    with stopwatch.stage("problem"):
        problem = read_problem(request.problem, request.problems)
    has_all = problem.environment in ENVIRONMENTS and problem.number < SUBSET
    chosen = [name for name in request.methods if name in FULL or has_all]
    with stopwatch.stage("views"):
        views = views_of(problem, max(CAMERAS), width=request.width, num_steps=NUM_STEPS)
    robot = judge.measured(problem.model, config)
    for num_cameras in CAMERAS:
        rig = Rig(
            problem=problem,
            views=Views(steps=tuple(step[:num_cameras] for step in views.steps)),
            config=config,
            threads=request.threads,
            stopwatch=stopwatch,
            out=request.out,
        )
        for name in chosen:
            if name != TRUTH:
                yield trial_of(rig, name, num_cameras, robot)
    if TRUTH in chosen:
        yield trial_of(rig, TRUTH, 0, robot)


def trial_of(rig: Rig, method: str, num_cameras: int, robot: MeasuredRobot) -> Trial:
    """The trial of one method; an impossible trial is unsuccessful, with its reason."""
    problem = rig.problem
    begun = Trial(
        environment=problem.environment,
        number=problem.number,
        cameras=num_cameras,
        method=method,
        success=False,
        cause=judge.NOT_EVALUABLE,
    )
    try:
        make, drive = MAKERS[method]
        with rig.stopwatch.stage(f"{method}: map"):
            known = make(rig)
        with rig.stopwatch.stage(f"{method}: plan"):
            attempt = drive(rig, known)
    except SplatCtrlError as error:
        failed = replace(begun, reason=error.message)
        _draw(rig, failed, None, None)
        return failed
    told = replace(
        begun,
        cause=attempt.cause,
        outcome=attempt.outcome,
        margin=attempt.margin,
        in_known_space=attempt.in_known_space,
        num_parts=known.num_parts,
    )
    if attempt.position is not None:
        with rig.stopwatch.stage(f"{method}: judge"):
            told = _judged(rig, told, attempt, known, robot)
    if not told.success:
        _draw(rig, told, attempt, known)
    return told


def _draw(rig: Rig, trial: Trial, attempt: Attempt | None, known: Map | None) -> None:
    """A picture of a trial without success."""
    if rig.out is None or trial.method == TRUTH:
        return
    with rig.stopwatch.stage("pictures"):
        failures.draw(
            failures.Failure(
                problem=rig.problem,
                views=rig.views,
                told=trial.label,
                cause=trial.cause,
                verdict=trial.verdict,
                reason=trial.reason,
                position=None if attempt is None else attempt.position,
                scene=None if known is None else known.scene,
                things=None if known is None else known.things,
            ),
            rig.out / f"failure-{trial.method}-{trial.cameras}.png",
        )


def _judged(rig: Rig, trial: Trial, attempt: Attempt, known: Map, robot: MeasuredRobot) -> Trial:
    """The trial with its motion's results, by the truth and by the map."""
    position = attempt.position
    assert position is not None
    execution = judge.against_truth(rig.problem, position, rig.views)
    cause = execution.cause if execution.has_collided else attempt.cause or execution.cause
    trial = replace(
        trial,
        success=not cause,
        cause=cause,
        true_clearance=execution.clearance,
        position_error=execution.position_error,
        rotation_error=execution.rotation_error,
        duration_s=rig.config.control.period * (len(position) - 1),
        joint_path_rad=joint_length(position),
    )
    if known.known is None:
        return trial
    verdict = judge.verdict_on(robot, position, rig.task.stamp_ns, known.known, rig.config)
    return replace(
        trial,
        verdict=verdict.label,
        is_false_green=verdict.outcome is Judgement.PASSED and execution.has_collided,
        reason=str(verdict.decisive[0]) if verdict.decisive else "",
    )


def by_planner(rig: Rig, known: Map) -> Attempt:
    """A planned path, followed in joint space: the first of the map's ways that leads to the goal, each tried with
    samples of its own; where none does, the last with others.
    """
    seed = rig.config.planner.seed
    for way in known.ways() if known.ways is not None else plain_ways(known.scene, rig.config):
        attempt = _least_unseen(rig, way, range(seed, seed + PLANS), gives_up=True)
        if attempt.position is not None:
            return attempt
        seed += PLANS
    return _least_unseen(rig, way, range(seed, seed + PLANS), gives_up=False)


def _least_unseen(rig: Rig, way: Way, seeds: Sequence[int], *, gives_up: bool) -> Attempt:
    """Of the seeds' plans, the one through the least never-seen space; the first if this is at most `LITTLE` or
    unknown. gives_up: return no plan if the first seed has none.
    """
    best, least = Attempt(position=None, cause=judge.NO_PLAN), np.inf
    for seed in seeds:
        config = replace(
            rig.config,
            planner=replace(rig.config.planner, max_iterations=SEARCH, seed=seed),
            control=replace(rig.config.control, margin=way.margin),
        )
        attempt = replace(_planned(rig, way.scene, config), in_known_space=way.in_known_space)
        if attempt.position is not None:
            unseen = 0.0 if way.unseen_on is None else way.unseen_on(attempt.position)
            if unseen < least:
                best, least = attempt, unseen
        elif best.position is None:
            best = attempt
        if least <= LITTLE or (gives_up and best.position is None):
            break
    return best


def as_printed(rig: Rig, known: Map) -> Attempt:
    """A planned path without a margin, from the start to the goal."""
    config = replace(rig.config, control=replace(rig.config.control, margin=NO_MARGIN))
    return _planned(rig, known.scene, config, approach=0.0)


def _planned(rig: Rig, scene: HasDistance, config: Config, *, approach: float = APPROACH) -> Attempt:
    planner, control = config.planner, config.control
    ending = partial(approach_to, frame=rig.task.frame, length=approach, planner=planner, control=control)
    plan = planned_path(rig.problem.model, scene, rig.task, planner, control, ending=ending)
    if plan.path is None:
        return Attempt(position=None, cause=BLOCKED.get(plan.outcome, judge.NO_PLAN), outcome=plan.outcome)
    position = follow_joints(plan.path, plan.clearance.model, config.control)
    return Attempt(position=position, outcome=plan.outcome, margin=plan.margin)


def by_controller(num_detours: int, rig: Rig, known: Map) -> Attempt:
    """QP-IK from the start to the goal, with at most `num_detours` planned detours when it stalls."""
    config, model, task = rig.config, rig.problem.model, rig.task
    control = replace(config.control, max_detours=num_detours, solver="daqp")
    assert known.barrier is not None
    barrier = known.barrier()
    detour = _way_out(rig, known) if num_detours else None
    trace = closed_loop(model, control, task, lambda stamp: barrier, plan_detour=detour)
    cause = "" if trace.outcome is Outcome.GOAL_REACHED else judge.STALLED
    return Attempt(position=np.asarray(trace.position), cause=cause, outcome=trace.outcome, margin=control.margin)


def _way_out(rig: Rig, known: Map) -> PlanDetour:
    """A path out of a local minimum by the map's safest way with the margin, else through any space."""
    margin = rig.config.control.margin
    scenes = [way.scene for way in known.ways() if way.margin == margin] if known.ways is not None else []

    def planned_in(scene: HasDistance) -> PlanDetour:
        planner = replace(rig.config.planner, max_iterations=SEARCH)
        task = rig.task
        return planned_detours(
            rig.problem.model, lambda stamp_ns: scene, task.frame, planner, rig.config.control, home=task.home
        )

    plans = [planned_in(scene) for scene in (*scenes, known.scene)]

    def way_out(stamp_ns: int, q: Float64, T_world_goal: Float64) -> Detour | None:
        found = (plan(stamp_ns, q, T_world_goal) for plan in plans)
        return next((each for each in found if each is not None), None)

    return way_out


def _printed(rig: Rig) -> Map:
    config = load_config(None, ["preset=paper"])
    return printed_map(rig.problem, fitted(rig.problem, rig.views, config, rig.threads), config, rig.threads)


MAKERS: Mapping[str, tuple[Callable[[Rig], Map], Drive]] = {  # how a method's map is made, and what drives the arm
    OURS: (lambda rig: rig.splats, by_planner),
    TSDF: (lambda rig: tsdf_map(rig.problem, rig.views, rig.config), by_planner),
    TRUTH: (lambda rig: Map(scene=rig.problem.solids), by_planner),
    QP_IK: (lambda rig: rig.splats, partial(by_controller, 0)),
    QP_IK_DETOURS: (lambda rig: rig.splats, partial(by_controller, DETOURS)),
    PAPER: (_printed, as_printed),
    GAUSSIANS: (lambda rig: gaussian_map(rig.problem, rig.views, rig.config, rig.threads), by_planner),
    OCCUPANCY: (lambda rig: occupancy_map(rig.fitted, rig.config, rig.threads), by_planner),
}

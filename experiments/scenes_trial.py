"""One scene of IV-C: the arm is driven to a cube, takes it, and carries it into a bowl, twice by each method.

The map begins with the cameras' views with the arm at home. It continues with their views after the cube is lifted;
then its place is empty, and the cube is part of the arm. T states, J joints.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from experiments import judge
from experiments.drawn_task import solids_of
from experiments.maps import Fitted, Map, splat_map, workspace_of
from experiments.paths import effector_length, joint_length, least_clearance
from experiments.pick_and_place import HELD, HOME, depth_cameras
from experiments.problems import Problem, ProblemRequest, Views, recorded, room, solids_at
from experiments.scenes import HAND, Scene, read_scene
from experiments.trial import Attempt, Drive, Rig, by_controller, by_planner
from splatctrl_cli import Box, Config, Outcome, SplatCtrlError, Verdict
from splatctrl_cli.blocks import (
    AuditRow,
    Clearance,
    Float64,
    Primitive,
    ReplayTask,
    RobotModel,
    SceneFitter,
    Stopwatch,
    check_edges,
    goal_postures,
    pose_at,
    posture_of,
    self_mask_metrics,
)

QP_IK, BIRRT, QP_IK_ALONE = "qp-ik", "birrt", "qp-ik-alone"
DETOURS = 3
DRIVES: Mapping[str, Drive] = {
    QP_IK: partial(by_controller, DETOURS),
    BIRRT: by_planner,
    QP_IK_ALONE: partial(by_controller, 0),
}
METHODS = tuple(DRIVES)
RUNS = 2  # of each method in each scene, with other noise, errors of the cameras' poses, and samples of the planner
MARGIN = 0.036  # [m] that the methods keep from the map: 2 cm, and what it errs by
NUM_STEPS = 5  # of each camera, with the arm at home and once the cube is lifted
NO_GRASP, HIT_GRASPING = "no posture about the cube", "collision while the cube is taken"
RANKS = {Outcome.PASSED: 0, Outcome.NOT_EVALUABLE: 1, Outcome.FAILED: 2}


@dataclass(frozen=True, kw_only=True)
class Transport:
    """One run of a method in a scene; a row of what is published.

    success: the cube is over the bowl, by the paper's rule, and nothing was touched. verdict: the worse of both legs'
    verdicts, only by the map and the paper's 2 cm. true_clearance, field_clearance [m]: the least of the arm and its
    load from the true solids and from the map, over both legs and between states. Lengths are sums of both legs;
    errors are at the last leg's end. in_known_space: both legs avoid never-seen space; None if unplanned.
    """

    layout: str
    number: int
    run: int
    method: str
    success: bool
    cause: str
    verdict: str = ""
    is_false_green: bool = False
    outcome: str = ""
    reason: str = ""
    true_clearance: float | None = None
    field_clearance: float | None = None
    in_known_space: bool | None = None
    position_error: float | None = None
    rotation_error: float | None = None
    duration_s: float | None = None
    joint_path_rad: float | None = None
    effector_path_m: float | None = None
    effector_path_deg: float | None = None

    @property
    def label(self) -> str:
        """Which trial it is."""
        return f"{self.layout} {self.number}, run {self.run}, {self.method}"

    @property
    def told(self) -> str:
        """What came of it, in a few words."""
        verdict = f"; {self.verdict.upper()}" if self.verdict else ""
        return f"run {self.run}, {self.method}: {self.cause or 'success'}{verdict}"


@dataclass(frozen=True, kw_only=True)
class Leg(Rig):
    """A leg of a task: to a pose of the hand, with the home posture as preferred posture."""

    @property
    def task(self) -> ReplayTask:
        """From where the arm is."""
        return ReplayTask(
            start=self.problem.start,
            T_world_goal=self.problem.model.frame_pose(self.problem.goal, HAND),
            frame=HAND,
            stamp_ns=self.views.frames[-1].stamp_ns,
            home=np.array(HOME),
        )


@dataclass(frozen=True, kw_only=True)
class Way:
    """Result of one leg: its motion (T, J), and its figures of the row."""

    position: Float64
    outcome: str
    execution: judge.Execution
    verdict: Verdict
    field_clearance: float
    in_known_space: bool | None
    effector_path_m: float
    effector_path_deg: float


def transports_of(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[Transport]:
    """Every run of the named scene. Raises InputError for an unknown name."""
    with stopwatch.stage("scene"):
        scene = read_scene(request.problem)
    width, threads = request.width, request.threads
    for run in range(RUNS):
        trial = Trial(scene=scene, run=run, config=config, width=width, threads=threads, stopwatch=stopwatch)
        yield from map(trial.by, request.methods)


class Trial:
    """One run in a scene, with the first camera views, the same for every method."""

    def __init__(
        self, *, scene: Scene, run: int, config: Config, width: int, threads: int, stopwatch: Stopwatch
    ) -> None:
        self._scene, self._run, self._threads, self._stopwatch = scene, run, threads, stopwatch
        control = replace(config.control, margin=MARGIN)
        self._config = replace(config, control=control, planner=replace(config.planner, seed=run))
        self._seed, self._judging = RUNS * scene.number + run, config
        self._cameras = depth_cameras(width, 3 * width // 4)
        problem = scene.to_cube()
        with stopwatch.stage("views"):
            self._views = self._seen(problem, np.array(HOME), ())

    def by(self, method: str) -> Transport:
        """The run of a method; an impossible run is unsuccessful, with its reason."""
        scene = self._scene
        row = Transport(
            layout=scene.layout,
            number=scene.number,
            run=self._run,
            method=method,
            success=False,
            cause=judge.NOT_EVALUABLE,
        )
        ways, period = list[Way](), self._config.control.period
        try:
            cause, outcome = self._driven(method, ways)
        except SplatCtrlError as error:
            return _with_ways(replace(row, reason=error.message), ways, period)
        return _with_ways(replace(row, success=not cause, cause=cause, outcome=outcome), ways, period)

    def _driven(self, method: str, ways: list[Way]) -> tuple[str, str]:
        """Drive both legs and add them to `ways`; return the cause of a failure, or "", and the last leg's end."""
        scene, config, problem = self._scene, self._config, self._scene.to_cube()
        workspace = workspace_of(problem)
        fitter = SceneFitter(config.scene, config.occupancy, workspace, seed=self._seed, threads=self._threads)
        with self._stopwatch.stage("map"):
            rows = self._fitted(fitter, self._views, np.array(HOME))
        to_cube = self._way(problem, self._views, fitter, rows, method)
        if isinstance(to_cube, Attempt):
            return to_cube.cause, to_cube.outcome
        ways.append(to_cube)
        lifted = to_cube.position[-1]
        cause = to_cube.execution.cause or self._not_taken(lifted)
        if cause:
            return cause, to_cube.outcome
        with self._stopwatch.stage("views"):
            views = self._seen(scene.to_bowl(lifted), lifted, [_held_cube(scene, lifted)])
        with self._stopwatch.stage("map"):
            rows += self._fitted(fitter, views, lifted, [(HAND, HELD)])
        to_bowl = self._way(scene.to_bowl(lifted), views, fitter, rows, method)
        if isinstance(to_bowl, Attempt):
            return to_bowl.cause, to_bowl.outcome
        ways.append(to_bowl)
        return to_bowl.execution.cause, to_bowl.outcome

    def _way(
        self, problem: Problem, views: Views, fitter: SceneFitter, rows: Sequence[AuditRow], method: str
    ) -> Way | Attempt:
        """One leg; the attempt where the method finds no motion."""
        leg = Leg(problem=problem, views=views, config=self._config, threads=self._threads, stopwatch=self._stopwatch)
        figures = {"voxel": self._config.occupancy.voxel, **self_mask_metrics(rows)}
        made = Fitted(fitter=fitter, figures=figures)
        known = splat_map(problem, made, self._config, self._threads)
        with self._stopwatch.stage(f"{method}: plan"):
            attempt = DRIVES[method](leg, known)
        if attempt.position is None:
            return attempt
        with self._stopwatch.stage(f"{method}: judge"):
            execution = judge.against_truth(problem, attempt.position, views)
            if attempt.cause and not execution.has_collided:
                execution = replace(execution, cause=attempt.cause)
            robot = judge.measured(problem.model, self._judging)
            assert known.known is not None
            moved, turned = effector_length(problem.model, attempt.position, HAND)
            return Way(
                position=attempt.position,
                outcome=attempt.outcome,
                execution=execution,
                verdict=judge.verdict_on(robot, attempt.position, leg.task.stamp_ns, known.known, self._judging),
                field_clearance=_clearance(problem.model, known, attempt.position),
                in_known_space=attempt.in_known_space,
                effector_path_m=moved,
                effector_path_deg=turned,
            )

    def _not_taken(self, hover: Float64) -> str:
        """Move the hand straight down around the cube, and up again with it, alike for every method; return why this
        fails, or "". It is judged by the truth without the cube, because contact with the cube is intended.
        """
        scene = self._scene
        down = goal_postures(
            scene.model, HAND, scene.drawn.T_world_grasp, hover[None], self._config.control, at_most=1
        )
        if not len(down):
            return NO_GRASP
        alone = scene.model.replace_self_pairs(judge.NO_PAIRS)
        around = Clearance.of(alone, solids_of([*scene.drawn.things, *room()]))
        is_free = check_edges(around, hover[None], down, contact=judge.TOUCH).is_free.all()
        return "" if is_free else HIT_GRASPING

    def _seen(self, problem: Problem, q: Float64, held: Sequence[Primitive]) -> Views:
        """Camera views of a problem with the arm at q (J,) and the objects that it holds."""
        arm = [*solids_at(problem.model, q), *held]
        first = NUM_STEPS if held else 0
        return recorded(self._cameras, problem.primitives, arm, seed=self._seed, num_steps=NUM_STEPS, first=first)

    def _fitted(
        self, fitter: SceneFitter, views: Views, q: Float64, carried: Sequence[tuple[str, Box]] = ()
    ) -> list[AuditRow]:
        """Fit views with the arm at q (J,) and carried boxes, which count as parts of the arm."""
        return [
            fitter.step(step, posture_of(self._scene.model, q, {frame.stamp_ns: q for frame in step}, carried))
            for step in views.steps
        ]


def _held_cube(scene: Scene, q: Float64) -> Primitive:
    """The cube in the hand at q (J,)."""
    T_hand_cube = pose_at((HELD.lower + HELD.upper) / 2)
    return replace(scene.drawn.cube, T_world_shape=scene.model.frame_pose(q, HAND) @ T_hand_cube)


def _clearance(model: RobotModel, known: Map, position: Float64) -> float:
    """The least distance [m] of a whole motion (T, J) to the map."""
    in_map = Clearance.of(model.replace_self_pairs(judge.NO_PAIRS), known.scene)
    return least_clearance(in_map, position, tolerance=5e-4).upper


def _with_ways(row: Transport, ways: Sequence[Way], period: float) -> Transport:
    """The row with the results of both legs, or of the only leg."""
    if not ways:
        return row
    worst = max((way.verdict for way in ways), key=lambda verdict: RANKS[verdict.outcome])
    return replace(
        row,
        verdict=worst.label,
        is_false_green=any(way.verdict.outcome is Outcome.PASSED and way.execution.has_collided for way in ways),
        outcome=row.outcome or ways[-1].outcome,
        reason=row.reason or (str(worst.decisive[0]) if worst.decisive else ""),
        true_clearance=min(way.execution.clearance for way in ways),
        field_clearance=min(way.field_clearance for way in ways),
        in_known_space=None
        if any(way.in_known_space is None for way in ways)
        else all(way.in_known_space for way in ways),
        position_error=ways[-1].execution.position_error,
        rotation_error=ways[-1].execution.rotation_error,
        duration_s=period * sum(len(way.position) - 1 for way in ways),
        joint_path_rad=sum(joint_length(way.position) for way in ways),
        effector_path_m=sum(way.effector_path_m for way in ways),
        effector_path_deg=sum(way.effector_path_deg for way in ways),
    )

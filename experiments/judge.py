"""Results of a motion: the paper's rule with the truth, and splatctrl's verdict with the map.

T states, J joints; between two states, the joints move straight, and every posture between them is judged.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.paths import least_clearance
from experiments.problems import Problem, Views
from splatctrl_cli import Config, ReplayRequest, Verdict
from splatctrl_cli.blocks import (
    SILENT,
    Clearance,
    Float64,
    Judged,
    KnownScene,
    LoggedStates,
    LossReport,
    MeasuredRobot,
    Record,
    ReplayInputs,
    RobotModel,
    StateColumns,
    check_edges,
    closest_of,
    measured_robot,
    metrics_of,
    pose_error,
    replay_verdict,
    replayed,
)

GOAL_POSITION, GOAL_ROTATION = 0.03, np.radians(1.0)  # [m], [rad]: the paper's rule (IV-B)
TOUCH = 1e-7  # [m] of true clearance that a free way keeps everywhere
NO_PLAN = "no plan found"
START_BLOCKED, GOAL_BLOCKED = "start inside an obstacle of the map", "goal inside an obstacle of the map"
HIT_SEEN, HIT_UNSEEN = "collision with seen surface", "collision with unseen surface"
HIT_SELF = "collision with itself"
GOAL_MISSED, STALLED, NOT_EVALUABLE = "goal missed", "stalled before the goal", "not evaluable"
CAUSES = (NO_PLAN, START_BLOCKED, GOAL_BLOCKED, HIT_SEEN, HIT_UNSEEN, HIT_SELF, GOAL_MISSED, STALLED, NOT_EVALUABLE)
NO_PAIRS = np.empty((0, 2), np.int64)
REQUEST = ReplayRequest(log=Path("trial"), out=Path("trial"))


@dataclass(frozen=True, kw_only=True)
class Execution:
    """A motion against the truth. cause: of `CAUSES`, "" for a success by the paper's rule. clearance [m]: the arm's
    least true clearance from objects over the whole motion, at most 0 in collision. position_error [m],
    rotation_error [rad]: at its end.
    """

    cause: str
    clearance: float
    position_error: float
    rotation_error: float

    @property
    def has_collided(self) -> bool:
        """Whether anything was touched."""
        return self.cause in (HIT_SEEN, HIT_UNSEEN, HIT_SELF)


def against_truth(problem: Problem, position: Float64, views: Views) -> Execution:
    """A motion (T, J) against the problem's solids: proved free by conservative advancement, not only at samples."""
    room = Clearance.of(problem.model, problem.solids)
    frame = problem.model.frame_names[-1]
    ends = [problem.model.frame_pose(q, frame) for q in (position[-1], problem.goal)]
    error = pose_error(*ends)
    moved, turned = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    cause = GOAL_MISSED if moved > GOAL_POSITION or turned > GOAL_ROTATION else ""
    is_free = check_edges(room, position[:-1], position[1:], contact=TOUCH).is_free
    if not is_free.all():
        contact = deepest_contact(problem, position)
        surface = HIT_SEEN if views.has_seen(contact.point[None])[0] else HIT_UNSEEN
        cause = HIT_SELF if contact.is_own else surface
    alone = Clearance.of(problem.model.replace_self_pairs(NO_PAIRS), problem.solids)
    clearance = least_clearance(alone, position, tolerance=5e-4)
    return Execution(
        cause=cause,
        clearance=min(clearance.upper, 0.0) if cause in (HIT_SEEN, HIT_UNSEEN) else clearance.upper,
        position_error=moved,
        rotation_error=turned,
    )


@dataclass(frozen=True, kw_only=True)
class Contact:
    """A place of a motion, such as the deepest contact: the posture q (J,), the number of the arm's sphere, the
    touched point (3,) [m], world, and the time in words. is_own: the point is the arm's own.
    """

    q: Float64
    sphere: int
    point: Float64
    when: str
    is_own: bool = False


def deepest_contact(problem: Problem, position: Float64) -> Contact:
    """Of the states (T, J) and of the middles between them."""
    room = Clearance.of(problem.model, problem.solids)
    postures = np.concatenate([position, 0.5 * (position[:-1] + position[1:])])
    rows = room.rows(postures)
    deepest, row = np.unravel_index(int(np.argmin(rows)), rows.shape)
    q = postures[deepest]
    when = f"state {deepest % len(position)} of {len(position)}"
    centers = problem.model.sphere_centers(q)
    if row >= len(room.moving):
        first, second = room.pairs[row - len(room.moving)]
        middle = 0.5 * (centers[first] + centers[second])
        return Contact(q=q, sphere=int(first), point=middle, is_own=True, when=when)
    sphere = int(room.moving[row])
    _, surface = closest_of(problem.primitives, centers[sphere][None], 0)
    return Contact(q=q, sphere=sphere, point=surface[0], when=when)


@dataclass(kw_only=True)
class MotionSource:
    """A motion as a log without frames."""

    name: str
    joint_names: tuple[str, ...]
    cameras: tuple[str, ...] = ()
    has_clock: bool = True
    loss: LossReport = field(default_factory=LossReport)

    def records(self) -> Iterator[Record]:
        """None: the states are read already."""
        return iter(())

    def digests(self) -> dict[str, str]:
        """None: it is no file."""
        return {}


def measured(model: RobotModel, config: Config) -> MeasuredRobot:
    """The robot with the surface outside its spheres measured, as a verdict needs it."""
    return measured_robot(REQUEST, model, config.control)


def verdict_on(robot: MeasuredRobot, position: Float64, stamp_ns: int, known: KnownScene, config: Config) -> Verdict:
    """The verdict of an audit of a motion (T, J) from `stamp_ns` [ns], a state each period, only by the map."""
    period = config.control.period
    stamps = stamp_ns + np.round(np.arange(len(position)) * period * 1e9).astype(np.int64)
    straight = np.zeros_like(position)  # a driven arm moves straight from state to state
    states = StateColumns(stamp_ns=stamps, position=position, velocity=straight)
    source = MotionSource(name="trial", joint_names=robot.model.joint_names)
    logged = LoggedStates(source=source, states=states, poses=None)
    inputs = ReplayInputs(
        source=source,
        states=states,
        model=robot.model,
        scene=known,
        truth=None,
        digests={},
        surfaces=robot.surfaces,
        pair_margins=robot.pair_margins,
    )
    request = ReplayRequest(log=REQUEST.log, out=REQUEST.out, config=config)
    found = replayed(request, inputs, SILENT)
    metrics = metrics_of(found) | logged.metrics()
    return replay_verdict(Judged(request=request, inputs=inputs, logged=logged, replay=found, metrics=metrics))

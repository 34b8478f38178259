"""The replays themselves: audit, open loop and closed loop over what was read, and the truth beside them."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.known_scene import KnownScene
from splatctrl_cli.cli.replay_baseline import read_baselines, read_zone, separations
from splatctrl_cli.cli.replay_compare import Comparison, compared
from splatctrl_cli.cli.replay_goal import goal_waypoints
from splatctrl_cli.cli.replay_twists import twist_figures, twist_track
from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.audit import AuditTrace, audit, checked_states
from splatctrl_cli.control.checks import StaticViolation, static_violations
from splatctrl_cli.control.course import LoggedMotion
from splatctrl_cli.control.explain import Event, EventKind, audit_signals, events_of, stale_signal, step_signals
from splatctrl_cli.control.open_loop import OpenLoopTask, OpenLoopTrace, open_loop
from splatctrl_cli.control.replay import ReplayTask, ReplayTrace, closed_loop, divergence
from splatctrl_cli.control.rows import scene_margin
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.control.twists import TwistTrack
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.clearance import clearance_agreement, mark_seen
from splatctrl_cli.records import Float64, JointState, RecordSource, RgbdFrame

if TYPE_CHECKING:
    from collections.abc import Mapping

    from splatctrl_cli.config import Config
    from splatctrl_cli.control.explain import Obstacle
    from splatctrl_cli.control.standstill import Separation
    from splatctrl_cli.evaluate.clearance import ClearanceAgreement
    from splatctrl_cli.robot.model import RobotModel
    from splatctrl_cli.simulate.truth import Truth


@dataclass(frozen=True, kw_only=True)
class ReplayInputs:
    """Everything a replay reads; states in the model's joint order."""

    source: RecordSource
    states: tuple[JointState, ...]
    model: "RobotModel"
    scene: KnownScene
    truth: "Truth | None"
    digests: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Divergence:
    """How far a closed loop is from the log at each of T states: joints (T,) [rad], position [m], rotation [rad]."""

    joints: Float64
    position: Float64
    rotation: Float64


@dataclass(frozen=True, kw_only=True)
class Replay:
    """One finished replay of T states: their audit, the trace of its mode, and the truth where it is known.

    num_before_scene: logged states earlier than the first scene, left out; start_time_s: of the first state in the
    log [s]; obstacles (T,): what is nearest to the nearest sphere; map_age_s (T,): of the scene in use; separations:
    with a standstill the distances from people, by name of the motion, sampled at `period` [s]; comparison: every
    motion of --baseline and its figures.
    """

    model: "RobotModel"
    margin: float
    audit: AuditTrace
    num_before_scene: int
    median_radius: float
    static_violations: tuple[StaticViolation, ...]
    obstacles: "tuple[Obstacle | None, ...]"
    map_age_s: Float64
    start_time_s: float
    open_loop: OpenLoopTrace | None = None
    closed_loop: ReplayTrace | None = None
    divergence: Divergence | None = None
    true_clearance: Float64 | None = None
    agreement: "Mapping[str, ClearanceAgreement]" = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    separations: "Mapping[str, Separation]" = field(default_factory=dict)
    comparison: Comparison = field(default_factory=Comparison)
    twist_figures: "Mapping[str, float | None]" = field(default_factory=dict)
    period: float = 0.0

    @property
    def mode(self) -> str:
        """As --mode has it."""
        return "closed-loop" if self.closed_loop else "open-loop" if self.open_loop else "audit"

    @property
    def steps(self) -> Sequence[ControlStep | None]:
        """What the controller decided at each state; empty in an audit."""
        trace = self.closed_loop or self.open_loop
        return () if trace is None else trace.steps


def replayed(args: argparse.Namespace, inputs: ReplayInputs, config: "Config", console: Console) -> Replay:
    """The replay that --mode asks for, with its events."""
    mode = {"audit": _audited, "open-loop": _asked, "closed-loop": _driven}[args.mode]
    zone = read_zone(args)
    replay = mode(args, inputs, config, console)
    replay = replace(
        replay,
        events=_explained(replay, inputs, args.max_map_age),
        separations=separations(args, zone, inputs, replay, config),
        period=config.control.period,
    )
    return replace(replay, comparison=compared(args, read_baselines(args), inputs, replay, config, console))


def with_truth(inputs: ReplayInputs, replay: Replay) -> Replay:
    """The true clearance of every state, and how an audit agrees with it near surfaces that a camera saw."""
    if inputs.truth is None:
        return replay
    model, trace = inputs.model, replay.audit
    moving = np.flatnonzero(model.moving_spheres)
    radii = model.sphere_set.radii[moving]
    clearance, surface = np.zeros(len(trace.stamp_ns)), np.zeros((len(trace.stamp_ns), 3))
    for index, (stamp, q) in enumerate(zip(trace.stamp_ns, trace.position, strict=True)):
        distance, points = inputs.truth.closest(model.sphere_centers(q)[moving], int(stamp))
        nearest = int(np.argmin(distance - radii))
        clearance[index], surface[index] = distance[nearest] - radii[nearest], points[nearest]
    seen = np.zeros(len(clearance), dtype=np.bool_)
    for record in inputs.source.records():
        if isinstance(record, RgbdFrame) and (inputs.scene.cameras is None or record.camera in inputs.scene.cameras):
            mark_seen(seen, surface, trace.stamp_ns, record, has_clock=inputs.source.has_clock)
    agreement = {
        name: clearance_agreement(of.distance, clearance, seen, replay.median_radius)
        for name, of in trace.clearance.items()
    }
    return replace(replay, true_clearance=clearance, agreement=agreement)


def _audited(args: argparse.Namespace, inputs: ReplayInputs, config: "Config", console: Console) -> Replay:
    """The audit of every logged state for which a scene was known."""
    states = _known_states(inputs)
    scene, model = inputs.scene, inputs.model
    trace = audit(model, states, lambda stamp: scene.at(stamp).distances, observed=scene.observed)
    last = scene.at(int(trace.stamp_ns[-1]))
    statics = static_violations(model, last.barrier, trace.position[-1], scene_margin(model, config.control))
    return _replay(inputs, config, trace, statics, num_before=len(inputs.states) - len(states), radius_of=-1)


def _asked(args: argparse.Namespace, inputs: ReplayInputs, config: "Config", console: Console) -> Replay:
    """The audit, and the controller's command at every state of it."""
    replay = _audited(args, inputs, config, console)
    scene, model, trace = inputs.scene, inputs.model, replay.audit
    velocity = np.array([state.velocity for state in inputs.states[replay.num_before_scene :]])
    motion = LoggedMotion(stamp_ns=trace.stamp_ns, position=trace.position, velocity=velocity)
    frame = args.frame or model.frame_names[-1]
    twists = twist_track(args, model, _span(inputs), console)
    task = OpenLoopTask(frame=frame, twists=twists)
    if any(given is not None for given in (args.goal, args.goal_joints, args.waypoints)):
        goals = goal_waypoints(args, model, frame, trace.position[-1])
        task = OpenLoopTask(frame=frame, T_world_goal=goals[-1].T_world_goal, home=goals[-1].posture)
    has_distance = np.all([np.isfinite(c.distance) for c in trace.clearance.values()], axis=0)
    console.log(f"replay: asking the controller at {len(trace.stamp_ns)} states")
    asked = open_loop(
        model,
        config.control,
        motion,
        task,
        lambda stamp: scene.at(stamp).barrier,
        has_distance=has_distance,
        scene_step_at=scene.step_at,
    )
    figures = twist_figures(model, config.control, frame, twists, trace.stamp_ns, trace.position, asked.steps)
    return replace(replay, open_loop=asked, twist_figures=figures)


def _driven(args: argparse.Namespace, inputs: ReplayInputs, config: "Config", console: Console) -> Replay:
    """The closed loop, the audit of the states it went through, and how far they are from the log."""
    scene, model = inputs.scene, inputs.model
    motion = logged_motion(inputs)
    task = _task(args, inputs, motion, twist_track(args, model, _span(inputs), console))
    start_s = (task.stamp_ns - inputs.states[0].stamp_ns) * 1e-9
    limit = "to the log's end" if task.last_ns is not None else f"at most {config.control.max_time:g} s"
    console.log(f"replay: from {start_s:.2f} s of the log, {limit}")
    trace = closed_loop(
        model, config.control, task, lambda stamp: scene.at(stamp).barrier, scene_step_at=scene.step_at
    )
    states = [
        JointState(stamp_ns=int(stamp), position=q, velocity=step.velocity)
        for stamp, q, step in zip(trace.stamp_ns, trace.position, trace.steps, strict=True)
    ]
    audited = audit(model, states, lambda stamp: scene.at(stamp).distances, observed=scene.observed)
    joints, position, rotation = divergence(model, task.frame, trace.stamp_ns, trace.position, motion)
    return replace(
        _replay(inputs, config, audited, trace.static_violations, num_before=0, radius_of=0),
        closed_loop=trace,
        divergence=Divergence(joints=joints, position=position, rotation=rotation),
        twist_figures=twist_figures(
            model, config.control, task.frame, task.twists, trace.stamp_ns, trace.position, trace.steps
        ),
    )


def _replay(
    inputs: ReplayInputs,
    config: "Config",
    trace: AuditTrace,
    statics: tuple[StaticViolation, ...],
    *,
    num_before: int,
    radius_of: int,
) -> Replay:
    first_ns = int(trace.stamp_ns[0])
    return Replay(
        model=inputs.model,
        margin=config.control.margin,
        audit=trace,
        num_before_scene=num_before,
        median_radius=inputs.scene.at(int(trace.stamp_ns[radius_of])).median_radius,
        static_violations=statics,
        obstacles=_obstacles(inputs, trace),
        map_age_s=np.array([inputs.scene.age_s(int(stamp)) for stamp in trace.stamp_ns]),
        start_time_s=(first_ns - inputs.states[0].stamp_ns) * 1e-9,
    )


def _known_states(inputs: ReplayInputs) -> list[JointState]:
    scene = inputs.scene
    states = [s for s in inputs.states if scene.first_ns is None or s.stamp_ns >= scene.first_ns]
    if inputs.states and not states:
        raise NotEvaluableError(
            f"{inputs.source.name}: all {len(inputs.states)} joint states are earlier than the first known scene",
            remedy="reconstruct with more snapshots, or replay against --field",
        )
    return states


def logged_motion(inputs: ReplayInputs) -> LoggedMotion:
    """Every logged state, whether a scene was known or not."""
    stamps, positions = checked_states(inputs.model, inputs.states)
    return LoggedMotion(
        stamp_ns=stamps, position=positions, velocity=np.array([state.velocity for state in inputs.states])
    )


def _span(inputs: ReplayInputs) -> tuple[int, int]:
    return int(inputs.states[0].stamp_ns), int(inputs.states[-1].stamp_ns)


def _task(
    args: argparse.Namespace, inputs: ReplayInputs, motion: LoggedMotion, twists: TwistTrack | None
) -> ReplayTask:
    """The start (logged, and not before the scene is known) and the goal (given, or the logged end)."""
    stamps, positions = motion.stamp_ns, motion.position
    earliest = stamps[0] if args.start_time is None else stamps[0] + round(args.start_time * 1e9)
    if args.start_time is None and inputs.scene.first_ns is not None:
        earliest = max(earliest, inputs.scene.first_ns)
    start = int(np.searchsorted(stamps, earliest))
    if start == len(stamps):
        raise InputError(
            f"{inputs.source.name}: expected a start within {(stamps[-1] - stamps[0]) * 1e-9:.2f} s of joint states, "
            f"got {(earliest - stamps[0]) * 1e-9:.2f} s",
            remedy="give an earlier --start-time",
        )
    frame = args.frame or inputs.model.frame_names[-1]
    end = positions[-1] if twists is None else positions[start]
    *via, goal = goal_waypoints(args, inputs.model, frame, end)
    return ReplayTask(
        start=positions[start],
        T_world_goal=goal.T_world_goal,
        frame=frame,
        stamp_ns=int(stamps[start]),
        home=goal.posture,
        via=tuple(via),
        follow=motion if args.follow else None,
        twists=twists,
        end_ns=motion.last_ns,
        anchors=motion if args.re_anchor else None,
        anchor_period=args.re_anchor or 0.0,
    )


def _obstacles(inputs: ReplayInputs, trace: AuditTrace) -> "tuple[Obstacle | None, ...]":
    """What is nearest to the nearest sphere at every state, by the controller's field; None without a distance."""
    nearest = trace.clearance["barrier"]
    found: list[Obstacle | None] = [None] * len(trace.stamp_ns)
    for fields, group in groupby(
        np.flatnonzero(np.isfinite(nearest.distance)), key=lambda index: inputs.scene.at(int(trace.stamp_ns[index]))
    ):
        states = list(group)
        centers = inputs.model.sphere_centers_batch(trace.position[states])
        points = np.ascontiguousarray(centers[np.arange(len(states)), nearest.sphere[states]])
        for state, obstacle in zip(states, fields.obstacles(points), strict=True):
            found[state] = obstacle
    return tuple(found)


def _explained(replay: Replay, inputs: ReplayInputs, max_map_age: float) -> tuple[Event, ...]:
    """Every event of a replay; where a sphere is behind its worst value, with the obstacle nearest to that sphere."""
    trace, model = replay.audit, replay.model
    spheres = sphere_names(model.sphere_set)
    signals = audit_signals(trace, replay.margin, spheres, model.joint_names)
    signals.append(stale_signal(replay.map_age_s, max_map_age))
    if replay.steps:
        signals += step_signals(replay.steps)
    events = []
    for event in events_of(trace.stamp_ns, signals):
        if event.worst_name in spheres and event.kind is not EventKind.WITHOUT_DISTANCE:
            center = model.sphere_centers(trace.position[event.state])[[spheres.index(event.worst_name)]]
            fields = inputs.scene.at(int(trace.stamp_ns[event.state]))
            event = replace(event, obstacle=fields.obstacles(center)[0])  # noqa: PLW2901
        events.append(event)
    return tuple(events)

"""The replays themselves: audit, open loop and closed loop over what was read, and the truth beside them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import Config
from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.checks import StaticViolation, check_within_limits, static_violations
from splatctrl_cli.control.events import Event, EventFold, EventKind, Obstacle
from splatctrl_cli.control.goals import LoggedMotion, TwistTrack
from splatctrl_cli.control.open_loop import OpenLoopTask, open_loop
from splatctrl_cli.control.replay import ReplayTask, ReplayTrace, closed_loop, divergence, scene_change
from splatctrl_cli.control.rows import scene_margin
from splatctrl_cli.control.signals import clearance_signals
from splatctrl_cli.control.standstill import Separation
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.errors import InputError, NotEvaluableError
from splatctrl_cli.evaluate.clearance import ClearanceAgreement, clearance_agreement, mark_seen
from splatctrl_cli.files.rows import RowFile, Rows, ranges
from splatctrl_cli.jobs.known_scene import KnownScene
from splatctrl_cli.jobs.progress import Progress
from splatctrl_cli.jobs.replay_baseline import read_baselines, read_zone, separations
from splatctrl_cli.jobs.replay_compare import Comparison, compared, planned_ways_out
from splatctrl_cli.jobs.replay_evidence import MapError
from splatctrl_cli.jobs.replay_goal import goal_waypoints
from splatctrl_cli.jobs.replay_record import ReplayRecord
from splatctrl_cli.jobs.replay_request import FIRST_MAP, ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay_states import check_inside
from splatctrl_cli.jobs.replay_store import Figures, StoredAudit, StoredLoop, StoredOpenLoop, StoredSteps
from splatctrl_cli.jobs.replay_twists import twist_figures, twist_track
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.records import Float64, FloatRows, RgbdFrame
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.truth import distance_to


@dataclass(frozen=True, kw_only=True)
class Divergence:
    """How far a closed loop is from the log at each of T states: joints (T,) [rad], position [m], rotation [rad]."""

    joints: FloatRows
    position: FloatRows
    rotation: FloatRows


@dataclass(frozen=True, kw_only=True)
class Replay:
    """One finished replay of T states: their audit, the trace of its mode, and the truth where it is known.

    num_before_scene: requested states earlier than the first scene, left out, over lead_in_s [s]; start_time_s: of
    the first state in the log [s]; between, near, strain and statics: as `ReplayRecord` has them; obstacles (T,):
    what is nearest to the nearest sphere, in words; map_age_s (T,): of the scene in use; kept_steps: of a controller;
    map_error: where the request names evidence of it; separations: with a standstill the distances from people, by
    name of the motion, sampled at `period` [s]; comparison: every motion of --baseline and its figures.
    """

    model: "RobotModel"
    margin: float
    audit: StoredAudit
    num_before_scene: int
    lead_in_s: float
    median_radius: float
    static_violations: tuple[StaticViolation, ...]
    obstacles: Sequence[str]
    map_age_s: FloatRows
    start_time_s: float
    between: Figures
    near: Figures
    strain: Figures
    statics: "Mapping[str, tuple[float, float]]"
    open_loop: StoredOpenLoop | None = None
    closed_loop: ReplayTrace | None = None
    divergence: Divergence | None = None
    kept_steps: StoredSteps | None = None
    true_clearance: FloatRows | None = None
    agreement: "Mapping[str, ClearanceAgreement]" = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    separations: "Mapping[str, Separation]" = field(default_factory=dict)
    comparison: Comparison = field(default_factory=Comparison)
    twist_figures: "Mapping[str, float | None]" = field(default_factory=dict)
    map_error: MapError | None = None
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


def replayed(request: ReplayRequest, inputs: ReplayInputs, config: "Config", console: Progress) -> Replay:
    """The replay that --mode asks for, with its events."""
    if inputs.scene.box is not None:
        check_inside(inputs.model, inputs.states.position[0], inputs.scene.box)
    mode = {"audit": _audited, "open-loop": _asked, "closed-loop": _driven}[request.mode]
    zone = read_zone(request)
    replay = mode(request, inputs, config, console)
    replay = replace(
        replay,
        separations=separations(request, zone, inputs, replay, config),
        period=config.control.period,
    )
    return replace(replay, comparison=compared(request, read_baselines(request), inputs, replay, config, console))


def with_truth(inputs: ReplayInputs, replay: Replay) -> Replay:
    """The true clearance of every state, and how an audit agrees with it near surfaces that a camera saw."""
    if inputs.truth is None:
        return replay
    model, trace = inputs.model, replay.audit
    moving = np.flatnonzero(model.moving_spheres)
    radii = model.sphere_set.radii[moving]
    clearances, surfaces, nearest_spheres = RowFile(), RowFile((3,)), RowFile()
    for first, last in ranges(len(trace.stamp_ns)):
        clearance, surface = np.zeros(last - first), np.zeros((last - first, 3))
        spheres = np.zeros(last - first)
        stamps, positions = trace.stamp_ns[first:last].tolist(), trace.position[first:last]
        for index, (stamp, q) in enumerate(zip(stamps, positions, strict=True)):
            distance, points = inputs.truth.closest(model.sphere_centers(q)[moving], stamp)
            gap = _unexpected(inputs, moving, distance - radii, points, stamp, replay.margin)
            nearest = int(np.argmin(gap))
            clearance[index], surface[index] = gap[nearest], points[nearest]
            spheres[index] = moving[nearest]
        clearances.append(clearance)
        nearest_spheres.append(spheres)
        surfaces.append(surface)
    truth, seen = Rows(clearances), np.zeros(len(clearances), dtype=np.bool_)
    events = _true_events(inputs, replay, np.asarray(truth), Rows(nearest_spheres))
    for record in inputs.source.records() if inputs.source.cameras else ():
        if isinstance(record, RgbdFrame) and (inputs.scene.cameras is None or record.camera in inputs.scene.cameras):
            mark_seen(seen, Rows(surfaces), trace.stamp_ns, record, has_clock=inputs.source.has_clock)
    agreement = {
        name: clearance_agreement(of.distance, np.asarray(truth), seen, replay.median_radius)
        for name, of in trace.clearance.items()
    }
    merged = tuple(sorted((*replay.events, *events), key=lambda event: (event.first_ns, -event.last_ns)))
    return replace(replay, true_clearance=truth, agreement=agreement, events=merged)


def _unexpected(
    inputs: ReplayInputs, moving: NDArray[np.intp], gap: Float64, points: Float64, stamp_ns: int, margin: float
) -> Float64:
    """True clearances (M,) of the moving spheres to points (M, 3), infinite where the contact is declared."""
    if not inputs.declared.expected_contact:
        return gap
    links, seconds = inputs.model.sphere_set.links, (stamp_ns - int(inputs.states.stamp_ns[0])) * 1e-9
    is_meant = [
        bool(gap[k] < margin and inputs.declared.expects(links[sphere], points[k], seconds))
        for k, sphere in enumerate(moving)
    ]
    return np.where(is_meant, np.inf, gap)


def _true_events(inputs: ReplayInputs, replay: Replay, clearance: Float64, spheres: Rows) -> tuple[Event, ...]:
    """Intervals (of T states) below the margin, and in contact, by the truth."""
    model, truth, audit = inputs.model, inputs.truth, replay.audit
    assert truth is not None
    names = sphere_names(model.sphere_set)
    nearest = np.asarray(spheres[: len(clearance)], np.int64)
    fold = EventFold()

    def near(kind: EventKind, name: str, at: int) -> Obstacle | None:
        stamp, center = int(audit.stamp_ns[at]), model.sphere_centers(audit.position[at])[[names.index(name)]]
        distance, surface = truth.closest(center, stamp)
        there = [p for p in truth.primitives if p.is_present(stamp)]
        least = min(there, key=lambda p: float(distance_to([p], center, stamp)[0]))
        x, y, z = (float(v) for v in surface[0])
        return Obstacle(distance=float(distance[0]), position=(x, y, z), name=least.name)

    fold.add(audit.stamp_ns, clearance_signals("true", clearance, nearest, replay.margin, names), near)
    return fold.events()


def _audited(request: ReplayRequest, inputs: ReplayInputs, config: "Config", console: Progress) -> Replay:
    """The audit of every logged state for which a scene was known."""
    first, record = _first_judged(request, inputs), _record(request, inputs, config)
    for stamps, positions, velocities in _blocks(record, inputs.states, first):
        record.explain(record.measured(stamps, positions, velocities))
    return _logged(request, inputs, config, record, first)


def _asked(request: ReplayRequest, inputs: ReplayInputs, config: "Config", console: Progress) -> Replay:
    """The audit, and the controller's command at every state of it."""
    scene, model, states = inputs.scene, inputs.model, inputs.states
    first, record = _first_judged(request, inputs), _record(request, inputs, config)
    frame = request.frame or model.frame_names[-1]
    twists = twist_track(request, model, _span(inputs), console)
    task = OpenLoopTask(frame=frame, twists=twists)
    if any(given is not None for given in (request.goal, request.goal_joints, request.waypoints)):
        goals = goal_waypoints(request, model, frame, states.position[-1])
        task = OpenLoopTask(frame=frame, T_world_goal=goals[-1].T_world_goal, home=goals[-1].posture)
    console.log(f"replay: asking the controller at {len(states) - first} states")
    asked = StoredOpenLoop()
    for stamps, positions, velocities in _blocks(record, states, first):
        part = record.measured(stamps, positions, velocities)
        trace = open_loop(
            model,
            config.control,
            LoggedMotion(stamp_ns=stamps, position=positions, velocity=velocities),
            task,
            lambda stamp: scene.at(stamp).barrier,
            has_distance=np.all([np.isfinite(c.distance) for c in part.clearance.values()], axis=0),
            scene_step_at=scene.step_at,
        )
        asked.add(trace)
        record.explain(part, trace.steps)
    audit = record.audit
    figures = twist_figures(model, config.control, frame, twists, audit.stamp_ns, audit.position, asked.steps)
    return replace(
        _logged(request, inputs, config, record, first), open_loop=asked, kept_steps=asked.kept, twist_figures=figures
    )


def _with_next_scene(trace: ReplayTrace, scene: KnownScene, model: RobotModel) -> ReplayTrace:
    """With what the first scene after the motion shows: something may have come between the last two."""
    last_ns = int(trace.stamp_ns[-1])
    next_ns = scene.next_ns(last_ns)
    if next_ns is None:
        return trace
    before, after = scene.at(last_ns).barrier, scene.at(next_ns).barrier
    change = scene_change(model, next_ns, np.asarray(trace.position[-1]), before, after)
    return replace(trace, scene_changes=(*trace.scene_changes, change))


def _driven(request: ReplayRequest, inputs: ReplayInputs, config: "Config", console: Progress) -> Replay:
    """The closed loop, the audit of the states it went through, and how far they are from the log."""
    scene, model, record = inputs.scene, inputs.model, _record(request, inputs, config)
    motion = inputs.motion()
    twists = twist_track(request, model, _span(inputs), console)
    task = _task(request, inputs, motion, twists, config.control.limit_tolerance)
    start_s = (task.stamp_ns - int(inputs.states.stamp_ns[0])) * 1e-9
    limit = "to the log's end" if task.last_ns is not None else f"at most {config.control.max_time:g} s"
    console.log(f"replay: from {start_s:.2f} s of the log, {limit}")
    loop = StoredLoop(model.num_joints)
    trace = closed_loop(
        model,
        config.control,
        task,
        lambda stamp: scene.at(stamp).barrier,
        scene_step_at=scene.step_at,
        plan_detour=planned_ways_out(inputs, task, config),
        record=loop,
    )
    trace = _with_next_scene(trace, scene, model)
    apart = Figures()
    for first, last in record.blocks(trace.stamp_ns):
        stamps, positions = trace.stamp_ns[first:last], np.asarray(trace.position[first:last])
        steps = trace.steps[first:last]
        straight = np.zeros_like(positions)  # the driven arm moves straight from state to state
        record.explain(record.measured(stamps, positions, straight), steps)
        joints, position, rotation = divergence(model, task.frame, stamps, positions, motion)
        apart.append(joints=joints, position=position, rotation=rotation)
    return replace(
        _replay(request, inputs, config, record, trace.static_violations, radius_of=0),
        closed_loop=trace,
        kept_steps=loop.kept,
        divergence=Divergence(
            joints=apart.rows("joints"), position=apart.rows("position"), rotation=apart.rows("rotation")
        ),
        twist_figures=twist_figures(
            model, config.control, task.frame, task.twists, trace.stamp_ns, trace.position, trace.steps
        ),
    )


def _record(request: ReplayRequest, inputs: ReplayInputs, config: "Config") -> ReplayRecord:
    return ReplayRecord(
        inputs.model,
        inputs.scene,
        config=config,
        max_map_age=request.max_map_age,
        is_continuous=request.re_anchor is None,
        declared=inputs.declared,
        first_state_ns=int(inputs.states.stamp_ns[0]),
    )


def _blocks(record: ReplayRecord, states: StateColumns, start: int) -> Iterator[tuple[Stamps, Float64, Float64]]:
    """Stamps (T,), positions and velocities (T, J) of the states from `start` on, a block at a time."""
    for first, last in record.blocks(states.stamp_ns[start:]):
        part = slice(start + first, start + last)
        yield states.stamp_ns[part], states.position[part], states.velocity[part]


def _logged(
    request: ReplayRequest, inputs: ReplayInputs, config: "Config", record: ReplayRecord, first: int
) -> Replay:
    """The replay of logged states from `first` on, whose static violations are those at the end."""
    states, model = inputs.states, inputs.model
    last = inputs.scene.at(int(states.stamp_ns[-1]))
    statics = static_violations(model, last.barrier, states.position[-1], scene_margin(model, config.control))
    return _replay(request, inputs, config, record, statics, radius_of=-1)


def _replay(
    request: ReplayRequest,
    inputs: ReplayInputs,
    config: "Config",
    record: ReplayRecord,
    statics: tuple[StaticViolation, ...],
    *,
    radius_of: int,
) -> Replay:
    stamps = record.audit.stamp_ns
    requested, logged = _requested_ns(request, inputs), inputs.states.stamp_ns
    before = logged[(logged >= requested) & (logged < stamps[0])]
    return Replay(
        model=inputs.model,
        margin=config.control.margin,
        audit=record.audit,
        num_before_scene=len(before),
        lead_in_s=float(int(stamps[0]) - int(before[0])) * 1e-9 if len(before) else 0.0,
        median_radius=inputs.scene.at(int(stamps[radius_of])).median_radius,
        static_violations=statics,
        obstacles=record.obstacles,
        map_age_s=record.ages.rows("map_age_s"),
        start_time_s=float(int(stamps[0]) - int(inputs.states.stamp_ns[0])) * 1e-9,
        between=record.between,
        near=record.near,
        strain=record.strain,
        statics=record.statics,
        events=record.events.events(),
    )


def _requested_ns(request: ReplayRequest, inputs: ReplayInputs) -> int:
    """The stamp from which on the request wants the log replayed. Raises InputError for one after its end."""
    scene, stamps = inputs.scene, inputs.states.stamp_ns
    if request.start_time is None:
        return int(stamps[0])
    if request.start_time == FIRST_MAP:
        return max(int(stamps[0]), int(stamps[0]) if scene.first_ns is None else scene.first_ns)
    start = int(stamps[0]) + round(float(request.start_time) * 1e9)
    if start > stamps[-1]:
        raise InputError(
            f"{inputs.source.name}: expected a start within {(stamps[-1] - stamps[0]) * 1e-9:.2f} s of joint states, "
            f"got {(start - stamps[0]) * 1e-9:.2f} s",
            remedy="give an earlier --start-time",
        )
    return start


def _first_judged(request: ReplayRequest, inputs: ReplayInputs) -> int:
    """The first requested state for which a scene is known."""
    scene, stamps = inputs.scene, inputs.states.stamp_ns
    earliest = _requested_ns(request, inputs)
    first = int(np.searchsorted(stamps, earliest if scene.first_ns is None else max(earliest, scene.first_ns)))
    if first == len(stamps):
        raise NotEvaluableError(
            f"{inputs.source.name}: all {len(stamps)} joint states are earlier than the first known scene",
            remedy="reconstruct with more snapshots, or replay against --field",
        )
    return first


def _span(inputs: ReplayInputs) -> tuple[int, int]:
    return int(inputs.states.stamp_ns[0]), int(inputs.states.stamp_ns[-1])


def _task(
    request: ReplayRequest, inputs: ReplayInputs, motion: LoggedMotion, twists: TwistTrack | None, tolerance: float
) -> ReplayTask:
    """The start (logged, and not before the scene is known) and the goal (given, or the logged end)."""
    stamps, positions = motion.stamp_ns, motion.position
    start = _first_judged(request, inputs)
    frame = request.frame or inputs.model.frame_names[-1]
    end = positions[-1] if twists is None else positions[start]
    *via, goal = goal_waypoints(request, inputs.model, frame, end)
    for waypoint in (*via, goal):
        if waypoint.posture is not None:
            check_within_limits(inputs.model, waypoint.posture, tolerance, what="goal")
    return ReplayTask(
        start=positions[start],
        T_world_goal=goal.T_world_goal,
        frame=frame,
        stamp_ns=int(stamps[start]),
        home=goal.posture,
        via=tuple(via),
        follow=motion if request.follow else None,
        twists=twists,
        end_ns=motion.last_ns,
        anchors=motion if request.re_anchor else None,
        anchor_period=request.re_anchor or 0.0,
    )

"""Replays by mode: audit, open loop and closed loop."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.barriers import scene_margin
from splatctrl_cli.control.columns import step_columns
from splatctrl_cli.control.goals import LoggedMotion, PlanDetour, TwistTrack
from splatctrl_cli.control.outside import OutsideController
from splatctrl_cli.control.preconditions import StaticViolation, check_within_limits, static_violations
from splatctrl_cli.control.replay import (
    OpenLoopTask,
    ReplayTask,
    closed_loop,
    divergence,
    open_loop,
)
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.errors import NotEvaluableError, refuse_if
from splatctrl_cli.files.spilled_rows import ObjectFile
from splatctrl_cli.jobs.recordings.provenance import times_apart
from splatctrl_cli.jobs.replay.goal import commander_of, goal_waypoints, twist_figures, twist_track
from splatctrl_cli.jobs.replay.inputs import check_inside
from splatctrl_cli.jobs.replay.known_scene import Certified, KnownScene, certified_distance
from splatctrl_cli.jobs.replay.request import Replay, ReplayInputs, ReplayRequest, SceneChange
from splatctrl_cli.jobs.replay.state_pass import ReplayRecord, blocks_of
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.planner.planned import planned_detours
from splatctrl_cli.records import Float64, Stamps


def replayed(request: ReplayRequest, inputs: ReplayInputs, console: Progress) -> Replay:
    if inputs.scene.box is not None:
        check_inside(inputs.model, inputs.states.position[0], inputs.scene.box)
    return {"audit": _audit, "open-loop": _ask, "closed-loop": _drive}[request.mode](request, inputs, console)


def _audit(request: ReplayRequest, inputs: ReplayInputs, console: Progress) -> Replay:
    first, record = _first_judged(request, inputs), _record(request, inputs)
    for stamps, positions, velocities in _blocks(inputs, first):
        record.measure_block(stamps, positions, velocities)
    return _finish_logged(request, inputs, record, first)


def _ask(request: ReplayRequest, inputs: ReplayInputs, console: Progress) -> Replay:
    scene, model, states, control = inputs.scene, inputs.model, inputs.states, request.config.control
    first, record = _first_judged(request, inputs), _record(request, inputs)
    frame = request.frame or model.frame_names[-1]
    twists = twist_track(request, model, inputs.states.stamp_ns, console)
    task = OpenLoopTask(frame=frame, twists=twists)
    if any(goal is not None for goal in (request.goal, request.goal_joints, request.waypoints)):
        goals = goal_waypoints(request, model, frame, states.position[-1])
        task = OpenLoopTask(frame=frame, T_world_goal=goals[-1].T_world_goal, home=goals[-1].posture)
    console.log(f"replay: asking the controller at {len(states) - first} states")
    with commander_of(request, inputs, console, frame=frame, home=task.home) as commander:
        for stamps, positions, velocities in _blocks(inputs, first):
            part = record.measure_block(stamps, positions, velocities)
            commanded = open_loop(
                model,
                control,
                LoggedMotion(stamp_ns=stamps, position=positions, velocity=velocities),
                task,
                lambda stamp: scene.at(stamp).barrier,
                has_distance=np.all([np.isfinite(c.distance) for c in part.clearance.values()], axis=0),
                scene_step_at=scene.step_at,
                commander=commander,
            )
            record.trace.append(commanded)
    return replace(
        _finish_logged(request, inputs, record, first),
        twist_figures=twist_figures(model, control, frame, twists, record.trace),
        outside=commander if isinstance(commander, OutsideController) else None,
    )


def _measure_change(
    scene: KnownScene, record: ReplayRecord, before_ns: int, stamp_ns: int, position: Float64
) -> Iterator[SceneChange]:
    """Change between the scenes of two stamps, for the arm at `position` (1, J)."""
    if scene.at(before_ns) is not scene.at(stamp_ns):
        before, after = (record.clearance_in(ns, np.array([stamp_ns]), position)[0] for ns in (before_ns, stamp_ns))
        yield SceneChange(stamp_ns=stamp_ns, before=float(before), after=float(after))


def _drive(request: ReplayRequest, inputs: ReplayInputs, console: Progress) -> Replay:
    scene, model, record = inputs.scene, inputs.model, _record(request, inputs)
    motion, control = inputs.motion(), request.config.control
    task = _task(
        request,
        inputs,
        motion,
        twist_track(request, model, inputs.states.stamp_ns, console),
        control.limit_tolerance,
    )
    start_s = (task.stamp_ns - int(inputs.states.stamp_ns[0])) * 1e-9
    limit = "to the log's end" if task.last_ns is not None else f"at most {control.max_time:g} s"
    console.log(f"replay: from {start_s:.2f} s of the log, {limit}")
    with commander_of(request, inputs, console, frame=task.frame, home=task.home) as commander:
        trace = closed_loop(
            model,
            control,
            task,
            lambda stamp: scene.at(stamp).barrier,
            scene_step_at=scene.step_at,
            plan_detour=planned_ways_out(inputs, task, request.config),
            record=ObjectFile[ControlStep](),
            commander=commander,
            distance_to=scene.at(task.stamp_ns).distances["exact"],
            balls_at=lambda stamp: scene.at(stamp).balls,
        )
    changes = list[SceneChange]()
    for first, last in blocks_of(scene, model, trace.stamp_ns):
        stamps, positions = trace.stamp_ns[first:last], np.asarray(trace.position[first:last])
        straight = np.zeros_like(positions)  # the driven arm moves straight from state to state
        record.measure_block(stamps, positions, straight)
        apart = divergence(model, task.frame, stamps, positions, motion)
        record.trace.append({**step_columns(trace.steps[first:last], model.num_joints), **apart})
        before_ns = int(trace.stamp_ns[max(first - 1, 0)])
        changes += _measure_change(scene, record, before_ns, int(stamps[0]), positions[:1])
    if (next_ns := scene.next_ns(last_ns := int(stamps[-1]))) is not None:
        changes += _measure_change(scene, record, last_ns, next_ns, positions[-1:])
    return replace(
        _finish(request, inputs, record, trace.static_violations, radius_of=0),
        closed_loop=trace,
        scene_changes=tuple(changes),
        twist_figures=twist_figures(model, control, task.frame, task.twists, record.trace),
        outside=commander if isinstance(commander, OutsideController) else None,
    )


def _record(request: ReplayRequest, inputs: ReplayInputs) -> ReplayRecord:
    return ReplayRecord(
        inputs.model,
        inputs.scene,
        config=request.config,
        max_map_age=request.max_map_age,
        is_continuous=request.re_anchor is None,
        declared=inputs.declared,
        first_state_ns=int(inputs.states.stamp_ns[0]),
        surfaces=inputs.surfaces,
        pair_margins=inputs.pair_margins,
    )


def _blocks(inputs: ReplayInputs, start: int) -> Iterator[tuple[Stamps, Float64, Float64]]:
    states = inputs.states
    for first, last in blocks_of(inputs.scene, inputs.model, states.stamp_ns[start:]):
        part = slice(start + first, start + last)
        yield states.stamp_ns[part], states.position[part], states.velocity[part]


def _finish_logged(request: ReplayRequest, inputs: ReplayInputs, record: ReplayRecord, first: int) -> Replay:
    states, model = inputs.states, inputs.model
    last = inputs.scene.at(int(states.stamp_ns[-1]))
    return _finish(
        request,
        inputs,
        record,
        static_violations(model, last.barrier, states.position[-1], scene_margin(model, request.config.control)),
        radius_of=-1,
    )


def _finish(
    request: ReplayRequest,
    inputs: ReplayInputs,
    record: ReplayRecord,
    statics: tuple[StaticViolation, ...],
    *,
    radius_of: int,
) -> Replay:
    stamps = record.trace.stamp_ns
    requested, logged = _requested_ns(request, inputs), inputs.states.stamp_ns
    before = logged[(logged >= requested) & (logged < stamps[0])]
    record.newer_depth.finish()
    record.hindsight.finish()
    return Replay(
        model=inputs.model,
        config=request.config,
        mode=request.mode,
        fields=record.fields,
        trace=record.trace,
        num_before_scene=len(before),
        lead_in_s=float(int(stamps[0]) - int(before[0])) * 1e-9 if len(before) else 0.0,
        median_radius=inputs.scene.at(int(stamps[radius_of])).median_radius,
        static_violations=statics,
        start_time_s=float(int(stamps[0]) - int(inputs.states.stamp_ns[0])) * 1e-9,
        unwatched=tuple(record.hindsight.later),
        overtaken=tuple(record.newer_depth.later),
        statics=record.fixed_parts.clearances,
        closest=record.closest,
        events=record.events(),
    )


def _requested_ns(request: ReplayRequest, inputs: ReplayInputs) -> int:
    scene, stamps = inputs.scene, inputs.states.stamp_ns
    if scene.first_ns is not None and scene.first_ns > stamps[-1]:
        apart = times_apart(stamps, (scene.first_ns, max((scene.first_ns, *scene.stamps_ns))))
        raise NotEvaluableError(
            f"{inputs.source.name}: all {len(stamps)} joint states are earlier than the first known scene"
            + ("" if apart is None else f": {apart.sentence}"),
            remedy="reconstruct with more snapshots, or replay against --field" if apart is None else apart.remedy,
        )
    if request.start_time is None:
        return int(stamps[0])
    if request.start_time == "first-map":
        return max(int(stamps[0]), int(stamps[0]) if scene.first_ns is None else scene.first_ns)
    start = int(stamps[0]) + round(float(request.start_time) * 1e9)
    refuse_if(
        start > stamps[-1],
        f"{inputs.source.name}: --start-time: expected at most {(stamps[-1] - stamps[0]) * 1e-9:.2f} s, the end "
        f"of joint states, got {(start - stamps[0]) * 1e-9:.2f} s",
        remedy="give an earlier one",
    )
    return start


def _first_judged(request: ReplayRequest, inputs: ReplayInputs) -> int:
    scene, stamps = inputs.scene, inputs.states.stamp_ns
    earliest = _requested_ns(request, inputs)
    return int(np.searchsorted(stamps, earliest if scene.first_ns is None else max(earliest, scene.first_ns)))


def _task(
    request: ReplayRequest, inputs: ReplayInputs, motion: LoggedMotion, twists: TwistTrack | None, tolerance: float
) -> ReplayTask:
    stamps, positions = motion.stamp_ns, motion.position
    start = _first_judged(request, inputs)
    frame = request.frame or inputs.model.frame_names[-1]
    *via, goal = goal_waypoints(request, inputs.model, frame, positions[-1] if twists is None else positions[start])
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


def planned_ways_out(inputs: ReplayInputs, task: ReplayTask, config: Config) -> PlanDetour | None:
    """Planner of detours from local minima; None if detours are off."""
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

"""The closed loop and the paper's baselines on one recorded task: a planner, and a monitored standstill (Fig. 8).

The closed loop is `splatctrl replay`'s. Every method has its start, start time and goal, and is measured in the scene
known at each time.
"""

import argparse
import fnmatch
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.methods import Method, SideBySide
from experiments.standstill import (
    STOP_ACCELERATION,
    BoxZone,
    DistanceToPeople,
    Separation,
    StopZone,
    Zone,
    monitored_standstill,
    remembered,
    separation_of,
)
from experiments.tracking import follow_joints, follow_with_controller
from experiments.yardstick import Motion, Yardstick
from splatctrl_cli import (
    Box,
    NotEvaluableError,
    ReplayRequest,
    ReplayResult,
    UsageError,
    load_config,
    replay,
)
from splatctrl_cli.blocks import (
    Certified,
    ControlStep,
    DistanceFunction,
    Float64,
    KnownFields,
    MotionOutcome,
    PlannedPath,
    ReplayTask,
    Stamps,
    Stopwatch,
    certified_distance,
    checked_pose,
    distance_to,
    goal_waypoints,
    is_shaped,
    output_path,
    planned_path,
    write_json,
    write_run,
)

STANDSTILL, BIRRT, BIRRT_IK, QP_IK = "standstill", "birrt", "birrt-ik", "qp-ik"
BASELINES = (STANDSTILL, BIRRT, BIRRT_IK, QP_IK)
OF_REPLAY = (  # options that are a replay's
    *("log", "scene", "field", "urdf", "spheres", "base", "start_time", "frame", "goal", "goal_joints", "truth"),
    *("controller", "controller_command", "latency", "threads"),
)
CLOSED_LOOP, LOG = "closed_loop", "log"  # what stands in every comparison
PEOPLE = ("human*", "person*")  # names of a truth's primitives
HOW = (
    f"joined by commas: {STANDSTILL}, the logged path held while a person is in the zone; {BIRRT}, a path planned in"
    f" the scene known at the start, followed by the joints; {BIRRT_IK}, by the controller; {QP_IK}, our controller"
    f" beside one of --controller (default: {BIRRT},{BIRRT_IK})"
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``baselines``."""
    add = parser.add_argument
    add("log", type=Path, help="a log or capture with joint states")
    scene = parser.add_mutually_exclusive_group(required=True)
    scene.add_argument("--scene", type=Path, help="a reconstruction: its splats, as known at each time")
    scene.add_argument("--field", type=Path, help="a baked field")
    add("-o", "--out", type=Path, default=Path("baselines"), help="folder to write (default: baselines)")
    add("--force", action="store_true", help="replace the output if it exists")
    add("--methods", type=_methods, default=(BIRRT, BIRRT_IK), help=HOW)
    add("--urdf", type=Path, help="the robot's URDF (default: the log's own robot_description)")
    add("--spheres", type=Path, help="its spheres (default: the URDF's own)")
    add("--packages", type=Path, action="append", default=[], help="folder of its meshes (repeatable)")
    add("--base", type=_pose, help="pose of the URDF's root in world, x,y,z,qx,qy,qz,qw (default: identity)")
    add("--start-time", type=_start, help="start at this time of the log [s], or first-map")
    add("--frame", help="the link to drive (default: the last of the URDF)")
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument("--goal", type=_pose, help="goal pose in world (default: the logged pose at the end)")
    goal.add_argument("--goal-joints", type=_numbers, help="goal configuration [rad]")
    add("--truth", type=Path, help="truth.json of a simulated log")
    own = parser.add_mutually_exclusive_group()
    own.add_argument("--controller", help="drive the closed loop by this Python class, MODULE:CLASS")
    own.add_argument("--controller-command", help="or by this program")
    add("--latency", type=float, default=0.0, help="a map is known this long after its frames' stamp [s]")
    add("--zone", default="0.5,0.6", help="STOP,RESUME: distances [m] at which the standstill stops and goes on")
    add("--zone-box", help="a box [m] instead: stop while a person is in it, resume when nobody is near it")
    add("--human", action="append", default=[], help="a primitive of --truth that counts as a person (repeatable)")
    add("--config", type=Path, help="a TOML file of settings")
    add("--set", action="append", default=[], help="SECTION.KEY=VALUE (repeatable)")
    add("--threads", type=int, default=0, help="0 for one per core")


def run(args: argparse.Namespace) -> int:
    """Drive the closed loop, then every baseline, and write the results."""
    zone = _zone(args) if STANDSTILL in args.methods else None
    request, stopwatch = _request(args), Stopwatch()
    with output_path(args.out, force=args.force, is_folder=True) as folder:
        with stopwatch.stage("closed loop"):
            result = replay(replace(request, out=folder / CLOSED_LOOP))
        with stopwatch.stage("baselines"):
            found = side_by_side(result, request, args.methods, zone, args.human, folder)
        write_json(folder / "methods.json", found.document())
        found.draw(folder / "methods.png", request.config.control.margin)
        write_run(
            folder,
            command="baselines",
            config=request.config.as_dict(),
            inputs=result.inputs.digests,
            metrics=found.metrics(),
            stopwatch=stopwatch,
            verdict=result.verdict.as_dict(),
        )
    print(result.verdict.sentence, "", *found.lines(), f"wrote {args.out}", sep="\n")
    return result.exit_code()


def side_by_side(
    closed: ReplayResult,
    request: ReplayRequest,
    names: Sequence[str],
    zone: StopZone | None,
    human: Sequence[str],
    folder: Path,
) -> SideBySide:
    """Run every method and measure it, with the closed loop and the log, in the scene known at each time.

    `zone` stops a standstill. If our controller replaces the user's, it writes its own replay to `folder`. Paths are
    planned in the scene known at the start, and begin at once, as if planning took no time.
    """
    control, task = request.config.control, _task(request, closed)
    people = {} if zone is None else separations(closed, zone, human)
    motions = {CLOSED_LOOP: _driven(closed), LOG: _logged(closed, task)}
    if STANDSTILL in people:
        held = people[STANDSTILL]
        motions[STANDSTILL] = Motion(stamp_ns=held.stamp_ns, position=held.position, is_intervened=held.is_stopped)
    if QP_IK in names:
        ours = replace(request, controller=None, controller_command=None, out=folder / _key(QP_IK))
        motions[_key(QP_IK)] = _driven(replay(ours))
    planned = [name for name in names if name in (BIRRT, BIRRT_IK)]
    plan = _plan(closed, task) if planned else None
    if plan is not None and plan.path is not None:
        motions |= {_key(name): _followed(name, plan, closed, task) for name in planned}
    yardstick = _yardstick(closed, task)
    order = dict.fromkeys((CLOSED_LOOP, LOG, *map(_key, names)))
    methods = {
        name: Method(
            figures=yardstick.figures(motions[name]) if name in motions else None,
            plan=plan if name in map(_key, planned) else None,
        )
        for name in order
    }
    return SideBySide(methods=methods, period=control.period, beside_people=people)


def _key(name: str) -> str:
    return name.replace("-", "_")


def _task(request: ReplayRequest, closed: ReplayResult) -> ReplayTask:
    """Return the closed loop's task. Without a goal posture, the search begins at the last logged posture."""
    model, logged_end = closed.inputs.model, closed.inputs.motion().position[-1]
    stamps, positions, _ = _trace(closed)
    frame = request.frame or model.frame_names[-1]
    (goal,) = goal_waypoints(request, model, frame, logged_end)
    return ReplayTask(
        start=positions[0],
        T_world_goal=goal.T_world_goal,
        frame=frame,
        stamp_ns=int(stamps[0]),
        home=logged_end if goal.posture is None else goal.posture,
    )


def _trace(closed: ReplayResult) -> tuple[Stamps, Float64, Sequence[ControlStep]]:
    trace = closed.replay.closed_loop
    assert trace is not None
    return trace.stamp_ns, np.asarray(trace.position), trace.steps


def _stamps(start_ns: int, num: int, period: float) -> Stamps:
    return start_ns + np.round(np.arange(num) * period * 1e9).astype(np.int64)


def _driven(closed: ReplayResult) -> Motion:
    """The motion of a closed loop; interventions of a user's controller are unknown."""
    stamps, positions, steps = _trace(closed)
    shaped = np.array([is_shaped(step) for step in steps], dtype=np.bool_)
    is_ours = closed.replay.outside is None
    return Motion(stamp_ns=stamps, position=positions, is_intervened=shaped if is_ours else None)


def _logged(closed: ReplayResult, task: ReplayTask) -> Motion:
    log, period = closed.inputs.motion(), closed.replay.config.control.period
    num = max(math.ceil((log.last_ns - task.stamp_ns) * 1e-9 / period - 1e-6), 0) + 1
    stamps = _stamps(task.stamp_ns, num, period)
    return Motion(stamp_ns=stamps, position=np.array([log.at(int(stamp))[0] for stamp in stamps]))


def _plan(closed: ReplayResult, task: ReplayTask) -> PlannedPath:
    """One plan for both ways to follow it."""
    config, scene = closed.replay.config, closed.inputs.scene
    known = Certified(distance=certified_distance(scene.at(task.stamp_ns)))
    return planned_path(closed.inputs.model, known, task, config.planner, config.control)


def _followed(name: str, plan: PlannedPath, closed: ReplayResult, task: ReplayTask) -> Motion:
    config, scene, model = closed.replay.config, closed.inputs.scene, plan.clearance.model
    assert plan.path is not None
    shaped = None
    if name == BIRRT:
        position = follow_joints(plan.path, model, config.control)
    else:
        position, steps = follow_with_controller(
            plan.path, model, lambda stamp: scene.at(stamp).barrier, task.frame, config.planner, config.control,
            stamp_ns=task.stamp_ns, scene_step_at=scene.step_at,
        )  # fmt: skip
        shaped = np.array([is_shaped(step) for step in steps], dtype=np.bool_)
    stamps = _stamps(task.stamp_ns, len(position), config.control.period)
    return Motion(stamp_ns=stamps, position=position, is_intervened=shaped)


def _yardstick(closed: ReplayResult, task: ReplayTask) -> Yardstick:
    scene, truth = closed.inputs.scene, closed.inputs.truth
    certified: Callable[[KnownFields], DistanceFunction] = lru_cache(maxsize=1)(certified_distance)
    return Yardstick(
        model=closed.inputs.model,
        frame=task.frame,
        T_world_goal=task.T_world_goal,
        config=closed.replay.config.control,
        distances_at=lambda stamp: scene.at(stamp).distances,
        certified_at=lambda stamp: certified(scene.at(stamp)),
        truth=None if truth is None else lambda points, stamp: truth.closest(points, stamp)[0],
    )


def separations(closed: ReplayResult, zone: StopZone, human: Sequence[str]) -> dict[str, Separation]:
    """Separations from people of the closed loop and the standstill, from the same time on."""
    inputs, config = closed.inputs, closed.replay.config
    people, control = people_of(closed, human), config.control
    stamps, positions, steps = _trace(closed)
    trace = closed.replay.closed_loop
    driven = separation_of(
        inputs.model,
        stamps,
        positions,
        np.array([step.velocity for step in steps]),
        people,
        still=control.stall_speed,
        is_complete=trace is not None and trace.outcome is MotionOutcome.GOAL_REACHED,
    )
    held = monitored_standstill(
        inputs.model,
        inputs.motion(),
        people,
        zone,
        start_ns=int(stamps[0]),
        period=control.period,
        max_wait=control.max_time,
        max_acceleration=STOP_ACCELERATION,
    )
    return {CLOSED_LOOP: driven, STANDSTILL: held}


def people_of(closed: ReplayResult, human: Sequence[str]) -> DistanceToPeople:
    """People of the truth, if given; else splats labelled human in the scene, for `human.memory` [s]."""
    scene, truth = closed.inputs.scene, closed.inputs.truth
    if truth is not None:
        wanted = human or PEOPLE
        chosen = [p for p in truth.primitives if any(fnmatch.fnmatch(p.name, name) for name in wanted)]
        if not chosen:
            names = ", ".join(primitive.name for primitive in truth.primitives)
            raise NotEvaluableError(
                f"{truth.path}: expected a primitive named {' or '.join(wanted)}, got {names}",
                remedy="name one with --human",
            )
        return lambda points, stamp_ns: distance_to(chosen, points, stamp_ns)
    stamps = scene.known_ns or (int(closed.inputs.states.stamp_ns[0]),)
    if all(scene.at(stamp).human is None for stamp in stamps):
        raise NotEvaluableError(
            "baselines: expected splats labelled human, got none at any time",
            remedy="reconstruct from a log with masks of people, or give --truth and --human",
        )

    def distance(points: Float64, stamp_ns: int) -> Float64:
        field = scene.at(stamp_ns).human
        return np.full(len(points), np.inf) if field is None else field.query(points)[0]

    return remembered(distance, scene.age_s, closed.replay.config.human.memory)


def _request(args: argparse.Namespace) -> ReplayRequest:
    """The closed loop's request. Raises UsageError for methods or people that need missing options."""
    if QP_IK in args.methods and args.controller is None and args.controller_command is None:
        raise UsageError(
            f"--methods {QP_IK}: the closed loop is that already",
            remedy="leave it out, or give --controller or --controller-command",
        )
    if args.human and args.truth is None:
        raise UsageError(
            "--human: expected --truth to take it from", remedy="without it people are splats labelled so"
        )
    given: dict[str, Any] = {name: getattr(args, name) for name in OF_REPLAY}
    return ReplayRequest(
        out=args.out,
        mode="closed-loop",
        config=load_config(args.config, args.set),
        packages=tuple(args.packages),
        **given,
    )


def _zone(args: argparse.Namespace) -> StopZone:
    """The zone of --zone or --zone-box. Raises UsageError for invalid values."""
    try:
        stop, resume = (float(part) for part in args.zone.split(","))
    except ValueError:
        raise UsageError(f"--zone {args.zone}: expected STOP,RESUME [m]") from None
    zone = Zone(stop=stop, resume=resume)
    if args.zone_box is None:
        return zone
    return BoxZone(box=Box.from_text(args.zone_box), hysteresis=zone.resume - zone.stop)


def _methods(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(text.split(",")))
    for name in names:
        if name not in BASELINES:
            raise argparse.ArgumentTypeError(f"expected {', '.join(BASELINES)}, got {name!r}")
    return names


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def _pose(text: str) -> tuple[float, ...]:
    try:
        return checked_pose(_numbers(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _start(text: str) -> float | str:
    return text if text == "first-map" else float(text)

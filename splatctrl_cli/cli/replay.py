"""``splatctrl replay``: the clearance of logged motion, or a controller's motion from a logged start to a goal."""

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    check_gates,
    configured,
)
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.cli.known_scene import KnownScene
    from splatctrl_cli.cli.replay_report import Replay
    from splatctrl_cli.config import Config
    from splatctrl_cli.control.replay import ReplayTask, ReplayTrace
    from splatctrl_cli.records import Float64, JointState, RecordSource
    from splatctrl_cli.robot.model import RobotModel
    from splatctrl_cli.simulate.truth import Truth

POSE = "x,y,z,qx,qy,qz,qw"


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(
        subparsers, "replay", run, summary="audit logged joint states, or drive the arm to a goal in closed loop"
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="a log or capture with joint states")
    scene = parser.add_mutually_exclusive_group(required=True)
    scene.add_argument("--field", type=Path, metavar="FIELD", help="a baked field (folder or field.npz)")
    scene.add_argument(
        "--scene", type=Path, metavar="SCENE", help="a reconstruction: its splats, as known at each time"
    )
    parser.add_argument("--urdf", type=Path, required=True, metavar="FILE", help="the robot's URDF")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its spheres (default: the URDF's own)")
    parser.add_argument(
        "--base", type=_pose, metavar=POSE, help="pose of the URDF's root in world (default: identity)"
    )
    parser.add_argument(
        "--lock",
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="hold a joint that no log moves (repeatable)",
    )
    parser.add_argument(
        "--mode", choices=("audit", "closed-loop"), default="audit", help="what to replay (default: audit)"
    )
    parser.add_argument("--frame", metavar="LINK", help="the link to drive (default: the last of the URDF)")
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument(
        "--goal", type=_pose, metavar=POSE, help="goal pose in world (default: the logged pose at the end)"
    )
    goal.add_argument("--goal-joints", type=_numbers, metavar="Q1,Q2,...", help="goal posture [rad]")
    parser.add_argument("--start-time", type=float, metavar="S", help="start at this time of the log [s]")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="truth.json of a simulated log")
    parser.add_argument(
        "--max-unknown", type=float, default=0.05, metavar="SHARE", help="never-seen share allowed (default: 0.05)"
    )
    parser.add_argument("--steps", action="store_true", help="print a row per step as well")
    add_source(parser)
    add_output(parser, default="replay", what="folder to write")
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.cli.replay_report import lines_of, metrics_of, write_replay
    from splatctrl_cli.io.output import Stopwatch, output_path

    config, console, stopwatch = configured(args), Console(args), Stopwatch()
    out = args.out or Path("replay")
    with output_path(out, force=args.force, is_folder=True) as folder:
        with stopwatch.stage("read"):
            inputs = _read(args, config)
        for doubt in inputs.model.doubts:
            console.log(f"warning: {doubt}")
        with stopwatch.stage("replay"):
            replayed = _audited(inputs, config) if args.mode == "audit" else _driven(args, inputs, config, console)
        with stopwatch.stage("truth"):
            replayed = _with_truth(args, inputs, replayed)
        metrics = metrics_of(replayed)
        write_replay(folder, replayed, metrics, config=config, inputs=inputs.digests, stopwatch=stopwatch)
    console.result(
        {"out": str(out), **metrics}, lines_of(replayed, metrics, with_steps=args.steps or args.verbose > 0)
    )
    return _verdict(args, metrics, inputs.source)


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """Everything a replay reads; states in the model's joint order."""

    source: "RecordSource"
    states: "tuple[JointState, ...]"
    model: "RobotModel"
    scene: "KnownScene"
    truth: "Truth | None"
    digests: dict[str, str]


def _read(args: argparse.Namespace, config: "Config") -> _Inputs:
    from splatctrl_cli.cli.known_scene import from_grid, from_splats
    from splatctrl_cli.geometry import transform_from
    from splatctrl_cli.io.output import sha256
    from splatctrl_cli.io.source import open_source
    from splatctrl_cli.records import JointState
    from splatctrl_cli.robot.model import RobotModel
    from splatctrl_cli.simulate.truth import load_truth

    T_world_base = None if args.base is None else transform_from(args.base[:3], args.base[3:])
    model = RobotModel.from_urdf(args.urdf, args.spheres, T_world_base=T_world_base, locked=_locked(args.lock))
    truth = None if args.truth is None else load_truth(args.truth)
    scene = from_grid(args.field) if args.field is not None else from_splats(args.scene, config, args.threads)
    source = open_source(args.log, source_options(args))
    if not source.joint_names:
        raise InputError(
            f"{args.log}: expected joint states, got none", remedy="replay needs a log with /joint_states"
        )
    order = model.joint_order(source.joint_names)
    states = tuple(
        replace(record, position=record.position[order], velocity=record.velocity[order])
        for record in source.records()
        if isinstance(record, JointState)
    )
    files = [path for path in (args.urdf, args.spheres, args.truth) if path is not None]
    digests = {**source.digests(), **scene.digests, **{path.name: sha256(path) for path in files}}
    return _Inputs(source=source, states=states, model=model, scene=scene, truth=truth, digests=digests)


def _audited(inputs: _Inputs, config: "Config") -> "Replay":
    """The audit of every logged state for which a scene was known."""
    from splatctrl_cli.cli.replay_report import Replay
    from splatctrl_cli.control.audit import audit
    from splatctrl_cli.control.checks import static_violations

    scene, model = inputs.scene, inputs.model
    states = [s for s in inputs.states if scene.first_ns is None or s.stamp_ns >= scene.first_ns]
    if inputs.states and not states:
        raise NotEvaluableError(
            f"{inputs.source.name}: all {len(inputs.states)} joint states are earlier than the first known scene",
            remedy="reconstruct with more snapshots, or replay against --field",
        )
    trace = audit(model, states, lambda stamp: scene.at(stamp).distances, observed=scene.observed)
    last = scene.at(int(trace.stamp_ns[-1]))
    return Replay(
        model=model,
        margin=config.control.margin,
        audit=trace,
        num_before_scene=len(inputs.states) - len(states),
        median_radius=last.median_radius,
        static_violations=static_violations(model, last.barrier, trace.position[-1], config.control.margin),
    )


def _driven(args: argparse.Namespace, inputs: _Inputs, config: "Config", console: Console) -> "Replay":
    """The closed loop, and the audit of the states it went through."""
    from splatctrl_cli.cli.replay_report import Replay
    from splatctrl_cli.control.audit import audit
    from splatctrl_cli.control.replay import closed_loop
    from splatctrl_cli.records import JointState

    scene, model = inputs.scene, inputs.model
    task = _task(args, inputs)
    start_s = (task.stamp_ns - inputs.states[0].stamp_ns) * 1e-9
    console.log(f"replay: from {start_s:.2f} s of the log, at most {config.control.max_time:g} s")
    trace: ReplayTrace = closed_loop(model, config.control, task, lambda stamp: scene.at(stamp).barrier)
    states = [
        JointState(stamp_ns=int(stamp), position=q, velocity=step.velocity)
        for stamp, q, step in zip(trace.stamp_ns, trace.position, trace.steps, strict=True)
    ]
    return Replay(
        model=model,
        margin=config.control.margin,
        audit=audit(model, states, lambda stamp: scene.at(stamp).distances, observed=scene.observed),
        num_before_scene=0,
        median_radius=scene.at(task.stamp_ns).median_radius,
        static_violations=trace.static_violations,
        closed_loop=trace,
        start_time_s=start_s,
    )


def _task(args: argparse.Namespace, inputs: _Inputs) -> "ReplayTask":
    """The start (logged, and not before the scene is known) and the goal (given, or the logged end)."""
    import numpy as np

    from splatctrl_cli.control.audit import checked_states
    from splatctrl_cli.control.checks import checked_posture
    from splatctrl_cli.control.replay import ReplayTask
    from splatctrl_cli.geometry import transform_from

    model = inputs.model
    stamps, positions = checked_states(model, inputs.states)
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
    frame = args.frame or model.frame_names[-1]
    home: Float64 | None = None
    if args.goal is not None:
        T_world_goal = transform_from(args.goal[:3], args.goal[3:])
    elif args.goal_joints is not None:
        home = checked_posture(model, np.array(args.goal_joints), what="--goal-joints")
        T_world_goal = model.frame_pose(home, frame)
    else:
        T_world_goal = model.frame_pose(positions[-1], frame)
    return ReplayTask(
        start=positions[start], T_world_goal=T_world_goal, frame=frame, stamp_ns=int(stamps[start]), home=home
    )


def _with_truth(args: argparse.Namespace, inputs: _Inputs, replayed: "Replay") -> "Replay":
    """The true clearance of every state, and how an audit agrees with it near surfaces that a camera saw."""
    import numpy as np

    from splatctrl_cli.evaluate.clearance import clearance_agreement, mark_seen
    from splatctrl_cli.records import RgbdFrame

    if inputs.truth is None:
        return replayed
    model, audit = inputs.model, replayed.audit
    moving = np.flatnonzero(model.moving_spheres)
    radii = model.sphere_set.radii[moving]
    clearance, surface = np.zeros(len(audit.stamp_ns)), np.zeros((len(audit.stamp_ns), 3))
    for index, (stamp, q) in enumerate(zip(audit.stamp_ns, audit.position, strict=True)):
        distance, points = inputs.truth.closest(model.sphere_centers(q)[moving], int(stamp))
        nearest = int(np.argmin(distance - radii))
        clearance[index], surface[index] = distance[nearest] - radii[nearest], points[nearest]
    seen = np.zeros(len(clearance), dtype=np.bool_)
    for record in inputs.source.records():
        if isinstance(record, RgbdFrame) and (inputs.scene.cameras is None or record.camera in inputs.scene.cameras):
            mark_seen(seen, surface, audit.stamp_ns, record, has_clock=inputs.source.has_clock)
    agreement = {
        name: clearance_agreement(of.distance, clearance, seen, replayed.median_radius)
        for name, of in audit.clearance.items()
    }
    return replace(replayed, true_clearance=clearance, agreement=agreement)


def _verdict(args: argparse.Namespace, metrics: "dict[str, float | None]", source: "RecordSource") -> int:
    """The exit code, after the outputs were written."""
    if metrics["num_without_distance"]:
        raise NotEvaluableError(
            f"replay: the path leaves known space: at {metrics['num_without_distance']:g} of "
            f"{metrics['num_states']:g} states a sphere is where the field has no distance",
            remedy="the figures above leave those states out; bake with field.unknown = free or obstacle",
        )
    unknown = metrics["unknown_share"]
    if unknown is not None and unknown > args.max_unknown:
        raise NotEvaluableError(
            f"replay: {100 * unknown:.1f} % of the sphere centres lie in space no camera ever saw, "
            f"allowed {100 * args.max_unknown:g} %",
            remedy="the figures above say nothing about that part; add a camera, or give a larger --max-unknown",
        )
    check_gates(args.require, metrics)
    return 3 if source.loss.damaged else 0


def _numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers joined by commas, got {text!r}") from None
    if not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"expected finite numbers, got {text!r}")
    return values


def _pose(text: str) -> tuple[float, ...]:
    values = _numbers(text)
    if len(values) != 7:
        raise argparse.ArgumentTypeError(f"expected 7 numbers {POSE}, got {len(values)}")
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > 0.01:
        raise argparse.ArgumentTypeError(f"expected a unit quaternion qx,qy,qz,qw, got one of length {length:.3f}")
    return values


def _locked(assignments: list[str]) -> dict[str, float]:
    locked = {}
    for assignment in assignments:
        name, _, text = assignment.partition("=")
        try:
            locked[name] = float(text)
        except ValueError:
            raise UsageError(f"--lock {assignment}: expected JOINT=VALUE, got {text!r} for the value") from None
    return locked

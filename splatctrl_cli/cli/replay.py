"""``splatctrl replay``: the clearance of logged motion, what a controller says of it, or what it does instead."""

import argparse
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    check_gate_names,
    check_gates,
    configured,
)
from splatctrl_cli.cli.lockstep import add_lockstep, check_lockstep
from splatctrl_cli.cli.numbers import MAX_SECONDS, real
from splatctrl_cli.cli.replay_baseline import add_baseline, read_baselines, read_zone
from splatctrl_cli.cli.replay_goal import POSE, add_goal, check_goal, pose
from splatctrl_cli.cli.replay_golden import Golden, add_golden, check_golden, read_golden
from splatctrl_cli.cli.replay_robot import add_robot_geometry, coverage_words, doubts_of, read_robot
from splatctrl_cli.cli.replay_twists import check_twists
from splatctrl_cli.cli.replay_worst import add_worst_frames, draw_worst_frames
from splatctrl_cli.cli.source_options import add_source
from splatctrl_cli.errors import NotEvaluableError

if TYPE_CHECKING:
    from splatctrl_cli.cli.replay_metrics import Metrics
    from splatctrl_cli.cli.replay_modes import Replay, ReplayInputs
    from splatctrl_cli.cli.replay_states import LoggedStates
    from splatctrl_cli.config import Config
    from splatctrl_cli.records import RecordSource

MODES = ("audit", "open-loop", "closed-loop")


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(
        subparsers,
        "replay",
        run,
        summary="audit logged joint states, ask the controller at each, or drive the arm in closed loop",
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="a log or capture with joint states")
    scene = parser.add_mutually_exclusive_group(required=True)
    scene.add_argument("--field", type=Path, metavar="FIELD", help="a baked field (folder or field.npz)")
    scene.add_argument(
        "--scene", type=Path, metavar="SCENE", help="a reconstruction: its splats, as known at each time"
    )
    add_lockstep(parser, scene)
    parser.add_argument("--urdf", type=Path, required=True, metavar="FILE", help="the robot's URDF")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its spheres (default: the URDF's own)")
    parser.add_argument(
        "--base", type=pose, metavar=POSE, help="pose of the URDF's root in world (default: identity)"
    )
    parser.add_argument(
        "--lock",
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="hold a joint that no log moves (repeatable)",
    )
    add_robot_geometry(parser)
    parser.add_argument("--mode", choices=MODES, default="audit", help="what to replay (default: audit)")
    add_goal(parser)
    parser.add_argument("--truth", type=Path, metavar="FILE", help="truth.json of a simulated log")
    parser.add_argument(
        "--max-unknown",
        type=real(0, 1),
        default=0.05,
        metavar="SHARE",
        help="never-seen share allowed (default: 0.05)",
    )
    parser.add_argument(
        "--max-map-age",
        type=real(1e-3, MAX_SECONDS, "s"),
        default=1.0,
        metavar="S",
        help="a scene older than this is an event (default: 1)",
    )
    add_golden(parser)
    add_baseline(parser)
    add_worst_frames(parser)
    parser.add_argument("--steps", action="store_true", help="print a row per step as well")
    add_source(parser)
    add_output(parser, default="replay", what="folder to write")
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.cli.replay_metrics import metric_names, metrics_of
    from splatctrl_cli.cli.replay_modes import replayed, with_truth
    from splatctrl_cli.cli.replay_report import lines_of, write_replay
    from splatctrl_cli.control.presets import with_preset
    from splatctrl_cli.io.output import Stopwatch, output_path, write_json

    config, console, stopwatch = with_preset(configured(args)), Console(args), Stopwatch()
    fields = ("exact", "barrier", *(("certified",) if args.field is not None else ()))
    baselines, has_truth, has_twists = read_baselines(args), args.truth is not None, args.twist_topic is not None
    names = {
        mode: metric_names(mode, fields, has_truth=has_truth, baselines=baselines, has_twists=has_twists)
        for mode in MODES
    }
    check_gate_names(args.require, names[args.mode], {f"--mode {mode}": names[mode] for mode in names})
    golden = read_golden(args)
    read_zone(args)
    check_lockstep(args)
    check_twists(args)
    check_goal(args)
    out = args.out or Path("replay")
    with output_path(out, force=args.force, is_folder=True) as folder:
        with stopwatch.stage("read"):
            inputs, logged = _read(args, config, folder, console)
        for doubt in doubts_of(args, inputs.model, config.control):
            console.log(f"warning: {doubt}")
        with stopwatch.stage("replay"):
            replay = replayed(args, inputs, config, console)
        with stopwatch.stage("truth"):
            replay = with_truth(inputs, replay)
        inputs.scene.finish()
        metrics = metrics_of(replay) | logged.metrics()
        with stopwatch.stage("worst_frames"):
            unseen = draw_worst_frames(folder, inputs, replay, args.worst_frames)
        write_json(folder / "states.json", logged.as_dict())
        write_replay(folder, replay, metrics, config=config, inputs=inputs.digests, stopwatch=stopwatch)
    lines = lines_of(replay, metrics, with_steps=args.steps or args.verbose > 0)
    more = [coverage_words(inputs.model, config.control), *unseen, *logged.lines()]
    console.result({"out": str(out), **metrics}, chain(lines, more))
    return _verdict(args, replay, metrics, golden, inputs.source)


def _read(
    args: argparse.Namespace, config: "Config", folder: Path, console: Console
) -> "tuple[ReplayInputs, LoggedStates]":
    from splatctrl_cli.cli.lockstep import opened_scene
    from splatctrl_cli.cli.replay_modes import ReplayInputs
    from splatctrl_cli.cli.replay_states import read_states
    from splatctrl_cli.io.output import sha256
    from splatctrl_cli.simulate.truth import load_truth

    model = read_robot(args, config.control)
    truth = None if args.truth is None else load_truth(args.truth)
    logged = read_states(args, model)
    scene = opened_scene(args, config, model, folder, console)
    source = logged.source
    files = [path for path in (args.urdf, args.spheres, args.srdf, args.truth) if path is not None]
    digests = {**source.digests(), **scene.digests, **{path.name: sha256(path) for path in files}}
    inputs = ReplayInputs(source=source, states=logged.states, model=model, scene=scene, truth=truth, digests=digests)
    return inputs, logged


def _verdict(
    args: argparse.Namespace,
    replay: "Replay",
    metrics: "Metrics",
    golden: "Golden | None",
    source: "RecordSource",
) -> int:
    """The exit code, after the outputs were written."""
    from splatctrl_cli.cli.replay_metrics import first_time

    if metrics["num_without_distance"]:
        raise NotEvaluableError(
            f"replay: the path leaves known space: at {metrics['num_without_distance']:g} of "
            f"{metrics['num_states']:g} states, first at "
            f"{first_time(replay, 'num_without_distance', lambda count: count == 0):.3f} s, "
            "a sphere is where the field has no distance",
            remedy="the figures above leave those states out; bake with field.unknown = free or obstacle",
        )
    unknown = metrics["unknown_share"]
    if unknown is not None and unknown > args.max_unknown:
        raise NotEvaluableError(
            f"replay: {100 * unknown:.1f} % of the sphere centres lie in space no camera ever saw, "
            f"allowed {100 * args.max_unknown:g} %, first more than that at {_first_unknown(args, replay):.3f} s",
            remedy="the figures above say nothing about that part; add a camera, or give a larger --max-unknown",
        )
    if golden is not None:
        check_golden(golden, replay, args.golden_tolerance)
    check_gates(args.require, metrics, first_time=lambda name, holds: first_time(replay, name, holds))
    return 3 if source.loss.damaged else 0


def _first_unknown(args: argparse.Namespace, replay: "Replay") -> float:
    """The first time [s] at which more of the sphere centres than is allowed lie in space never seen."""
    import numpy as np

    stamps = replay.audit.stamp_ns
    first = int(np.argmax(replay.audit.unknown_share > args.max_unknown))
    return float(stamps[first] - stamps[0]) * 1e-9

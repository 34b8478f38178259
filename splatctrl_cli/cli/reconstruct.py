"""``splatctrl reconstruct``: a log into splats, occupancy, audit and snapshots."""

import argparse
from collections.abc import Mapping
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
    table,
)
from splatctrl_cli.cli.score_reference import add_scan, open_dtu, open_held_out, refuse_scan_options
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.config import Config
    from splatctrl_cli.io.shot import ShotSource
    from splatctrl_cli.records import Box, LossReport, PointCloud, RecordSource
    from splatctrl_cli.robot.model import RobotModel

DAMAGED = 3
DEFAULT_POSE_JUMP = 1.0  # [m]
GATED = (
    *("time_steps", "iterations", "splats", "robot_splats", "added", "relocated", "unmet", "evicted"),
    *("unrepresented_voxels", "unrepresented_volume", "max_unrepresented_voxels"),
    *("loss", "psnr"),
)  # what --require can name


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "reconstruct", run, summary="fit splats to a log, a capture or a DTU scan")
    parser.add_argument("source", type=Path, nargs="?", help="log, capture folder, or an image folder's .toml")
    parser.add_argument(
        "--dtu", type=Path, metavar="ROOT", help="a DTU data set in MVSNet's layout, or in IDR's and NeuS's, instead"
    )
    add_scan(parser)
    add_output(parser, default="scene", what="scene folder")
    add_source(parser)
    parser.add_argument(
        "--method",
        choices=("budget", "3dgs"),
        default="budget",
        help="a fixed budget of isotropic splats, or 3D Gaussian splatting: a baseline for views of a scene that "
        "stands still, which grows as it likes and has no distances (default: budget)",
    )
    parser.add_argument("--max-splats", type=int, metavar="N", help="budget of splats (default: 5000)")
    parser.add_argument("--urdf", type=Path, metavar="FILE", help="the robot: labels its splats, sets the workspace")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its collision spheres")
    parser.add_argument(
        "--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="workspace [m] (default: the robot's reach, else the valid depth)"
    )
    parser.add_argument(
        "--points",
        type=Path,
        metavar="FILE.ply",
        help="coloured points to start from; depth is then not looked at (colour cameras alone: no occupancy)",
    )
    add_disagreement(parser)
    parser.add_argument(
        "--resume", action="store_true", help="go on with a run that was interrupted, to the same bytes"
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    add_config(parser)
    add_gates(parser)


def add_disagreement(parser: argparse._ActionsContainer) -> None:
    """``--max-pose-jump`` and ``--allow-disagreement``: what a log is let off with."""
    parser.add_argument(
        "--max-pose-jump",
        type=float,
        default=DEFAULT_POSE_JUMP,
        metavar="M",
        help="how far a camera may move between frames less than a second apart, in metres (default: 1)",
    )
    parser.add_argument(
        "--allow-disagreement", action="store_true", help="go on where cameras disagree on where the surfaces are"
    )


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.cli.reconstruction import training_cameras

    if args.device == "cuda":
        raise UsageError("--device cuda: this build has no CUDA kernels", remedy="give --device cpu")
    if args.method == "3dgs":
        from splatctrl_cli.cli.reconstruct_gaussians import run as run_gaussians

        return run_gaussians(args, _config(args), _open(args), _box(args))
    check_gate_names(args.require, GATED)
    console, config = Console(args), _config(args)
    source = _open(args)
    training_cameras(source)
    robot = _robot(args, source)
    for doubt in () if robot is None else robot.doubts:
        console.log(f"warning: {doubt}")
    metrics = _fit(args, config, source, robot, console)
    check_gates(args.require, {name: _number(metrics[name]) for name in GATED})
    return DAMAGED if source.loss.damaged else 0


def _fit(
    args: argparse.Namespace, config: "Config", source: "RecordSource", robot: "RobotModel | None", console: Console
) -> dict[str, object]:
    """Reconstruct into the output folder, or go on with what an interrupted run left of it; returns the metrics."""
    from splatctrl_cli.cli.reconstruction import Reconstruction
    from splatctrl_cli.cli.resume import checkpoint_to_go_on_from, identity, told_how_to_go_on
    from splatctrl_cli.io.output import Stopwatch, output_path, partial_path, write_run
    from splatctrl_cli.io.scene_writer import CHECKPOINT

    stopwatch, box, out = Stopwatch(), _box(args), args.out or Path("scene")
    checkpoint_file = partial_path(out) / CHECKPOINT
    goes_on = args.resume and checkpoint_file.is_file()
    if args.resume and not goes_on:
        console.log(f"{partial_path(out)}: has no checkpoint to go on from; starts at the beginning")
    elif checkpoint_file.is_file() and not args.resume:
        console.log(
            f"warning: {partial_path(out)}: an interrupted run is replaced; --resume would have gone on with it"
        )
    with (
        told_how_to_go_on(checkpoint_file),
        output_path(out, force=args.force, is_folder=True, checkpoint=CHECKPOINT, resume=args.resume) as partial,
    ):
        inputs = source.digests()
        run_identity = identity(args, config, inputs)
        fitted = Reconstruction(
            source,
            robot,
            config,
            partial,
            box=box,
            cloud=_cloud(args),
            seed=args.seed,
            threads=args.threads,
            identity=run_identity,
            allow_disagreement=args.allow_disagreement,
            checkpoint=checkpoint_to_go_on_from(partial, run_identity) if goes_on else None,
        )
        if goes_on:
            console.log(f"{partial}: goes on after {fitted.num_read} time steps")
        with stopwatch.stage("fit_since_resume" if goes_on else "fit"):
            fitted.run(console)
        with stopwatch.stage("write"):
            fitted.finish()
        metrics = fitted.metrics()
        write_run(
            partial,
            command="reconstruct",
            config=config.as_dict(),
            inputs=inputs,
            metrics=metrics,
            stopwatch=stopwatch,
            seed=args.seed,
        )
    removed = {name: sum(row.removed[name] for row in fitted.rows) for name in fitted.rows[-1].removed}
    lines = _lines(metrics, removed, source.loss, sum(stopwatch.seconds.values()))
    console.result({"scene": str(out), "metrics": metrics, "removed": removed}, [*lines, f"wrote {out}"])
    return metrics


def _lines(
    metrics: Mapping[str, object], removed: Mapping[str, int], loss: "LossReport", seconds: float
) -> list[str]:
    psnr = metrics["psnr"]
    columns = {
        **{name.replace("_", " "): metrics[name] for name in ("time_steps", "splats")},
        "robot": metrics["robot_splats"],
        **{name: metrics[name] for name in ("added", "relocated", "unmet")},
        "training dB": "-" if psnr is None else f"{psnr:.2f}",
        "seconds": f"{seconds:.1f}",
    }
    lines = table(list(columns), [list(columns.values())])
    reasons = (f"{count} {reason.replace('_', ' ')}" for reason, count in removed.items() if count)
    lines.append("removed: " + (", ".join(reasons) or "none"))
    if metrics["frames_without_depth"]:
        lines.append(
            f"note: {metrics['frames_without_depth']} frames without any valid depth: nothing seeded from them"
        )
    if loss.invalid_depth:
        lines.append(f"note: {loss.invalid_depth} pixels of depth NaN, infinite or negative: taken as none")
    return lines + [f"note: {note}" for note in loss.notes]


def _box(args: argparse.Namespace) -> "Box | None":
    from splatctrl_cli.records import Box

    return None if args.box is None else Box.from_text(args.box)


def _cloud(args: argparse.Namespace) -> "PointCloud | None":
    from splatctrl_cli.io.points import read_points

    return None if args.points is None else read_points(args.points)


def _number(value: object) -> float | None:
    return None if value is None else float(str(value))


def _config(args: argparse.Namespace) -> "Config":
    from dataclasses import replace

    config = configured(args)
    if args.max_splats is None:
        return config
    if args.max_splats < 1:
        raise UsageError(f"--max-splats: expected at least 1, got {args.max_splats}")
    return replace(config, scene=replace(config.scene, max_splats=args.max_splats))


def _open(args: argparse.Namespace) -> "RecordSource":
    from splatctrl_cli.io.source import open_source

    if (args.source is None) == (args.dtu is None):
        raise UsageError("reconstruct: expected a SOURCE or --dtu ROOT, and not both")
    if args.dtu is not None:
        scan = open_dtu(args)
        if not scan.has_depth and args.points is None:
            raise InputError(
                f"{args.dtu}: scan '{scan.name}' has no depth",
                remedy="give --depths DIR, or --points FILE.ply instead",
            )
        return scan
    refuse_scan_options(args)
    if args.protocol is not None:
        return open_held_out(args, args.source)[0]
    source = open_source(args.source, source_options(args))
    check_pose_jumps(source, args.max_pose_jump)
    return source


def check_pose_jumps(source: "ShotSource", limit: float) -> None:
    """Raise InputError for a camera that is suddenly elsewhere; where nobody knows when, views may lie anywhere."""
    from splatctrl_cli.scene.consistency import largest_jump

    if not limit > 0:
        raise UsageError(f"--max-pose-jump: expected metres, got {limit}")
    jump = largest_jump(source.poses()) if source.has_clock else None
    if jump is not None and jump.distance > limit:
        later = (jump.after_ns - jump.before_ns) * 1e-9
        raise InputError(
            f"{source.name}: camera {jump.camera} jumps by {jump.distance:.2f} m from stamp {jump.before_ns} to"
            f" {jump.after_ns} ns, {later:.3g} s later (expected at most {limit:g} m)",
            remedy=f"correct the poses, leave the camera out with --cameras, or give --max-pose-jump"
            f" {jump.distance + 0.01:.2f}",
        )


def _robot(args: argparse.Namespace, source: "RecordSource") -> "RobotModel | None":
    if args.urdf is None:
        if args.spheres is not None:
            raise UsageError(f"--spheres {args.spheres}: belongs to a robot", remedy="give its --urdf as well")
        return None
    from splatctrl_cli.robot.model import RobotModel

    model = RobotModel.from_urdf(args.urdf, args.spheres)
    if source.joint_names:
        model.joint_order(source.joint_names)
    return model

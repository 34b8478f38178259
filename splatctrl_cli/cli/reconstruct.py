"""``splatctrl reconstruct``: a log into splats, occupancy, audit and snapshots."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
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
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import UsageError

if TYPE_CHECKING:
    from splatctrl_cli.config import Config
    from splatctrl_cli.records import Box, RecordSource
    from splatctrl_cli.robot.model import RobotModel

DAMAGED = 3
GATED = (
    *("time_steps", "iterations", "splats", "robot_splats", "added", "relocated", "unmet"),
    *("loss", "psnr"),
)  # what --require can name


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "reconstruct", run, summary="fit splats to a log, a capture or a DTU scan")
    parser.add_argument("source", type=Path, nargs="?", help="log, capture folder, or an image folder's .toml")
    parser.add_argument("--dtu", type=Path, metavar="ROOT", help="a DTU data set in MVSNet's layout, instead")
    parser.add_argument("--scan", metavar="NAME", help="which scan of --dtu (default: the only one)")
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
        "--resume", action="store_true", help="go on with a run that was interrupted, to the same bytes"
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.cli.reconstruction import Reconstruction, training_cameras
    from splatctrl_cli.cli.resume import checkpoint_to_go_on_from, identity
    from splatctrl_cli.io.output import Stopwatch, output_path, partial_path, write_run
    from splatctrl_cli.io.scene_writer import CHECKPOINT

    if args.device == "cuda":
        raise UsageError("--device cuda: this build has no CUDA kernels", remedy="give --device cpu")
    if args.method == "3dgs":
        from splatctrl_cli.cli.reconstruct_gaussians import run as run_gaussians

        return run_gaussians(args, _config(args), _open(args), _box(args))
    check_gate_names(args.require, GATED)
    console, stopwatch, config = Console(args), Stopwatch(), _config(args)
    source, box = _open(args), _box(args)
    training_cameras(source)
    robot = _robot(args, source)
    for doubt in () if robot is None else robot.doubts:
        console.log(f"warning: {doubt}")
    out = args.out or Path("scene")
    checkpoint_file = partial_path(out) / CHECKPOINT
    can_go_on = checkpoint_file.is_file()
    if can_go_on and not args.resume:
        console.log(
            f"warning: {partial_path(out)}: an interrupted run is replaced; --resume would have gone on with it"
        )
    if args.resume and not can_go_on:
        console.log(f"{partial_path(out)}: has no checkpoint to go on from; starts at the beginning")
    with (
        _told_how_to_go_on(checkpoint_file),
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
            seed=args.seed,
            threads=args.threads,
            identity=run_identity,
            checkpoint=checkpoint_to_go_on_from(partial, run_identity) if args.resume and can_go_on else None,
        )
        is_resumed = fitted.num_read > 0
        if is_resumed:
            console.log(f"{partial}: goes on after {fitted.num_read} time steps")
        with stopwatch.stage("fit_since_resume" if is_resumed else "fit"):
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
    last = fitted.rows[-1]
    removed = {name: sum(row.removed[name] for row in fitted.rows) for name in last.removed}
    seconds = f"{sum(stopwatch.seconds.values()):.1f}"
    lines = table(
        ["time steps", "splats", "robot", "added", "relocated", "unmet", "training dB", "seconds"],
        [
            [
                metrics["time_steps"], last.alive, last.robot, metrics["added"], metrics["relocated"],
                metrics["unmet"], "-" if last.psnr is None else f"{last.psnr:.2f}", seconds,
            ]
        ],
    )  # fmt: skip
    lines.append("removed: " + (", ".join(f"{n} {reason}" for reason, n in removed.items() if n) or "none"))
    lines += [f"note: {note}" for note in source.loss.notes]
    console.result({"scene": str(out), "metrics": metrics, "removed": removed}, [*lines, f"wrote {out}"])
    check_gates(args.require, {name: _number(metrics[name]) for name in GATED})
    return DAMAGED if source.loss.damaged else 0


@contextmanager
def _told_how_to_go_on(checkpoint: Path) -> Iterator[None]:
    """Says after Ctrl-C what was kept."""
    try:
        yield
    except KeyboardInterrupt:
        if checkpoint.is_file():
            raise KeyboardInterrupt(
                f"interrupted: {checkpoint.parent.parent} is kept; go on with the same command and --resume"
            ) from None
        raise KeyboardInterrupt("interrupted before the first checkpoint: nothing to go on from") from None


def _box(args: argparse.Namespace) -> "Box | None":
    from splatctrl_cli.records import Box

    return None if args.box is None else Box.from_text(args.box)


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
    if args.dtu is None:
        return open_source(args.source, source_options(args))
    from splatctrl_cli.io.dtu_source import DtuSource, view_numbers

    return DtuSource(args.dtu, args.scan, view_numbers([word for word in (args.holdout or "").split(",") if word]))


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

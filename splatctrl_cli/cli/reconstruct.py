"""``splatctrl reconstruct``: a log into splats, occupancy, audit and snapshots."""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    configured,
    table,
)
from splatctrl_cli.cli.numbers import MAX_LENGTH, real, setting
from splatctrl_cli.cli.source_options import add_scan, add_source, recording_of
from splatctrl_cli.config import Config, SceneConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.reconstruct import ReconstructRequest, ReconstructResult, reconstruct
from splatctrl_cli.jobs.reconstruct_gaussians import reconstruct_gaussians
from splatctrl_cli.jobs.recording import open_to_train
from splatctrl_cli.jobs.replays.request import DEFAULT_POSE_JUMP
from splatctrl_cli.records import Box, RecordSource

DECIDING_OPTIONS = (
    *("cameras", "camera", "camera_pose", "world_frame", "depth_scale", "pairing_tolerance", "joint_topic"),
    *("holdout", "scan", "box"),
)  # what decides the bytes of a scene, beside the configuration
PASSED_ON = (
    *("urdf", "spheres", "points", "declare", "allow_disagreement", "force", "resume", "seed", "threads", "require"),
)


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "reconstruct", run)
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
    parser.add_argument(
        "--max-splats", type=setting(SceneConfig, "max_splats"), metavar="N", help="budget of splats (default: 5000)"
    )
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
    add_declare(parser)
    add_disagreement(parser)
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run, to the same bytes")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    add_config(parser)
    add_gates(parser)


def add_declare(parser: argparse.ArgumentParser) -> None:
    """``--declare``."""
    parser.add_argument(
        "--declare",
        type=Path,
        metavar="FILE.toml",
        help="what the robot carries, and contact that is meant (docs/declare.md)",
    )


def add_disagreement(parser: argparse._ActionsContainer) -> None:
    """``--max-pose-jump`` and ``--allow-disagreement``: by how much a log may contradict itself."""
    parser.add_argument(
        "--max-pose-jump",
        type=real(1e-3, MAX_LENGTH, "m"),
        default=DEFAULT_POSE_JUMP,
        metavar="M",
        help="how far a camera may move between frames less than a second apart, in metres (default: 1)",
    )
    parser.add_argument(
        "--allow-disagreement", action="store_true", help="continue although cameras disagree about surfaces"
    )


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    if args.device == "cuda":
        raise UsageError("--device cuda: this build has no CUDA kernels", remedy="give --device cpu")
    request = ReconstructRequest(
        config=_config(args),  # refused before the source is opened
        source=_open(args),
        out=args.out or Path("scene"),
        box=None if args.box is None else Box.from_text(args.box),
        options={name: getattr(args, name) for name in DECIDING_OPTIONS},
        **{name: getattr(args, name) for name in PASSED_ON},
    )
    console, is_baseline = Console(args), args.method == "3dgs"
    result = (reconstruct_gaussians if is_baseline else reconstruct)(request, console)
    found = {"scene": str(result.out), "metrics": result.metrics}
    found |= {} if is_baseline else {"removed": result.removed}
    lines = _baseline_lines(result) if is_baseline else _lines(result)
    console.concluded(result.verdict, found, [*lines, f"wrote {result.out}"], result.verdict.exit_code)
    return result.verdict.exit_code


def _lines(result: ReconstructResult) -> list[str]:
    metrics, removed = result.metrics, result.removed
    columns = {
        **{name.replace("_", " "): metrics[name] for name in ("time_steps", "splats")},
        "robot": metrics["robot_splats"],
        **{name: metrics[name] for name in ("added", "relocated", "unmet")},
        **_quality(metrics, sum(result.seconds.values())),
    }
    lines = table(list(columns), [list(columns.values())])
    reasons = (f"{count} {reason.replace('_', ' ')}" for reason, count in removed.items() if count)
    lines.append("removed: " + (", ".join(reasons) or "none"))
    return lines


def _baseline_lines(result: ReconstructResult) -> list[str]:
    names = ("iterations", "splats", "cloned", "split", "pruned", "unmet")
    columns = {name: result.metrics[name] for name in names} | _quality(result.metrics, result.seconds["fit"])
    return table(list(columns), [list(columns.values())])


def _quality(metrics: Mapping[str, Any], seconds: float) -> dict[str, str]:
    psnr = metrics["psnr"]
    return {"training dB": "-" if psnr is None else f"{psnr:.2f}", "seconds": f"{seconds:.1f}"}


def _config(args: argparse.Namespace) -> Config:
    config = configured(args)
    if args.max_splats is None:
        return config
    return replace(config, scene=replace(config.scene, max_splats=args.max_splats))


def _open(args: argparse.Namespace) -> RecordSource:
    if (args.source is None) == (args.dtu is None):
        raise UsageError("reconstruct: expected a SOURCE or --dtu ROOT, and not both")
    return open_to_train(
        recording_of(args, args.source), max_pose_jump=args.max_pose_jump, needs_depth=args.points is None
    )

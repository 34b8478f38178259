"""``splatctrl score``: renders views that did not train a scene and compares them with what was recorded."""

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_config, add_gates, add_output
from splatctrl_cli.cli.score_baseline import add_baseline, changes, read_baseline
from splatctrl_cli.cli.score_cloud import add_cloud, cloud_figures, cloud_settings
from splatctrl_cli.cli.score_fit import add_fit, run_fit
from splatctrl_cli.cli.score_reference import (
    add_scan,
    cameras_to_score,
    check_training,
    open_reference,
    recording_check,
)
from splatctrl_cli.cli.score_report import gated_names, lines_of, result_of, score_verdict, write_scores
from splatctrl_cli.cli.score_scans import lines_of_scans, scenes_of_scans, score_scans
from splatctrl_cli.cli.score_views import Scorer, view_drawer
from splatctrl_cli.cli.source_options import add_source
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.gates import check_gate_names
from splatctrl_cli.evaluate.perceptual import Lpips
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.field.selection import field_splats
from splatctrl_cli.files.output import Stopwatch, output_path
from splatctrl_cli.scene_files.scene_folder import open_scene


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "score", run)
    parser.add_argument(
        "scene",
        type=Path,
        nargs="?",
        metavar="SCENE",
        help="a folder that reconstruct wrote, or one of such folders, named like the scans of --dtu",
    )
    reference = parser.add_mutually_exclusive_group(required=True)
    reference.add_argument(
        "--reference", type=Path, metavar="PATH", help="a log, a capture, or an image folder's TOML"
    )
    reference.add_argument(
        "--dtu", type=Path, metavar="ROOT", help="a DTU data set in MVSNet's layout, or in IDR's and NeuS's"
    )
    add_scan(parser)
    parser.add_argument(
        "--masks", type=Path, metavar="DIR", help="object masks 000.png and so on, for MVSNet's layout"
    )
    parser.add_argument(
        "--snapshots",
        choices=("newest", "final"),
        default="newest",
        help="render each view from the newest snapshot not later than it, or all from the final splats",
    )
    parser.add_argument("--allow-training", action="store_true", help="also score cameras that trained the scene")
    parser.add_argument(
        "--allow-other-recording",
        action="store_true",
        help="go on where this is not the recording that made the scene",
    )
    parser.add_argument(
        "--images",
        choices=("all", "best-worst", "none"),
        default="best-worst",
        help="with -o: pictures of every view, of each camera's best and worst, or of none (default: best-worst)",
    )
    parser.add_argument(
        "--lpips", type=Path, metavar="FILE.npz", help="weights of LPIPS (docs/score.md); none come along"
    )
    add_cloud(parser)
    add_baseline(parser)
    add_fit(parser)
    add_source(parser)
    add_output(parser, default="none, the scores are only printed", what="folder for scores and pictures")
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    if args.images == "all" and args.out is None:
        raise UsageError("--images all: expected a folder for them", remedy="give -o")
    if args.fit:
        return run_fit(args, score_scene)
    if args.scene is None:
        raise UsageError("score: expected a SCENE, got none", remedy="give what reconstruct wrote, or --fit")
    for name, default in (("config", None), ("set", []), ("seed", 0), ("fit_iterations", None), ("fit_splats", None)):
        if getattr(args, name) != default:
            raise UsageError(f"--{name.replace('_', '-')}: only with --fit", remedy="leave it out")
    names, changed = gated_names(with_changes=False), gated_names(with_changes=True)
    if args.baseline is not None:
        read_baseline(args.baseline)  # better refused now than after the views
    check_gate_names(args.require, names if args.baseline is None else changed, {"--baseline": changed})
    console = Console(args)
    scenes = scenes_of_scans(args)
    output = output_path(args.out, force=args.force, is_folder=True) if args.out else nullcontext()
    with output as folder:
        if scenes:
            result, verdict = score_scans(args, console, scenes, score_scene, folder)
        else:
            result, verdict = score_scene(args, console, folder)
    lines = lines_of_scans(result) if scenes else lines_of(result)
    console.concluded(verdict, result, lines, verdict.exit_code)
    return verdict.exit_code


def score_scene(args: argparse.Namespace, console: Console, folder: Path | None) -> "tuple[dict[str, Any], Verdict]":
    """Score one scene, write what `-o` asks for into `folder`, and return everything that --json prints, and the
    verdict.
    """
    stopwatch = Stopwatch()
    cloud = cloud_settings(args)
    lpips = None if args.lpips is None else Lpips(args.lpips)
    scene = open_scene(args.scene)
    if scene.is_anisotropic:
        scene.gaussians()  # either raises where there is none to compare
    else:
        field_splats(scene.splats())
    reference = open_reference(args, console)
    cloud = None if cloud is None else cloud.of_scan(reference.scan)
    cameras = cameras_to_score(args, reference, scene.cameras)
    check_training(args, reference, scene)
    digests = reference.source.digests()
    recording = recording_check(args, reference, scene, digests)
    draw = view_drawer(folder / "views") if folder and args.images == "all" else None
    scorer = Scorer(args=args, scene=scene, reference=reference, cameras=cameras, perceptual=lpips, draw=draw)
    scores = scorer.run(console, stopwatch)
    surface = None
    if cloud is not None:
        with stopwatch.stage("cloud"):
            surface = (cloud, cloud_figures(cloud, scene, scores.training, args.threads))
    result = result_of(args, scene, reference, cameras, scores, recording=recording, cloud=surface, lpips=lpips)
    if args.baseline is not None:
        result["metrics"] |= changes(result, read_baseline(args.baseline), args.baseline)
    verdict = score_verdict(result, args.require, is_damaged=bool(reference.source.loss.damaged))
    if folder:
        write_scores(folder, args, digests, result, scores, stopwatch, verdict)
    return result, verdict

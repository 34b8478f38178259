"""``splatctrl score``: renders views that did not train a scene and compares them with what was recorded."""

import argparse
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_config, add_gates, add_output
from splatctrl_cli.cli.numbers import real, setting, whole
from splatctrl_cli.cli.score_report import lines_of
from splatctrl_cli.cli.source_options import add_scan, add_source, recording_of
from splatctrl_cli.config import SceneConfig
from splatctrl_cli.config.map import MOST_ITERATIONS
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.score import ScoreRequest, ScoreResult, score
from splatctrl_cli.jobs.score_cloud import CloudSettings
from splatctrl_cli.jobs.score_fit import NUM_SPLATS, PROTOCOL, FitRequest, score_fits

MILLIMETRE = 0.001  # [m], the unit of DTU's clouds
OF_FITS: tuple[tuple[str, object], ...] = (
    ("config", None),
    ("set", []),
    ("seed", 0),
    ("fit_iterations", None),
    ("fit_splats", None),
)
PASSED_ON = ("out", "force", "images", "lpips", "allow_training", "allow_other_recording", "threads")


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "score", run)
    add = parser.add_argument
    add(
        "scene",
        type=Path,
        nargs="?",
        metavar="SCENE",
        help="a folder that reconstruct wrote, or one of such folders, named like the scans of --dtu",
    )
    either = parser.add_mutually_exclusive_group(required=True).add_argument
    either("--reference", type=Path, metavar="PATH", help="a log, a capture, or an image folder's TOML")
    either("--dtu", type=Path, metavar="ROOT", help="a DTU data set in MVSNet's layout, or in IDR's and NeuS's")
    add_scan(parser)
    add("--masks", type=Path, metavar="DIR", help="object masks 000.png and so on, for MVSNet's layout")
    add(
        "--snapshots",
        choices=("newest", "final"),
        default="newest",
        help="render each view from the newest snapshot not later than it, or all from the final splats",
    )
    add("--allow-training", action="store_true", help="also score cameras that trained the scene")
    add(
        "--allow-other-recording",
        action="store_true",
        help="continue although this is not the recording that made the scene",
    )
    add(
        "--images",
        choices=("all", "best-worst", "none"),
        default="best-worst",
        help="with -o: pictures of every view, of each camera's best and worst, or of none (default: best-worst)",
    )
    add("--lpips", type=Path, metavar="FILE.npz", help="weights of LPIPS (docs/score.md); none are included")
    _add_cloud(parser.add_argument_group("surface"))
    add(
        "--baseline",
        type=Path,
        metavar="FILE",
        help="score.json of an earlier score -o: prints the change of each figure, gated as change_NAME",
    )
    _add_fit(parser.add_argument_group("fit"))
    add_source(parser)
    add_output(parser, default="none, the scores are only printed", what="folder for scores and pictures")
    add_config(parser)
    add_gates(parser)


def _add_cloud(group: argparse._ActionsContainer) -> None:
    """``--cloud`` and what goes with it."""
    add = group.add_argument
    add(
        "--cloud",
        type=Path,
        metavar="FILE",
        help="reference points (.ply) or mesh: accuracy, completeness, Chamfer; or a folder of stl024_total.ply or"
        " scan24.ply",
    )
    add(
        "--cloud-masks",
        type=Path,
        metavar="DIR",
        help="DTU's folder ObsMask (ObsMask24_10.mat, Plane24.mat): compare only where its own evaluation does",
    )
    add(
        "--cloud-unit",
        type=real(1e-9, 1e3, "m"),
        metavar="M",
        help="metres per unit (default: 0.001 with --dtu, else 1)",
    )
    add(
        "--cloud-max",
        type=real(1e-6, 1e3, "m"),
        default=0.02,
        metavar="M",
        help="farther points count in a share, not in a mean",
    )
    add(
        "--cloud-spacing",
        type=real(1e-6, 1e3, "m"),
        default=0.0002,
        metavar="M",
        help="both sides are thinned to points this far apart (default: 0.0002)",
    )


def _add_fit(group: argparse._ActionsContainer) -> None:
    """``--fit`` and its options."""
    add = group.add_argument
    add(
        "--fit",
        action="store_true",
        help="fit the scans of --dtu (--scan A,B; default: all), or the image folder of --reference, with both"
        f" methods, then score them (default protocol of scans: {PROTOCOL})",
    )
    add(
        "--fit-iterations",
        type=whole(1, MOST_ITERATIONS),
        metavar="N",
        help="of each method (default: those of the configuration, 2300)",
    )
    add(
        "--fit-splats",
        type=setting(SceneConfig, "max_splats"),
        metavar="N",
        help="the budget, and Gaussians to begin with (default: 10000)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    result = _score_fits(args) if args.fit else _score(args)
    Console(args).concluded(result.verdict, result.report, lines_of(result.report), result.verdict.exit_code)
    return result.verdict.exit_code


def _score(args: argparse.Namespace) -> ScoreResult:
    if args.scene is None:
        raise UsageError("score: expected a SCENE, got none", remedy="give what reconstruct wrote, or --fit")
    for name, default in OF_FITS:
        if getattr(args, name) != default:
            raise UsageError(f"--{name.replace('_', '-')}: only with --fit", remedy="leave it out")
    return score(ScoreRequest(scene=args.scene, baseline=args.baseline, **_scoring(args)), Console(args))


def _score_fits(args: argparse.Namespace) -> ScoreResult:
    if args.scene is not None:
        raise UsageError(f"--fit: makes the scenes itself, got {args.scene}", remedy="leave SCENE or --fit out")
    if args.baseline is not None:
        raise UsageError("--baseline: not with --fit", remedy="score the scenes that --fit -o leaves")
    request = FitRequest(
        config=args.config,
        settings=tuple(args.set),
        seed=args.seed,
        iterations=args.fit_iterations,
        num_splats=NUM_SPLATS if args.fit_splats is None else args.fit_splats,
        **_scoring(args),
    )
    return score_fits(request, Console(args))


def _scoring(args: argparse.Namespace) -> dict[str, Any]:
    """What both kinds of request have in common."""
    return {
        "recording": recording_of(args, args.reference, args.masks),
        "newest": args.snapshots == "newest",
        "cloud": _cloud(args),
        "require": tuple(args.require),
        **{name: getattr(args, name) for name in PASSED_ON},
    }


def _cloud(args: argparse.Namespace) -> CloudSettings | None:
    """None where no cloud is given. Raises UsageError for options that mean nothing here."""
    if args.cloud is None:
        for name in ("unit", "masks"):
            if getattr(args, f"cloud_{name}") is not None:
                raise UsageError(f"--cloud-{name}: only with --cloud", remedy="leave it out")
        return None
    if args.dtu is None and (args.cloud_masks is not None or args.cloud.is_dir()):
        what = "--cloud-masks" if args.cloud_masks is not None else f"--cloud {args.cloud}"
        raise UsageError(f"{what}: a folder of scans, only with --dtu", remedy="give the file of this recording")
    unit = args.cloud_unit if args.cloud_unit is not None else (MILLIMETRE if args.dtu is not None else 1.0)
    return CloudSettings(
        path=args.cloud, unit=unit, max_distance=args.cloud_max, spacing=args.cloud_spacing, masks=args.cloud_masks
    )

"""``splatctrl score``: renders views that did not train a scene and compares them with what was recorded."""

import argparse
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_gates,
    add_output,
    add_threads,
    check_gate_names,
    check_gates,
    table,
)
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.evaluate.pictures import ComparisonRow
    from splatctrl_cli.evaluate.score import ViewScore
    from splatctrl_cli.evaluate.views import View
    from splatctrl_cli.io.output import Stopwatch
    from splatctrl_cli.io.scene_folder import SceneFolder
    from splatctrl_cli.records import GaussianSet, RecordSource, SplatSet

DAMAGED = 3


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(
        subparsers,
        "score",
        run,
        summary="compare renders of a scene with recorded views (by default of the cameras that did not train it): "
        "PSNR, SSIM, depth error",
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder that reconstruct wrote")
    reference = parser.add_mutually_exclusive_group(required=True)
    reference.add_argument(
        "--reference", type=Path, metavar="PATH", help="a log, a capture, or an image folder's TOML"
    )
    reference.add_argument("--dtu", type=Path, metavar="ROOT", help="a DTU data set in MVSNet's layout")
    parser.add_argument("--scan", metavar="NAME", help="which scan of --dtu (default: the only one)")
    parser.add_argument(
        "--snapshots",
        choices=("newest", "final"),
        default="newest",
        help="render each view from the newest snapshot not later than it, or all from the final splats",
    )
    parser.add_argument("--allow-training", action="store_true", help="also score cameras that trained the scene")
    add_threads(parser)
    add_source(parser)
    add_output(parser, default="none, the scores are only printed", what="folder for scores and pictures")
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.evaluate.score import metric_names
    from splatctrl_cli.io.output import Stopwatch, output_path
    from splatctrl_cli.io.scene_folder import open_scene

    check_gate_names(args.require, (*metric_names(), "free_mass", "num_skipped"))
    console, stopwatch = Console(args), Stopwatch()
    scene = open_scene(args.scene)
    source = _open_reference(args)
    cameras = _cameras_to_score(args, source.cameras, scene.cameras)
    output = output_path(args.out, force=args.force, is_folder=True) if args.out else nullcontext()
    with output as folder:
        scores = _score_views(args, console, stopwatch, scene, source, cameras)
        result = _result(args, scene, cameras, scores)
        if folder:
            _write(folder, args, source, result, scores, stopwatch)
    console.result(result, _lines(result))
    check_gates(args.require, result["metrics"])
    return DAMAGED if source.loss.damaged else 0


def _result(
    args: argparse.Namespace, scene: "SceneFolder", cameras: tuple[str, ...], scores: "_Scores"
) -> dict[str, Any]:
    from splatctrl_cli.evaluate.score import PROTOCOL, as_json, total_score

    return {
        "scene": str(args.scene),
        "reference": str(args.reference or args.dtu),
        "cameras": list(cameras),
        "training_cameras": list(scene.cameras),
        "has_clock": scores.has_clock,
        "snapshots": args.snapshots if scores.has_clock else "final",
        "protocol": PROTOCOL,
        "metrics": as_json(
            total_score(scores.views)
            | {"free_mass": _free_mass(args.scene, scene), "num_skipped": len(scores.skipped)}
        ),
        "skipped_views": scores.skipped,
        "views": [
            {"view": v.view, "camera": v.camera, "stamp_ns": v.stamp_ns, **as_json(v.figures())} for v in scores.views
        ],
    }


def _free_mass(path: Path, scene: "SceneFolder") -> float:
    """nan where the scene has no occupancy grid."""
    from splatctrl_cli.evaluate.free_space import free_mass

    if not (path / "occupancy.npz").is_file():
        return nan
    return free_mass(scene.splats(), scene.occupancy(), float(scene.run["config"]["occupancy"]["free_below"]))


@dataclass(kw_only=True)
class _Scores:
    """What scoring gathers: the views, the names of those before the first snapshot, each camera's extremes."""

    has_clock: bool
    views: list["ViewScore"] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    best: dict[str, tuple[float, "ComparisonRow"]] = field(default_factory=dict)
    worst: dict[str, tuple[float, "ComparisonRow"]] = field(default_factory=dict)


def _open_reference(args: argparse.Namespace) -> "RecordSource":
    """The recording with all its cameras: --cameras chooses those to score, the others say what was seen."""
    if args.dtu is not None:
        from splatctrl_cli.io.dtu_source import DtuSource, view_numbers

        return DtuSource(args.dtu, args.scan, view_numbers(_words(args.holdout or "")))
    from splatctrl_cli.io.source import open_source

    if args.scan:
        raise UsageError(f"--scan {args.scan}: only with --dtu", remedy="leave it out")
    return open_source(args.reference, replace(source_options(args), cameras=None))


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _cameras_to_score(
    args: argparse.Namespace, recorded: tuple[str, ...], training: tuple[str, ...]
) -> tuple[str, ...]:
    where = args.reference or args.dtu
    if args.cameras is None:
        cameras = tuple(name for name in recorded if name not in training)
        if cameras:
            return cameras
        if args.allow_training and recorded:
            return recorded
        raise UsageError(
            f"{where}: each camera is called like one that trained the scene ({', '.join(recorded)})",
            remedy="give the views that reconstruct left out as --holdout, or --allow-training",
        )
    cameras = tuple(dict.fromkeys(_words(args.cameras)))
    unknown = [name for name in cameras if name not in recorded]
    if unknown:
        raise InputError(f"{where}: no camera {unknown[0]!r}", remedy=f"use one of: {', '.join(recorded)}")
    trained = [name for name in cameras if name in training]
    if trained and not args.allow_training:
        raise UsageError(
            f"--cameras {args.cameras}: {trained[0]} trained the scene, its score says nothing about other views",
            remedy="give a camera that was held out, or --allow-training",
        )
    return cameras


def _score_views(
    args: argparse.Namespace,
    console: Console,
    stopwatch: "Stopwatch",
    scene: "SceneFolder",
    source: "RecordSource",
    cameras: tuple[str, ...],
) -> _Scores:
    from splatctrl_cli.evaluate.views import views_to_score

    has_clock = scene.has_clock and source.has_clock
    splats_at = _SplatsAt(scene, use_snapshots=has_clock and args.snapshots == "newest")
    scores = _Scores(has_clock=has_clock)
    for view in views_to_score(source, scoring=cameras, training=scene.cameras, has_clock=has_clock):
        if view.frame.stamp_ns in scene.training_stamps_ns and not args.allow_training:
            raise UsageError(
                f"{view.name}: trained the scene, its score says nothing about other views",
                remedy="give the --holdout that reconstruct was given, or --allow-training",
            )
        if has_clock and not splats_at.is_known(view.frame.stamp_ns):
            scores.skipped.append(view.name)
            continue
        with stopwatch.stage("score"):
            _score_one(scores, view, splats_at(view.frame.stamp_ns), scene.background, args.threads)
        if len(scores.views) % 20 == 0:
            console.log(f"scored {len(scores.views)} views")
    if not scores.views:
        num_early = len(scores.skipped)
        raise NotEvaluableError(
            f"{args.reference or args.dtu}: no view of {', '.join(cameras)} to score; {num_early} lie before the "
            "first snapshot of the scene",
            remedy="give the recording that the scene was reconstructed from, or other --cameras",
        )
    if not any(view.seen.share for view in scores.views):
        raise NotEvaluableError(
            f"{args.reference or args.dtu}: no pixel of {', '.join(cameras)} was seen by a training camera "
            f"({', '.join(scene.cameras)})",
            remedy="is it the same world and the same scene? give the recording that reconstruct was given",
        )
    return scores


def _score_one(
    scores: _Scores,
    view: "View",
    splats: "SplatSet | GaussianSet",
    background: tuple[float, float, float],
    threads: int,
) -> None:
    from splatctrl_cli.evaluate.pictures import ComparisonRow
    from splatctrl_cli.evaluate.score import score_view
    from splatctrl_cli.evaluate.visibility import seen_pixels
    from splatctrl_cli.records import GaussianSet
    from splatctrl_cli.scene.gaussians import render_gaussians
    from splatctrl_cli.scene.render import render

    frame = view.frame
    if isinstance(splats, GaussianSet):
        rendering = render_gaussians(splats, frame.intrinsics, frame.T_world_camera, threads=threads)
    else:
        rendering = render(splats, frame.intrinsics, frame.T_world_camera, threads=threads)
    rendering = rendering.before(background)
    depth = rendering.normalised_depth()
    seen = seen_pixels(frame, view.training)
    score = score_view(view=view.name, color=rendering.color, depth=depth, frame=frame, seen=seen)
    scores.views.append(score)
    rank = score.all.psnr if isnan(score.seen.psnr) else score.seen.psnr
    row = ComparisonRow(
        title=view.name,
        figures=f"{score.seen.psnr:.1f} dB where seen, {score.all.psnr:.1f} dB in all",
        photo=frame.color,
        render=rendering.color,
        photo_depth=frame.depth,
        render_depth=depth,
    )
    if frame.camera not in scores.best or rank > scores.best[frame.camera][0]:
        scores.best[frame.camera] = (rank, row)
    if frame.camera not in scores.worst or rank < scores.worst[frame.camera][0]:
        scores.worst[frame.camera] = (rank, row)


class _SplatsAt:
    """The splats that a view is rendered from; a snapshot is read once for all the views it serves."""

    def __init__(self, scene: "SceneFolder", *, use_snapshots: bool) -> None:
        self._scene = scene
        self._stamps = [] if scene.is_anisotropic else sorted(snapshot.stamp_ns for snapshot in scene.snapshots)
        self._use_snapshots = use_snapshots
        self._loaded: tuple[int, SplatSet | GaussianSet] | None = None

    def is_known(self, stamp_ns: int) -> bool:
        """Whether the scene had a snapshot at that time."""
        return bool(self._stamps) and self._stamps[0] <= stamp_ns

    def __call__(self, stamp_ns: int) -> "SplatSet | GaussianSet":
        from bisect import bisect_right

        number = bisect_right(self._stamps, stamp_ns) if self._use_snapshots else -1
        if self._loaded is None or self._loaded[0] != number:
            self._loaded = (number, self._read(stamp_ns))
        return self._loaded[1]

    def _read(self, stamp_ns: int) -> "SplatSet | GaussianSet":
        if self._scene.is_anisotropic:
            return self._scene.gaussians()
        return self._scene.splats_at(stamp_ns) if self._use_snapshots else self._scene.splats()


def _write(
    folder: Path,
    args: argparse.Namespace,
    source: "RecordSource",
    result: dict[str, Any],
    scores: _Scores,
    stopwatch: "Stopwatch",
) -> None:
    import csv

    from splatctrl_cli.evaluate.pictures import comparison_picture
    from splatctrl_cli.io.output import sha256, write_json, write_run

    write_json(folder / "score.json", result)
    with (folder / "views.csv").open("w", newline="", encoding="utf-8") as stream:
        rows = csv.DictWriter(stream, fieldnames=list(result["views"][0]), lineterminator="\n")
        rows.writeheader()
        rows.writerows(result["views"])
    with stopwatch.stage("pictures"):
        for camera, (_, best) in scores.best.items():
            worst = scores.worst[camera][1]
            comparison = [best] if worst.title == best.title else [best, worst]
            comparison_picture(folder / f"{best.title.rsplit('-', 1)[0]}_best_worst.png", comparison)
    write_run(
        folder,
        command="score",
        config={"cameras": result["cameras"], "snapshots": result["snapshots"]},
        inputs={**source.digests(), "scene/splats.ply": sha256(args.scene / "splats.ply")},
        metrics=result["metrics"],
        stopwatch=stopwatch,
    )


COLUMNS = ("psnr_seen", "psnr_all", "ssim_seen", "ssim_all", "depth_median_seen", "depth_median_all",
           "in_front_seen", "seen_share")  # fmt: skip
HEADER = ("dB seen", "dB all", "SSIM seen", "SSIM all", "depth mm seen", "depth mm all", "in front", "seen")


def _lines(result: dict[str, Any]) -> list[str]:
    stamps = [f"{view['stamp_ns'] / 1e9:.3f}" if result["has_clock"] else "-" for view in result["views"]]
    views = [[view["view"], stamp, *_cells(view)] for view, stamp in zip(result["views"], stamps, strict=True)]
    metrics = result["metrics"]
    views.append([f"mean of {metrics['num_views']:.0f}", "-", *_cells(metrics)])
    lines = table(("view", "stamp [s]", *HEADER), views)
    lines.insert(len(lines) - 1, lines[1])
    lines.append("")
    lines.append(
        f"{_count(metrics['num_views'], 'view')} scored, {metrics['num_skipped']:.0f} before the first snapshot; "
        f"depth: median of the absolute error; seen: by {', '.join(result['training_cameras'])} within 2 cm"
    )
    lines.append("in front: share of the pixels seen whose rendered depth is over 3 cm before the recorded one")
    if metrics["free_mass"] is not None:
        lines.append(f"{100 * metrics['free_mass']:.2f}% of the splats' mass is in space observed free")
    return lines


def _count(number: float, noun: str) -> str:
    return f"{number:.0f} {noun}{'' if number == 1 else 's'}"


def _cells(figures: dict[str, Any]) -> list[str]:
    return [_cell(name, figures[name]) for name in COLUMNS]


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name.startswith("depth"):
        return f"{1000 * value:.1f}"
    if name in {"seen_share", "in_front_seen"}:
        return f"{100 * value:.1f}%"
    return f"{value:.2f}" if name.startswith("psnr") else f"{value:.4f}"

"""What `score` prints and writes: the protocol it went by, a row per view, the mean."""

import argparse
import csv
from collections.abc import Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import table
from splatctrl_cli.cli.score_baseline import PREFIX, change_cells
from splatctrl_cli.cli.score_cloud import CloudSettings
from splatctrl_cli.cli.score_reference import Reference
from splatctrl_cli.cli.score_views import Scores
from splatctrl_cli.evaluate.cloud import cloud_names
from splatctrl_cli.evaluate.free_space import free_mass
from splatctrl_cli.evaluate.gates import gate_reasons
from splatctrl_cli.evaluate.perceptual import Lpips
from splatctrl_cli.evaluate.score import PROTOCOL, as_json, metric_names, total_score
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, noted, verdict_of
from splatctrl_cli.field.obstacles import obstacle_spheres
from splatctrl_cli.files.output import Stopwatch, sha256, write_json, write_run
from splatctrl_cli.records import Label
from splatctrl_cli.report.pictures import comparison_picture
from splatctrl_cli.scene_files.scene_folder import SceneFolder, run_value


def result_of(
    args: argparse.Namespace,
    scene: "SceneFolder",
    reference: Reference,
    cameras: tuple[str, ...],
    scores: Scores,
    *,
    recording: dict[str, Any],
    cloud: tuple[CloudSettings, dict[str, float]] | None,
    lpips: "Lpips | None",
) -> dict[str, Any]:
    """Everything that --json prints."""
    metrics = total_score(scores.views) | (cloud[1] if cloud else {})
    metrics |= {"free_mass": _free_mass(args.scene, scene), "num_skipped": len(scores.skipped)}
    metrics["num_warnings"] = len(scores.doubts) + len(recording["differences"])
    definitions = PROTOCOL | ({"cloud": cloud[0].words()} if cloud else {})
    return {
        "scene": str(args.scene),
        "reference": str(args.reference or args.dtu),
        "cameras": list(cameras),
        "training_cameras": list(scene.cameras),
        "has_clock": scores.has_clock,
        "snapshots": args.snapshots if scores.has_clock else "final",
        "recording": recording,
        "protocol": _protocol(reference, scene, scores, lpips) | {"definitions": definitions},
        "metrics": as_json(metrics),
        "warnings": [*(f"another recording: {line}" for line in recording["differences"]), *scores.doubts],
        "skipped_views": scores.skipped,
        "views": [
            {"view": v.view, "camera": v.camera, "stamp_ns": v.stamp_ns, **as_json(v.figures())} for v in scores.views
        ],
    }


def _protocol(reference: Reference, scene: "SceneFolder", scores: Scores, lpips: "Lpips | None") -> dict[str, Any]:
    """What a figure has to be printed with to be compared with another."""
    named, split = reference.protocol, reference.split
    sizes = sorted({view.size for view in scores.views})
    return {
        "name": "none" if named is None else named.name,
        "source": "none" if named is None else named.source,
        "layout": reference.layout,
        "training_views": None if split is None else list(split.training),
        "scored_views": None if split is None else list(split.scored),
        "left_out_views": None if split is None else list(split.left_out),
        "split": "by camera" if split is None else split.words(),
        "mask_rule": reference.mask_rule,
        "resolution": [f"{width}x{height}" for width, height in sizes],
        "published_resolution": None if named is None or named.size is None else "{}x{}".format(*named.size),
        "published_scans": None if named is None or not named.scans else list(named.scans),
        "background": [round(value, 4) for value in scene.background],
        "averaging": "mean over the views",
        "lpips": None if lpips is None else lpips.name,
    }


def _free_mass(path: Path, scene: "SceneFolder") -> float:
    """nan where the scene has no occupancy grid."""
    if not (path / "occupancy.npz").is_file():
        return nan
    keys = ("config", "occupancy", "free_below")
    free_below = run_value(scene.run, keys, float, where=str(path / "run.json"))
    spheres = obstacle_spheres(scene.splats(), scene.unrepresented_at(None), frozenset(Label))
    return free_mass(spheres.splats, scene.occupancy(), free_below)


def gated_names(*, with_changes: bool) -> tuple[str, ...]:
    """What --require can name; with_changes: since a --baseline, too."""
    names = (*metric_names(), *cloud_names(), "free_mass", "num_skipped", "num_warnings", "num_scans")
    return (*names, *(PREFIX + name for name in names)) if with_changes else names


def score_verdict(result: Mapping[str, Any], require: Sequence[str], *, is_damaged: bool) -> "Verdict":
    """The verdict on a result: that there are views, what speaks against its figures, and each ``--require``."""
    metrics, counts = result["metrics"], counts_of(result)
    num_scans = metrics.get("num_scans")
    of_scans = "" if num_scans is None else f" of {_count(num_scans, 'scan')}"
    return verdict_of(
        "score",
        [
            views_reason(metrics["num_views"]),
            *(noted("score", line) for line in result["warnings"]),
            *gate_reasons(require, dict.fromkeys(gated_names(with_changes=True), None) | metrics, counts),
        ],
        scope=f"{_count(metrics['num_views'], 'view')}{of_scans}",
        is_damaged=is_damaged,
        counts=counts,
    )


def counts_of(result: Mapping[str, Any]) -> dict[str, int]:
    """How many views each metric rests on: those that have the figure; of a change, those of the metric now."""
    metrics = result["metrics"]
    each = [result] if "views" in result else list(result["results"].values())
    views = [view for one in each for view in one["views"]]
    num_views = int(metrics["num_views"])
    counts = {}
    for name in metrics:
        figure = name.removeprefix(PREFIX)
        counts[name] = sum(view[figure] is not None for view in views) if figure in views[0] else num_views
    return counts


def views_reason(num_views: float) -> "Reason":
    """Whether anything was compared."""
    return Reason(
        criterion="views",
        outcome=Outcome.PASSED if num_views else Outcome.NOT_EVALUABLE,
        sentence=f"{_count(num_views, 'view')} compared",
        value=float(num_views),
        threshold=1.0,
        count=int(num_views),
    )


def write_scores(
    folder: Path,
    args: argparse.Namespace,
    digests: Mapping[str, str],
    result: dict[str, Any],
    scores: Scores,
    stopwatch: "Stopwatch",
    verdict: "Verdict",
) -> None:
    """The files of ``score -o``."""
    write_json(folder / "score.json", result)
    with (folder / "views.csv").open("w", newline="", encoding="utf-8") as stream:
        rows = csv.DictWriter(stream, fieldnames=list(result["views"][0]), lineterminator="\n")
        rows.writeheader()
        rows.writerows(result["views"])
    with stopwatch.stage("pictures"):
        for camera, (_, best) in scores.best.items() if args.images != "none" else ():
            worst = scores.worst[camera][1]
            comparison = [best] if worst.title == best.title else [best, worst]
            comparison_picture(folder / f"{best.title.rsplit('-', 1)[0]}_best_worst.png", comparison)
    protocol = {name: value for name, value in result["protocol"].items() if name != "definitions"}
    write_run(
        folder,
        command="score",
        config={"cameras": result["cameras"], "snapshots": result["snapshots"], "protocol": protocol},
        inputs={**digests, "scene/splats.ply": sha256(args.scene / "splats.ply")},
        metrics=result["metrics"],
        stopwatch=stopwatch,
        verdict=verdict.as_dict(),
    )


COLUMNS = {
    "psnr_seen": "dB seen",
    "psnr_all": "dB all",
    "psnr_masked": "dB mask",
    "ssim_seen": "SSIM seen",
    "ssim_all": "SSIM all",
    "ssim_published": "SSIM publ.",
    "lpips": "LPIPS",
    "lpips_published": "LPIPS publ.",
    "depth_median_seen": "depth mm seen",
    "depth_median_all": "depth mm all",
    "in_front_seen": "in front",
    "seen_share": "seen",
    "mask_share": "mask",
    "valid_share": "valid",
    "chamfer": "Chamfer mm",
}
SHARES = ("seen_share", "in_front_seen", "mask_share", "valid_share")


def lines_of(result: dict[str, Any]) -> list[str]:
    """The table, and what belongs to its figures."""
    metrics, columns = result["metrics"], [name for name in COLUMNS if name in result["views"][0]]
    stamps = [f"{view['stamp_ns'] / 1e9:.3f}" if result["has_clock"] else "-" for view in result["views"]]
    views = [
        [view["view"], stamp, *(cell(n, view[n]) for n in columns)]
        for view, stamp in zip(result["views"], stamps, strict=True)
    ]
    views.append([f"mean of {metrics['num_views']:.0f}", "-", *(cell(name, metrics[name]) for name in columns)])
    changed = ["change", "-", *change_cells(columns, metrics)]
    lines = table(("view", "stamp [s]", *(COLUMNS[name] for name in columns)), with_change(views, changed, metrics))
    lines.insert(2 + len(result["views"]), lines[1])
    lines += ["", *protocol_lines(result["protocol"])]
    lines.append(
        f"{_count(metrics['num_views'], 'view')} scored, {metrics['num_skipped']:.0f} before the first snapshot; "
        f"depth: median of the absolute error; seen: by {', '.join(result['training_cameras'])} within 2 cm"
    )
    if "chamfer" in metrics:
        lines += cloud_lines(metrics, result["protocol"]["definitions"]["cloud"])
    lines.append("in front: share of the pixels seen whose rendered depth is over 3 cm before the recorded one")
    if metrics["free_mass"] is not None:
        lines.append(f"{100 * metrics['free_mass']:.2f}% of the splats' mass is in space observed free")
    return lines


def with_change(rows: list[list[Any]], change: list[Any], metrics: Mapping[str, Any]) -> list[list[Any]]:
    """The rows of a table, and that of the changes where there was a baseline."""
    return [*rows, change] if f"{PREFIX}num_views" in metrics else rows


def protocol_lines(protocol: dict[str, Any]) -> list[str]:
    """Protocol, split, mask rule, averaging, resolution and background, for people."""
    color = ", ".join(f"{value:.2f}" for value in protocol["background"])
    published = protocol["published_resolution"]
    resolution = ", ".join(protocol["resolution"])
    differs = "" if published in (None, resolution) else f" (published figures: {published})"
    scans = protocol["published_scans"]
    return [
        f"protocol: {protocol['name']}" + ("" if protocol["name"] == "none" else f" ({protocol['source']})"),
        f"split: {protocol['split']}",
        *([f"published figures: means over scans {', '.join(map(str, scans))}"] if scans else []),
        f"mask rule: {protocol['mask_rule']}; averaging: {protocol['averaging']}; resolution: {resolution}{differs};"
        f" background: ({color})",
    ]


def cloud_lines(metrics: dict[str, Any], words: str) -> list[str]:
    """Accuracy, completeness and Chamfer, and by what they came about, for people."""

    def share(name: str) -> str:
        return "-" if metrics[name] is None else f"{100 * metrics[name]:.1f}% farther"

    parts = [f"accuracy {_millimetres(metrics['accuracy'])} ({share('accuracy_beyond')})"]
    for name, of in (("completeness", "all"), ("completeness_seen", "seen")):
        parts.append(f"completeness of {of} {_millimetres(metrics[name])} ({share(name + '_beyond')})")
    return [f"surface: {', '.join(parts)}, Chamfer {_millimetres(metrics['chamfer'])}", f"cloud: {words}"]


def _millimetres(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f} mm"


def _count(number: float, noun: str) -> str:
    return f"{number:.0f} {noun}{'' if number == 1 else 's'}"


def cell(name: str, value: float | None) -> str:
    """A figure as the table shows it."""
    if value is None:
        return "-"
    if name.startswith("depth"):
        return f"{1000 * value:.1f}"
    if name == "chamfer":
        return f"{1000 * value:.2f}"
    if name in SHARES:
        return f"{100 * value:.1f}%"
    return f"{value:.2f}" if name.startswith("psnr") else f"{value:.4f}"

"""``splatctrl score``: renders compared with held-out views."""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from splatctrl_cli.cli.common import Console, request_of, table
from splatctrl_cli.cli.reconstruct import recording_of
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.score_report import PREFIX
from splatctrl_cli.evaluate.verdict import counted
from splatctrl_cli.jobs.score.score import ScoreRequest, ScoreResult, score
from splatctrl_cli.jobs.score.views import CloudSettings
from splatctrl_cli.records import MILLIMETRE

COLUMNS = {
    "psnr_seen": "dB seen",
    "psnr_all": "dB all",
    "psnr_all_corrected": "dB corrected",
    "psnr_masked": "dB mask",
    "ssim_seen": "SSIM seen",
    "ssim_all": "SSIM all",
    "ssim_published": "SSIM publ.",
    "depth_median_seen": "depth mm seen",
    "depth_median_all": "depth mm all",
    "depth_median_all_corrected": "depth mm corrected",
    "in_front_seen": "in front",
    "seen_share": "seen",
    "mask_share": "mask",
    "valid_share": "valid",
    "chamfer": "Chamfer mm",
}


def run(args: argparse.Namespace) -> int:
    console = Console(args)
    return show_scored(console, score(_request(args), console))


def show_scored(console: Console, result: ScoreResult) -> int:
    return console.concluded(result.verdict, result.report, lines_of(result.report))


def _request(args: argparse.Namespace) -> ScoreRequest:
    first, *beside = args.reference or [None]
    return request_of(
        ScoreRequest,
        args,
        recording=replace(recording_of(args, first, args.masks), beside=tuple(beside)),
        newest=args.snapshots == "newest",
        cloud=_cloud(args),
    )


def _cloud(args: argparse.Namespace) -> CloudSettings | None:
    """Read --cloud's settings. Raises UsageError for its options alone."""
    if args.cloud is None:
        for name in ("unit", "masks"):
            if getattr(args, f"cloud_{name}") is not None:
                raise UsageError(f"--cloud-{name}: only with --cloud", remedy="leave it out")
        return None
    if args.dtu is None and (args.cloud_masks is not None or args.cloud.is_dir()):
        what = "--cloud-masks" if args.cloud_masks is not None else f"--cloud {args.cloud}"
        raise UsageError(f"{what}: a folder of scans, only with --dtu", remedy="give the file of this recording")
    return CloudSettings(
        path=args.cloud,
        unit=args.cloud_unit if args.cloud_unit is not None else (MILLIMETRE if args.dtu is not None else 1.0),
        max_distance=args.cloud_max,
        spacing=args.cloud_spacing,
        masks=args.cloud_masks,
    )


def lines_of(report: Mapping[str, Any]) -> Iterable[str]:
    return _lines_of_scans(report) if "results" in report else _lines_of_views(report)


def _lines_of_views(report: Mapping[str, Any]) -> Iterator[str]:
    metrics, columns = report["metrics"], [name for name in COLUMNS if name in report["views"][0]]
    stamps = [f"{view['stamp_ns'] / 1e9:.3f}" if report["has_clock"] else "-" for view in report["views"]]
    rows = [
        [view["view"], stamp, *_cells(columns, view)] for view, stamp in zip(report["views"], stamps, strict=True)
    ]
    yield from _with_mean(("view", "stamp [s]"), columns, rows, [f"mean of {len(rows)}", "-"], metrics)
    yield from ("", *_protocol_lines(report["protocol"]))
    yield (
        f"{counted(metrics['num_views'], 'view')} scored, {metrics['num_skipped']:.0f} before the first snapshot; "
        f"depth: median of the absolute error; seen: by {', '.join(report['training_cameras'])} within 2 cm"
    )
    if "chamfer" in metrics:
        yield from _cloud_lines(metrics, report["protocol"]["definitions"]["cloud"])
    if "psnr_all_corrected" in columns:
        yield (
            "corrected: all pixels, at the pose and exposure that the view has among the training views, its depth"
            " freed of the bend that theirs was"
        )
    yield "in front: share of the pixels seen whose rendered depth is over 3 cm before the recorded one"
    if metrics["free_mass"] is not None:
        yield f"{100 * metrics['free_mass']:.2f}% of the splats' mass is in space observed free"


def _lines_of_scans(report: Mapping[str, Any]) -> Iterator[str]:
    metrics, results = report["metrics"], report["results"]
    columns = [name for name in COLUMNS if name in metrics]
    rows = [[s, one["metrics"]["num_views"], *_cells(columns, one["metrics"])] for s, one in results.items()]
    yield from _with_mean(
        ("scan", "views"), columns, rows, [f"mean of {len(results)}", metrics["num_views"]], metrics
    )
    yield from ("", *_protocol_lines(report["protocol"]))
    if "chamfer" in metrics:
        yield from _cloud_lines(
            metrics, "; ".join(one["protocol"]["definitions"]["cloud"] for one in results.values())
        )


def _with_mean(
    header: Sequence[str],
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    mean: Sequence[Any],
    metrics: Mapping[str, Any],
) -> list[str]:
    last = [[*mean, *_cells(columns, metrics)]]
    if f"{PREFIX}num_views" in metrics:
        last.append(["change", "-", *(_change(name, metrics.get(PREFIX + name)) for name in columns)])
    lines = table((*header, *(COLUMNS[name] for name in columns)), [*rows, *last])
    lines.insert(2 + len(rows), lines[1])
    return lines


def _protocol_lines(protocol: Mapping[str, Any]) -> list[str]:
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


def _cloud_lines(metrics: Mapping[str, Any], words: str) -> list[str]:
    def length(name: str) -> str:
        return "-" if metrics[name] is None else f"{1e3 * metrics[name]:.2f} mm"

    def share(name: str) -> str:
        return "-" if metrics[name] is None else f"{100 * metrics[name]:.1f}% farther"

    figures = {"accuracy": "accuracy", "completeness": "completeness of all"}
    figures["completeness_seen"] = "completeness of seen"
    parts = [f"{words} {length(name)} ({share(name + '_beyond')})" for name, words in figures.items()]
    return [f"surface: {', '.join(parts)}, Chamfer {length('chamfer')}", f"cloud: {words}"]


def _cells(columns: Sequence[str], metrics: Mapping[str, Any]) -> list[str]:
    return [_cell(name, metrics.get(name)) for name in columns]


def _change(name: str, value: float | None) -> str:
    return "-" if value is None else ("-" if value < 0 else "+") + _cell(name, abs(value))


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name.startswith("depth"):
        return f"{1000 * value:.1f}"
    if name == "chamfer":
        return f"{1000 * value:.2f}"
    if name in ("seen_share", "in_front_seen", "mask_share", "valid_share"):
        return f"{100 * value:.1f}%"
    return f"{value:.2f}" if name.startswith("psnr") else f"{value:.4f}"

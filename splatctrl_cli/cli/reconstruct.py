"""``splatctrl reconstruct`` and ``score``: a log into splats, occupancy and snapshots; renders against views."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import Console, config_of, remarks, request_of, table
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.score import PREFIX
from splatctrl_cli.evaluate.verdict import Result, plural
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.running.device import DECIDING_OPTIONS, describe_device
from splatctrl_cli.jobs.score.score import ScoreRequest, score
from splatctrl_cli.jobs.score.views import CloudSettings
from splatctrl_cli.kernels import native
from splatctrl_cli.records import MILLIMETRE


def run(args: argparse.Namespace, console: Console) -> int:
    native.keep_freed_memory()
    config = config_of(args)  # refused before the source is opened
    refuse_if(
        (args.source is None) == (args.dtu is None),
        "reconstruct: expected a SOURCE or --dtu ROOT, and not both",
        error=UsageError,
    )
    allowed = {"views-agreement", "views-scale"} if args.allow_disagreement or args.refine_poses else set()
    request = request_of(
        ReconstructRequest,
        args,
        config=config,
        source=open_to_train(
            recording_of(args, args.source),
            max_pose_jump=args.max_pose_jump,
            needs_depth=args.points is None,
            allowed=allowed | ({"alignment"} if args.allow_disagreement else set()),
        ),
        options={name: getattr(args, name) for name in DECIDING_OPTIONS},
    )
    result = reconstruct(request, console)
    return console.show(result, [*_lines(result), f"wrote {result.out}"])


def recording_of(args: argparse.Namespace, path: Path, others: tuple[Path, ...] = ()) -> RecordingRequest:
    return request_of(RecordingRequest, args, path=args.dtu or path, is_dtu=args.dtu is not None, others=others)


def _lines(result: Result) -> list[str]:
    metrics, removed = result.metrics, result.document["removed"]
    psnr = metrics["psnr"]
    columns = {
        **{name.replace("_", " "): metrics[name] for name in ("time_steps", "splats")},
        "robot": metrics["robot_splats"],
        "shell": metrics["shell_splats"],
        **{name: metrics[name] for name in ("added", "relocated", "unmet")},
        "training dB": "-" if psnr is None else f"{psnr:.2f}",
        "seconds": f"{sum(result.seconds.values()):.1f}",
    }
    reasons = (f"{count} {reason.replace('_', ' ')}" for reason, count in removed.items() if count)
    return [
        *table(list(columns), [list(columns.values())]),
        f"splats removed: {', '.join(reasons) or 'none'}",
        f"computed on {', then '.join(map(describe_device, metrics['devices']))}",
    ]


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
SHARE = 100  # printed as per cent
FORMS = {  # by the start of a figure's name: factor and format
    **{"depth": (1000, ".1f"), "chamfer": (1000, ".2f"), "psnr": (1, ".2f")},
    **dict.fromkeys(("seen_share", "in_front_seen", "mask_share", "valid_share"), (SHARE, ".1f")),
}


def run_score(args: argparse.Namespace, console: Console) -> int:
    first, *others = args.reference or [None]
    recording = recording_of(args, first, tuple(others))
    result = score(request_of(ScoreRequest, args, recording=recording, cloud=_cloud(args)), console)
    return console.show(result, lines_of(result.document))


def _cloud(args: argparse.Namespace) -> CloudSettings | None:
    if args.cloud is None:
        for name in ("unit", "masks"):
            refuse_if(
                getattr(args, f"cloud_{name}") is not None,
                f"--cloud-{name}: only with --cloud",
                remedy="leave it out",
                error=UsageError,
            )
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


def lines_of(report: Mapping[str, Any]) -> Iterator[str]:
    """Figures by view or scan, with their mean and definitions."""
    metrics, scans = report["metrics"], report.get("results", {})
    views = [] if scans else report["views"]
    columns = [name for name in COLUMNS if name in (metrics if scans else views[0])]
    stamps = [f"{view['stamp_ns'] / 1e9:.3f}" if report["has_clock"] else "-" for view in views]
    rows = [[view["view"], stamp, *_cells(columns, view)] for view, stamp in zip(views, stamps, strict=True)]
    rows += [[s, one["metrics"]["num_views"], *_cells(columns, one["metrics"])] for s, one in scans.items()]
    header = ("scan", "views") if scans else ("view", "stamp [s]")
    num = metrics["num_views"] if scans else "-"
    yield from _add_mean(header, columns, rows, [f"mean of {len(rows)}", num], metrics)
    yield from ("", *_protocol_lines(report["protocol"]))
    if views:
        yield (
            f"{plural(metrics['num_views'], 'view')} scored, {metrics['num_skipped']:.0f} before the first snapshot;"
            f" depth: median of the absolute error; seen: by {', '.join(report['training_cameras'])} within 2 cm"
        )
    if "chamfer" in metrics:
        clouds = [one["protocol"]["definitions"]["cloud"] for one in (scans.values() if scans else [report])]
        yield from (_surface(metrics), f"cloud: {'; '.join(clouds)}")
    if views:
        corrected = (
            "corrected: all pixels, at the pose and exposure that the view has among the training views, its depth"
            " freed of the bend that theirs was"
        )
        mass = metrics["free_mass"]
        yield from remarks(
            (corrected, "psnr_all_corrected" in columns),
            ("in front: share of the pixels seen whose rendered depth is over 3 cm before the recorded one", True),
            (f"{100 * (mass or 0.0):.2f}% of the splats' mass is in space observed free", mass is not None),
        )


def _add_mean(
    header: Sequence[str],
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    mean: Sequence[Any],
    metrics: Mapping[str, Any],
) -> list[str]:
    last = [[*mean, *_cells(columns, metrics)]]
    if f"{PREFIX}num_views" in metrics:
        changes = {name: metrics.get(PREFIX + name) for name in columns}
        last.append(["change", "-", *(_cell(name, value, is_change=True) for name, value in changes.items())])
    lines = table((*header, *(COLUMNS[name] for name in columns)), [*rows, *last])
    lines.insert(2 + len(rows), lines[1])
    return lines


def _protocol_lines(protocol: Mapping[str, Any]) -> list[str]:
    color = ", ".join(f"{value:.2f}" for value in protocol["background"])
    published, scans = protocol["published_resolution"], protocol["published_scans"]
    resolution = ", ".join(protocol["resolution"])
    differs = "" if published in (None, resolution) else f" (published figures: {published})"
    return [
        f"protocol: {protocol['name']}" + ("" if protocol["name"] == "none" else f" ({protocol['source']})"),
        f"split: {protocol['split']}",
        *([f"published figures: means over scans {', '.join(map(str, scans))}"] if scans else []),
        f"mask rule: {protocol['mask_rule']}; averaging: {protocol['averaging']}; resolution: {resolution}{differs};"
        f" background: ({color})",
    ]


def _surface(metrics: Mapping[str, Any]) -> str:
    figures = {"accuracy": "accuracy", "completeness": "completeness of all"}
    figures["completeness_seen"] = "completeness of seen"
    lengths = {name: "-" if (v := metrics[name]) is None else f"{1e3 * v:.2f} mm" for name in (*figures, "chamfer")}
    beyond = {name: metrics[f"{name}_beyond"] for name in figures}
    shares = {name: "-" if share is None else f"{100 * share:.1f}% farther" for name, share in beyond.items()}
    parts = [f"{words} {lengths[name]} ({shares[name]})" for name, words in figures.items()]
    return f"surface: {', '.join(parts)}, Chamfer {lengths['chamfer']}"


def _cells(columns: Sequence[str], metrics: Mapping[str, Any]) -> list[str]:
    return [_cell(name, metrics.get(name)) for name in columns]


def _cell(name: str, value: float | None, *, is_change: bool = False) -> str:
    if value is None:
        return "-"
    factor, form = next((of for start, of in FORMS.items() if name.startswith(start)), (1.0, ".4f"))
    sign = "" if not is_change else "-" if value < 0 else "+"
    text = f"{factor * (abs(value) if is_change else value):{form}}"
    return sign + text + "%" * (factor == SHARE)

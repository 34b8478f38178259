"""``splatctrl export``: splats in viewers' formats."""

import argparse
from collections.abc import Iterator
from dataclasses import asdict

from splatctrl_cli.cli.common import Console, remarks, request_of, table
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.jobs.export.export import ExportRequest, ExportResult, ExportRunRequest, export, export_run
from splatctrl_cli.records import Label

SHOWN = {  # of Differences: what the table calls it, and the unit it is shown in
    "center": ("centre mm", 1e3),
    "sigma": ("sigma %", 1e2),
    "rotation": ("rotation deg", 1.0),
    "color": ("colour of 255", 255.0),
    "opacity": ("opacity of 255", 255.0),
    "harmonics": ("harmonics", 1.0),
}


def run(args: argparse.Namespace, console: Console) -> int:
    if args.mcap:
        for name in ("labels", "layout", "isotropic"):
            refuse_if(getattr(args, name), f"--{name}: not with --mcap", remedy="leave it out", error=UsageError)
        logged = export_run(request_of(ExportRunRequest, args))
        rows = table(("topic", "messages"), [*logged.messages.items()])
        return console.result(asdict(logged), [f"{logged.file}: {logged.bytes} bytes", *rows])
    result = export(request_of(ExportRequest, args), console)
    return console.result({n: v for n, v in asdict(result).items() if n != "was_rounded"}, _lines(result))


def labels_of(names: str) -> list[Label]:
    """Labels of ``--labels``. Raises UsageError for an unknown one."""
    known = {label.name.lower(): label for label in Label}
    chosen = [name.strip() for name in names.split(",")]
    if unknown := [name for name in chosen if name not in known]:
        raise UsageError(f"--labels {names}: unknown label {unknown[0]!r}", remedy=f"known here: {', '.join(known)}")
    return [known[name] for name in chosen]


def _lines(result: ExportResult) -> Iterator[str]:
    left_out = f", {result.num_left_out} left out by label" if result.num_left_out else ""
    yield f"{result.file}: {result.num_splats} splats{left_out}, {result.bytes} bytes, {result.format}"
    outside = f"{result.num_outside} splats have a size or colour beyond the format's range: put at its edge"
    yield from remarks(
        (f"made isotropic: {_decibels(result.isotropic_psnr)} against the source", result.was_rounded),
        (f"centres are less the origin {result.origin} m: float32 would move them without", result.origin),
        (f"not kept: {', '.join(result.not_kept)}", result.not_kept),
        (outside, result.num_outside),
    )
    found, allowed = vars(result.differences), vars(result.allowed)
    yield from table(
        ["largest difference", "found", "allowed"],
        [(name, f"{found[key] * unit:.3g}", f"{allowed[key] * unit:.3g}") for key, (name, unit) in SHOWN.items()],
    )
    yield (
        f"read back and rendered from {result.num_views_compared} views ({100 * result.covered_share:.0f} % of their"
        f" pixels covered): {_decibels(result.psnr)}, largest pixel difference {result.largest_pixel_difference:.2g}"
    )


def _decibels(psnr: float | None) -> str:
    return "the same" if psnr is None else f"PSNR {psnr:.1f} dB"

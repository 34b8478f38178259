"""``splatctrl export``: splats in viewers' formats."""

import argparse
from collections.abc import Iterator

from splatctrl_cli.cli.common import Console, request_of, table
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.jobs.export.export import ExportRequest, ExportRunRequest, decibels, export, export_run
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
        lines = table(("topic", "messages"), [*logged.metrics["messages"].items()])
        return console.show(logged, [f"{logged.out}: {logged.metrics['bytes']} bytes", *lines])
    result = export(request_of(ExportRequest, args), console)
    return console.show(result, _lines(result))


def labels_of(names: str) -> list[Label]:
    """Labels of ``--labels``. Raises UsageError for an unknown one."""
    known = {label.name.lower(): label for label in Label}
    chosen = [name.strip() for name in names.split(",")]
    if unknown := [name for name in chosen if name not in known]:
        raise UsageError(f"--labels {names}: unknown label {unknown[0]!r}", remedy=f"known here: {', '.join(known)}")
    return [known[name] for name in chosen]


def _lines(result: Result) -> Iterator[str]:
    metrics = result.metrics
    left_out = f", {metrics['num_left_out']} left out by label" if metrics["num_left_out"] else ""
    yield "{}: {num_splats} splats{}, {bytes} bytes, {format}".format(result.out, left_out, **metrics)
    yield from result.notes
    differences, allowed = metrics["differences"], metrics["allowed"]
    yield from table(
        ["largest difference", "found", "allowed"],
        [
            (name, f"{differences[key] * unit:.3g}", f"{allowed[key] * unit:.3g}")
            for key, (name, unit) in SHOWN.items()
        ],
    )
    yield (
        f"read back and rendered from {metrics['num_views_compared']} views ({100 * metrics['covered_share']:.0f} % "
        f"of their pixels covered): {decibels(metrics['psnr'])}, largest pixel difference "
        f"{metrics['largest_pixel_difference']:.2g}"
    )

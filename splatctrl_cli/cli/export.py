"""``splatctrl query``, ``export``: distances and nearest splats at points; splats in viewers' formats."""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.cli.common import Console, names_of, request_of, table
from splatctrl_cli.config import load_config
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.export.export import ExportRequest, ExportResult, ExportRunRequest, export, export_run
from splatctrl_cli.jobs.query.query import QueryRequest, QueryResult, query
from splatctrl_cli.records import Label


def run_query(args: argparse.Namespace) -> int:
    """Run; without an output answers go to stdout, figures to stderr."""
    console = Console(args)
    request = request_of(
        QueryRequest,
        args,
        points=sys.stdin if str(args.points) == "-" else args.points,
        config=load_config(args.config, args.set),
        labels=labels_of(args.include),
    )
    if args.out is not None or console.is_json:
        result = query(request, console)
        out = None if result.out is None else str(result.out)
        found = {"out": out, "source": result.kind, **result.metrics, "notes": result.notes}
        return console.result(found, _query_lines(result))
    with tempfile.TemporaryDirectory() as folder:  # a table with a wrong line is refused before anything is printed
        answers = Path(folder) / "answers.csv"
        result = query(replace(request, out=answers), console)
        with answers.open(encoding="utf-8", newline="") as stream:
            shutil.copyfileobj(stream, sys.stdout)
    for line in _query_lines(replace(result, out=None)):
        console.log(line)
    return 0


def _query_lines(result: QueryResult) -> Iterator[str]:
    rows = [(name.replace("_", " "), _shown(name, value)) for name, value in result.metrics.items()]
    yield from table((result.kind, ""), rows)
    yield from (f"note: {note}" for note in result.notes)
    rate = (result.metrics["num_points"] or 0) / max(result.seconds["answer"], 1e-9)
    wrote = [] if result.out is None else [f"wrote {result.out}"]
    # a rate of fewer points says nothing
    yield from [*([f"{rate:,.0f} points/s"] if (result.metrics["num_points"] or 0) >= 1000 else []), *wrote]


def _shown(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if name.startswith("num_") else f"{value * 1e3:.1f} mm"


SHOWN = {  # of Differences: what the table calls it, and the unit it is shown in
    "center": ("centre mm", 1e3),
    "sigma": ("sigma %", 1e2),
    "rotation": ("rotation deg", 1.0),
    "color": ("colour of 255", 255.0),
    "opacity": ("opacity of 255", 255.0),
    "harmonics": ("harmonics", 1.0),
}


def run_export(args: argparse.Namespace) -> int:
    console = Console(args)
    if args.mcap:
        return _run_mcap(console, args)
    return show_exported(console, export(request_of(ExportRequest, args, labels=_labels(args.labels)), console))


def _run_mcap(console: Console, args: argparse.Namespace) -> int:
    for name in ("labels", "layout", "isotropic"):
        if getattr(args, name):
            raise UsageError(f"--{name}: not with --mcap", remedy="leave it out")
    result = export_run(request_of(ExportRunRequest, args, path=args.scene, roots=tuple(args.root)))
    rows = [(topic, count) for topic, count in result.messages.items()]
    return console.result(
        result.as_dict(), [f"{result.file}: {result.bytes} bytes", *table(("topic", "messages"), rows)]
    )


def show_exported(console: Console, result: ExportResult) -> int:
    return console.result(result.as_dict(), _export_lines(result))


def _labels(names: str | None) -> list[Label] | None:
    if names is None:
        return None
    known = {label.name.lower(): label for label in Label}
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise UsageError(f"--labels {names}: unknown label {unknown[0]!r}", remedy=f"known here: {', '.join(known)}")
    return [known[name] for name in chosen]


def _export_lines(result: ExportResult) -> Iterator[str]:
    left_out = f", {result.num_left_out} left out by label" if result.num_left_out else ""
    yield f"{result.file}: {result.num_splats} splats{left_out}, {result.bytes} bytes, {result.format}"
    if result.was_rounded:
        yield f"made isotropic: {_decibels(result.isotropic_psnr)} against the source"
    if result.origin is not None:
        yield f"centres are less the origin {result.origin} m: float32 would move them without"
    if result.not_kept:
        yield f"not kept: {', '.join(result.not_kept)}"
    if result.num_outside:
        yield f"{result.num_outside} splats have a size or colour beyond the format's range: put at its edge"
    found, allowed = vars(result.differences), vars(result.allowed)
    rows = [(name, f"{found[key] * unit:.3g}", f"{allowed[key] * unit:.3g}") for key, (name, unit) in SHOWN.items()]
    yield from table(["largest difference", "found", "allowed"], rows)
    yield (
        f"read back and rendered from {result.num_views_compared} views ({100 * result.covered_share:.0f} % of their"
        f" pixels covered): {_decibels(result.psnr)}, largest pixel difference {result.largest_pixel_difference:.2g}"
    )


def _decibels(psnr: float | None) -> str:
    return "the same" if psnr is None else f"PSNR {psnr:.1f} dB"


def labels_of(text: str) -> frozenset[Label]:
    """Labels in a field: objects and those of ``--include``. Raises UsageError for others."""
    names = () if text.strip() == "none" else names_of(text, ("robot", "human"), "--include")
    return frozenset({Label.OBJECT, *(Label[name.upper()] for name in names)})

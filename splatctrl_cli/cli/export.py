"""``splatctrl export``: splats in the formats that viewers open, read back and rendered before they count."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output, table
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.export import ExportRequest, ExportResult, export
from splatctrl_cli.records import Label
from splatctrl_cli.splat_files.splat_formats import FORMATS

SUFFIXES = ", ".join(FORMATS)
SHOWN = {  # of Differences: what the table calls it, and the unit it is shown in
    "center": ("centre mm", 1e3),
    "sigma": ("sigma %", 1e2),
    "rotation": ("rotation deg", 1.0),
    "color": ("colour of 255", 255.0),
    "opacity": ("opacity of 255", 255.0),
    "harmonics": ("harmonics", 1.0),
}


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "export", run)
    parser.add_argument("scene", type=Path, metavar="SCENE", help=f"a scene folder, or a splat file: {SUFFIXES}")
    parser.add_argument(
        "--labels",
        metavar="NAME,...",
        help="only splats of these labels: object, robot, human (default: all)",
    )
    parser.add_argument(
        "--layout",
        choices=["short", "full"],
        help="of a PLY: short has label and density and no harmonics, full has the reference's 62 properties "
        "(default: short for isotropic splats; for others full, and a label where one is not object)",
    )
    parser.add_argument(
        "--isotropic",
        action="store_true",
        help="make anisotropic Gaussians round: same volume, opacity and mean colour",
    )
    add_output(
        parser, default="SCENE.ply, beside SCENE", what=f"the file to write; its suffix is the format: {SUFFIXES}"
    )


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, same = Console(args), ("scene", "out", "layout", "isotropic", "force")
    request = ExportRequest(labels=_labels(args.labels), **{name: getattr(args, name) for name in same})
    result = export(request, console)
    console.result(result.as_dict(), _lines(result))
    return 0


def _labels(names: str | None) -> list[Label] | None:
    if names is None:
        return None
    known = {label.name.lower(): label for label in Label}
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise UsageError(f"--labels {names}: unknown label {unknown[0]!r}", remedy=f"known here: {', '.join(known)}")
    return [known[name] for name in chosen]


def _lines(result: ExportResult) -> Iterator[str]:
    left_out = f", {result.num_left_out} left out by label" if result.num_left_out else ""
    yield f"{result.file}: {result.num_splats} splats{left_out}, {result.bytes} bytes, {result.format}"
    if result.was_rounded:
        yield f"made isotropic: {_decibels(result.isotropic_psnr)} against the source"
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

"""``splatctrl export``: splats in the formats that viewers open, read back and rendered before they count."""

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output
from splatctrl_cli.cli.export_check import check, check_colors, compare, difference_table
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.files.output import output_path, sha256
from splatctrl_cli.records import GaussianSet, Label, SplatSet
from splatctrl_cli.splat_files.isotropic import as_gaussians, as_splats, nearest_splats
from splatctrl_cli.splat_files.splat_formats import FORMATS, REFERENCE_PLY, SplatFormat, format_of, read_splats
from splatctrl_cli.splat_files.splats import read_ply, write_ply

LAYOUT_COMMENTS = frozenset({"splat", "label"})  # say how a PLY holds its values: not true of the next file
SUFFIXES = ", ".join(FORMATS)


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
    source = _splat_file(args.scene)
    out = args.out or _beside(args.scene)
    kind = _format(out, args.layout)
    if os.path.realpath(out) == os.path.realpath(source):
        raise UsageError(f"{out}: is the input itself", remedy="give another --out")
    splats, comments = read_splats(source)
    check_colors(source, splats)
    selected = _select(splats, args.labels)
    if not len(selected):
        raise NotEvaluableError(f"{source}: no splat to write among {len(splats)}", remedy="give other --labels")
    chosen = _round(selected) if args.isotropic else selected
    _check_layout(args.layout, chosen, source)
    kept = {key: value for key, value in comments.items() if key not in LAYOUT_COMMENTS}
    name = source.name if source.name.isprintable() else ascii(source.name)
    with output_path(out, force=args.force, is_folder=False) as partial:
        back = _write(partial, kind, chosen, {**kept, "exported_from": f"{name} sha256 {sha256(source)}"})
        result = {
            "file": str(out),
            "format": kind.name,
            "bytes": partial.stat().st_size,
            "sha256": sha256(partial),
            "num_splats": len(chosen),
            "num_left_out": len(splats) - len(chosen),
            **check(out, kind, chosen, back),
            "isotropic_psnr": None if chosen is selected else compare(selected, chosen).psnr,
        }
    Console(args).result(result, _lines(result, was_rounded=chosen is not selected))
    return 0


def _lines(result: dict[str, Any], *, was_rounded: bool) -> list[str]:
    left_out = f", {result['num_left_out']} left out by label" if result["num_left_out"] else ""
    lines = [
        f"{result['file']}: {result['num_splats']} splats{left_out}, {result['bytes']} bytes, {result['format']}"
    ]
    if was_rounded:
        lines.append(f"made isotropic: {_decibels(result['isotropic_psnr'])} against the source")
    if result["not_kept"]:
        lines.append(f"not kept: {', '.join(result['not_kept'])}")
    if result["num_outside"]:
        lines.append(
            f"{result['num_outside']} splats have a size or colour beyond the format's range: put at its edge"
        )
    lines += difference_table(result["differences"], result["allowed"])
    lines.append(
        f"read back and rendered from {result['num_views_compared']} views ({100 * result['covered_share']:.0f} % of "
        f"their pixels covered): {_decibels(result['psnr'])}, largest pixel difference "
        f"{result['largest_pixel_difference']:.2g}"
    )
    return lines


def _decibels(psnr: float | None) -> str:
    return "the same" if psnr is None else f"PSNR {psnr:.1f} dB"


def _beside(scene: Path) -> Path:
    place = scene if scene.name.strip(".") else Path(os.path.realpath(scene))  # . and .. have no name of their own
    suffix = "" if scene.is_dir() else scene.suffix
    return place.with_name(f"{place.name.removesuffix(suffix)}.ply")


def _splat_file(scene: Path) -> Path:
    if not scene.exists():
        raise InputError(f"{scene}: no such scene", remedy="give a folder that reconstruct wrote, or a splat file")
    file = scene / "splats.ply" if scene.is_dir() else scene
    if not file.is_file():
        raise InputError(
            f"{scene}: has no splats.ply", remedy="give a folder that reconstruct wrote, or a splat file"
        )
    return file


def _format(out: Path, layout: str | None) -> "SplatFormat":
    kind = format_of(out)
    if layout is not None and kind is not FORMATS[".ply"]:
        raise UsageError(f"--layout {layout}: {out} is no PLY", remedy="leave it out")
    return REFERENCE_PLY if layout == "full" else kind


def _check_layout(layout: str | None, chosen: "SplatSet | GaussianSet", source: Path) -> None:
    if layout == "short" and isinstance(chosen, GaussianSet):
        raise UsageError(
            f"--layout short: expected isotropic splats, {source} has {len(chosen)} Gaussians that are not all so",
            remedy="give --isotropic, or --layout full",
        )


def _round(splats: "SplatSet | GaussianSet") -> "SplatSet | GaussianSet":
    """The nearest isotropic set; splats that are isotropic as they are."""
    return nearest_splats(splats) if isinstance(splats, GaussianSet) else splats


def _select(splats: "SplatSet | GaussianSet", names: str | None) -> "SplatSet | GaussianSet":
    if names is None:
        return splats
    known = {label.name.lower(): label for label in Label}
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise UsageError(f"--labels {names}: unknown label {unknown[0]!r}", remedy=f"known here: {', '.join(known)}")
    return splats.select(np.isin(splats.labels, [known[name] for name in chosen]))


def _write(
    partial: Path, kind: "SplatFormat", splats: "SplatSet | GaussianSet", comments: Mapping[str, str]
) -> "SplatSet | GaussianSet":
    """Write the splats and return what reads back; isotropic ones in a PLY keep their density."""
    if isinstance(splats, GaussianSet):
        kind.write(partial, splats, comments)
        return kind.read(partial)[0]
    if kind is FORMATS[".ply"]:
        write_ply(partial, splats, comments)
        return read_ply(partial)[0]
    kind.write(partial, as_gaussians(splats), comments)
    return as_splats(kind.read(partial)[0], str(partial))

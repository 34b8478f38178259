"""``splatctrl sdf-bake``: a scene's splats as a distance grid, and its accuracy where the truth is known."""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    configured,
    table,
)
from splatctrl_cli.cli.numbers import MAX_SECONDS, real, setting, words
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.field_accuracy import BandAccuracy
from splatctrl_cli.evaluate.field_truth import NEAR, TruthComparison
from splatctrl_cli.field.baker import CHANNELS, DEFAULT_CHANNELS
from splatctrl_cli.grid_files.grid_formats import FORMATS
from splatctrl_cli.jobs.bake import BakeResult, bake
from splatctrl_cli.jobs.bake_request import BakeRequest
from splatctrl_cli.records import Box, Label

SETTINGS = ("distance", "weights", "unknown", "probability", "voxel", "length_scale")  # of the field, as options
SAME = (
    *("scene", "at", "urdf", "spheres", "truth", "seen_by", "reference_mesh", "no_report", "update"),
    *("previous_scene", "resume", "force", "seed", "threads"),
)  # options that the request has by the same names
ERRORS = ("mean", "rmse", "over_95", "over_max")
COLUMNS = ("count", "mean mm", "rmse mm", "95 % mm", "max mm")


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "sdf-bake", run)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder that reconstruct wrote, or a splats.ply")
    add_output(parser, default="field", what="folder to write: the grid, field.json, report/, run.json")
    parser.add_argument(
        "--at",
        type=real(-MAX_SECONDS, MAX_SECONDS, "s"),
        metavar="SECONDS",
        help="the scene as known that long after its start",
    )
    parser.add_argument(
        "--include",
        default="human",
        metavar="NAME,...",
        help="labels in the field beside object: robot, human, or none (default: human; the robot is left out)",
    )
    _add_grid(parser)
    _add_field(parser)
    _add_truth(parser)
    _add_going_on(parser)
    add_config(parser)
    add_gates(parser)


def _add_grid(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="what the grid covers [m]; write --box=-1,... for a negative start"
    )
    parser.add_argument("--urdf", type=Path, help="cover the reach of this robot around its base, without --box")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its spheres (default: the URDF's own)")
    parser.add_argument("--voxel", type=setting(FieldConfig, "voxel"), metavar="M", help="cell size (field.voxel)")
    parser.add_argument(
        "--channels",
        metavar="NAME,...",
        help=f"what is baked beside sdf, of {', '.join(CHANNELS)} (default: {','.join(DEFAULT_CHANNELS)})",
    )
    parser.add_argument(
        "--formats", default="npz,vti", metavar="NAME,...", help=f"of {', '.join(FORMATS)} (default: npz,vti)"
    )


def _add_field(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--distance",
        choices=words(FieldConfig, "distance"),
        help="what sdf is: min(se, hard), min(gpdf, hard), the exact distance, either kernel field (field.distance)",
    )
    parser.add_argument(
        "--weights",
        choices=words(FieldConfig, "weights"),
        help="of the kernel field: row sums, voxels, the full GP (field.weights)",
    )
    parser.add_argument(
        "--length-scale",
        type=setting(FieldConfig, "length_scale"),
        metavar="M",
        help="l of the kernel (field.length_scale)",
    )
    parser.add_argument(
        "--unknown", choices=words(FieldConfig, "unknown"), help="what never-seen space counts as (field.unknown)"
    )
    parser.add_argument(
        "--probability",
        choices=words(FieldConfig, "probability"),
        help="bake the channel probability, of collision, in this form (field.probability)",
    )


def _add_truth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--truth", type=Path, metavar="truth.json", help="measure the field against this truth")
    parser.add_argument(
        "--seen-by", type=Path, metavar="LOG", help="the log or capture whose cameras saw the scene, for --truth"
    )
    parser.add_argument(
        "--reference-mesh", type=Path, metavar="FILE", help="measure the field against this mesh (world, metres)"
    )
    parser.add_argument(
        "--held-out",
        metavar="LOG[:CAMERA,...]",
        help="measure the field against depth of cameras that did not train; --urdf tells which pixels are robot",
    )
    parser.add_argument("--no-report", action="store_true", help="draw no pictures")


def _add_going_on(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--update", type=Path, metavar="FIELD", help="bake anew only what changed since that field folder was baked"
    )
    parser.add_argument(
        "--previous-scene", type=Path, metavar="SCENE", help="what --update's field was baked from (default: SCENE)"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on with a bake that was interrupted, to the same bytes"
    )


def _names_of(text: str, choices: Sequence[str], option: str) -> tuple[str, ...]:
    """The names in a list with commas. Raises UsageError for one that is no choice, or none at all."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in choices]
    if unknown or not names:
        raise UsageError(f"{option} {text}: expected some of: {', '.join(choices)}")
    return names


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, request = Console(args), _request(args)
    result = bake(request, console)
    console.log(f"baked in {result.seconds['bake']:.2f} s; wrote {result.out}")
    compared = result.accuracy.as_dict()
    printed = {**result.summary, **({"accuracy": compared} if compared else {})}
    console.concluded(result.verdict, printed, _lines(result), result.verdict.exit_code)
    return result.verdict.exit_code


def _request(args: argparse.Namespace) -> BakeRequest:
    config = configured(args)
    given = {name: getattr(args, name) for name in SETTINGS if getattr(args, name) is not None}
    log, cameras = (None, ()) if args.held_out is None else split_cameras(args.held_out)
    return BakeRequest(
        out=args.out or Path("field"),
        config=replace(config, field=replace(config.field, **given)),
        formats=_names_of(args.formats, tuple(FORMATS), "--formats"),
        labels=_labels_of(args.include),
        box=None if args.box is None else Box.from_text(args.box),
        channels=None if args.channels is None else _names_of(args.channels, tuple(CHANNELS), "--channels"),
        with_probability=args.probability is not None,
        held_out=log,
        held_out_cameras=cameras,
        require=tuple(args.require),
        **{name: getattr(args, name) for name in SAME},
    )


def _labels_of(text: str) -> frozenset[Label]:
    """The labels in the field: objects, and those that --include names."""
    names = () if text.strip() == "none" else _names_of(text, ("robot", "human"), "--include")
    return frozenset({Label.OBJECT, *(Label[name.upper()] for name in names)})


def split_cameras(text: str) -> tuple[Path, tuple[str, ...]]:
    """The log and the cameras of ``LOG:camera,...``; none named means every one that did not train."""
    path, colon, cameras = text.rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in cameras.split(",") if name.strip())


def _lines(result: BakeResult) -> list[str]:
    """The summary, and a table for each thing that the field was compared with."""
    rows = [(name.replace("_", " "), _shown(value)) for name, value in result.summary.items()]
    lines = table(("field", ""), rows)
    truth, mesh, held_out = result.accuracy.truth, result.accuracy.reference_mesh, result.accuracy.held_out_depth
    if truth is not None:
        lines += ["", *_truth_lines(truth)]
    if mesh is not None:
        cells = [(name, _band(band), *_errors(band)) for name, band in _each(mesh.accuracy.everywhere)]
        lines += ["", *table(("field", "from mesh cm", *COLUMNS), cells)]
    if held_out is not None:
        note = "before it: points whose ball up to it was seen to be free"
        lines += ["", f"held-out depth of {held_out.num_frames} frames; {note}"]
        places = {name: [("on it", band)] for name, band in held_out.on_surface.items()}
        for name, band in _each(held_out.before.seen):
            places[name].append((_band(band), band))
        cells = [(name, place, *_errors(band)) for name, bands in places.items() for place, band in bands]
        lines += table(("field", "from depth cm", *COLUMNS), cells)
    return lines


def _truth_lines(compared: TruthComparison) -> list[str]:
    """The table by band, and whether the exact distance keeps to its allowance."""
    accuracy, figures = compared.accuracy, ("mean", "rmse", "median", "over_95", "over_max")
    rows = [
        (where, name, _band(band), *_errors(band, figures))
        for where, fields in (("seen", accuracy.seen), ("all", accuracy.everywhere))
        for name, band in _each(fields)
    ]
    over = accuracy.over_estimate
    verdict = (
        f"hard exceeds the truth by more than {over.allowance * 1e3:.1f} mm at {over.count_beyond} of {over.count} "
        "seen cells"
    )
    if over.median_beyond is not None and over.max_error is not None:
        verdict += (
            f": in the median by {over.median_beyond * 1e3:.1f} mm more than that; "
            f"the largest error is {over.max_error * 1e3:.1f} mm"
        )
    if compared.num_outside_workspace:
        verdict += f"; {compared.num_outside_workspace} cells before seen surfaces outside the workspace do not count"
    expected = [
        f"probability, {name}: calibration error {curve.calibration_error:.3f} at seen cells"
        for name, curve in compared.reliability.items()
    ]
    if compared.error_mean is not None and compared.error_sigma:
        mean, sigma = compared.error_mean, compared.error_sigma
        expected.append(
            f"within {NEAR * 100:g} cm of seen surfaces sdf errs by {mean * 1e3:.1f} +- {sigma * 1e3:.1f} mm: "
            f"calibrate the probability with --set field.error_mean={mean:.4f} --set field.error={sigma:.4f}"
        )
    return [
        "error = field - truth, positive where clearance is over-estimated",
        *table(("cells", "field", "true cm", *COLUMNS[:3], "median mm", *COLUMNS[3:]), rows),
        "seen: cells whose nearest true surface a camera saw; all: also those before backs that none saw",
        verdict,
        *expected,
    ]


def _each(fields: Mapping[str, Iterable[BandAccuracy]]) -> Iterator[tuple[str, BandAccuracy]]:
    return ((name, band) for name, bands in fields.items() for band in bands)


def _band(band: BandAccuracy) -> str:
    return f"{band.lower * 100:g}-{band.upper * 100:g}"


def _errors(band: BandAccuracy, figures: Sequence[str] = ERRORS) -> list[object]:
    """The count, and the errors [mm]."""
    values = (getattr(band, name) for name in figures)
    return [band.count, *("-" if value is None else f"{value * 1e3:.1f}" for value in values)]


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return " x ".join(map(str, value)) if isinstance(value, list) else str(value)

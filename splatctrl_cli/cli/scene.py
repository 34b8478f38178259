"""``splatctrl reconstruct``, ``sdf-bake``: a log into splats, and splats as a distance grid."""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.cli.common import Console, format_cell, names_of, request_of, source_options, table
from splatctrl_cli.cli.export import labels_of
from splatctrl_cli.config import load_config
from splatctrl_cli.config.fixed import PROBABILITY_NEAR
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.field_accuracy import BandAccuracy, TruthComparison
from splatctrl_cli.formats.grid.grid_format import CHANNELS
from splatctrl_cli.formats.grid.grid_formats import FORMATS
from splatctrl_cli.jobs.bake.bake import BakeResult, bake
from splatctrl_cli.jobs.bake.request import BakeRequest
from splatctrl_cli.jobs.reconstruct.correct_views import Corrections
from splatctrl_cli.jobs.reconstruct.reconstruct import ReconstructResult, reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.running.device import shown
from splatctrl_cli.jobs.running.resume import DECIDING_OPTIONS
from splatctrl_cli.kernels import native
from splatctrl_cli.records import Box


def run_reconstruct(args: argparse.Namespace) -> int:
    native.keep_freed_memory()
    config = load_config(args.config, args.set)  # refused before the source is opened
    if args.max_splats is not None:
        config = replace(config, scene=replace(config.scene, max_splats=args.max_splats))
    if (args.source is None) == (args.dtu is None):
        raise UsageError("reconstruct: expected a SOURCE or --dtu ROOT, and not both")
    allowed = {"views-agreement", "views-scale"} if args.allow_disagreement or args.refine_poses else set()
    source = open_to_train(
        recording_of(args, args.source),
        max_pose_jump=args.max_pose_jump,
        needs_depth=args.points is None,
        allowed=allowed | ({"alignment"} if args.allow_disagreement else set()),
    )
    request = request_of(
        ReconstructRequest,
        args,
        config=config,
        source=source,
        recording=args.source,
        out=args.out or Path("scene"),
        box=None if args.box is None else Box.from_text(args.box),
        corrections=Corrections(poses=args.refine_poses, exposure=args.refine_exposure),
        options={name: getattr(args, name) for name in DECIDING_OPTIONS},
    )
    console = Console(args)
    return show_reconstructed(console, reconstruct(request, console))


def recording_of(args: argparse.Namespace, path: Path, masks: Path | None = None) -> RecordingRequest:
    """The recording at `path`, or at --dtu."""
    is_dtu = args.dtu is not None
    given = {"path": args.dtu or path, "is_dtu": is_dtu, "options": source_options(args), "masks": masks}
    return request_of(RecordingRequest, args, **given)


def show_reconstructed(console: Console, result: ReconstructResult) -> int:
    found = {"scene": str(result.out), "metrics": result.metrics, "removed": result.removed}
    return console.concluded(result.verdict, found, [*_scene_lines(result), f"wrote {result.out}"])


def _scene_lines(result: ReconstructResult) -> list[str]:
    metrics, removed = result.metrics, result.removed
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
        f"removed: {', '.join(reasons) or 'none'}",
        f"computed on {', then '.join(map(shown, metrics['devices']))}",
    ]


SETTINGS = ("distance", "weights", "unknown", "probability", "voxel", "length_scale")  # of the field, as options
ERRORS = ("mean", "rmse", "over_95", "over_max")
COLUMNS = ("count", "mean mm", "rmse mm", "95 % mm", "max mm")


def run_bake(args: argparse.Namespace) -> int:
    console = Console(args)
    return show_baked(console, bake(_request(args), console))


def show_baked(console: Console, result: BakeResult) -> int:
    console.log(f"baked in {result.seconds['bake']:.2f} s; wrote {result.out}")
    compared = result.accuracy.as_dict()
    printed = {**result.summary, **({"accuracy": compared} if compared else {})}
    return console.concluded(result.verdict, printed, _bake_lines(result))


def _request(args: argparse.Namespace) -> BakeRequest:
    config = load_config(args.config, args.set)
    given = {name: getattr(args, name) for name in SETTINGS if getattr(args, name) is not None}
    log, cameras = (None, ()) if args.held_out is None else split_cameras(args.held_out)
    return request_of(
        BakeRequest,
        args,
        out=args.out or Path("field"),
        config=replace(config, field=replace(config.field, **given)),
        formats=names_of(args.formats, FORMATS, "--formats"),
        labels=labels_of(args.include),
        box=None if args.box is None else Box.from_text(args.box),
        channels=None if args.channels is None else names_of(args.channels, CHANNELS, "--channels"),
        with_probability=args.probability is not None,
        held_out=log,
        held_out_cameras=cameras,
    )


def split_cameras(text: str) -> tuple[Path, tuple[str, ...]]:
    """Log and cameras of ``LOG:camera,...``; none means all that did not train."""
    path, colon, cameras = text.rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in cameras.split(",") if name.strip())


def _bake_lines(result: BakeResult) -> Iterator[str]:
    shown_values = {**result.summary, "shape": " x ".join(map(str, result.summary["shape"]))}
    rows = [(name.replace("_", " "), format_cell(value)) for name, value in shown_values.items()]
    yield from table(("field", ""), rows)
    truth, mesh, held_out = result.accuracy.truth, result.accuracy.reference_mesh, result.accuracy.held_out_depth
    if truth is not None:
        yield from ("", *_truth_lines(truth))
    if mesh is not None:
        cells = [(name, _band(band), *_errors(band)) for name, band in _each(mesh.accuracy.everywhere)]
        yield from ("", *table(("field", "from mesh cm", *COLUMNS), cells))
    if held_out is not None:
        note = "before it: points whose ball up to it was seen to be free"
        yield from ("", f"held-out depth of {held_out.num_frames} frames; {note}")
        places = {name: [("on it", band)] for name, band in held_out.on_surface.items()}
        for name, band in _each(held_out.before.seen):
            places[name].append((_band(band), band))
        cells = [(name, place, *_errors(band)) for name, bands in places.items() for place, band in bands]
        yield from table(("field", "from depth cm", *COLUMNS), cells)


def _truth_lines(compared: TruthComparison) -> list[str]:
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
            f"within {PROBABILITY_NEAR * 100:g} cm of seen surfaces sdf errs by {mean * 1e3:.1f} +- "
            f"{sigma * 1e3:.1f} mm: calibrate the probability with --set "
            f"field.error_mean={mean:.4f} --set field.error={sigma:.4f}"
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
    """Count and errors [mm]."""
    values = (getattr(band, name) for name in figures)
    return [band.count, *("-" if value is None else f"{value * 1e3:.1f}" for value in values)]

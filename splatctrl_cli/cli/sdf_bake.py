"""``splatctrl sdf-bake``: a scene's splats as a distance grid, and its accuracy where the truth is known."""

import argparse
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.cli.bake_options import (
    DEFAULT_CHANNELS,
    FORMATS,
    add_options,
    box_of,
    channels_of,
    labels_of,
    names_of,
    with_options,
)
from splatctrl_cli.cli.bake_report import (
    FieldReport,
    bake_verdict,
    metric_names,
    metrics,
    reference_lines,
    summary_lines,
    warnings_of,
    write_pictures,
)
from splatctrl_cli.cli.bake_run import CHECKPOINT, FOLDER, BakeTask, bake_to_disk, clear_leftovers
from splatctrl_cli.cli.bake_source import BakeSource, read_bake_source
from splatctrl_cli.cli.bake_update import Previous, check_same, read_previous
from splatctrl_cli.cli.common import Console, Subparsers, add_command, configured
from splatctrl_cli.cli.field_held_out import compare_with_held_out, held_out_cameras, held_out_lines
from splatctrl_cli.cli.field_truth import accuracy_lines, compare_with_truth
from splatctrl_cli.config import Config
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.gates import check_gate_names
from splatctrl_cli.evaluate.reference_mesh import compare_with_mesh
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.header import field_header
from splatctrl_cli.field.incremental import Changes, changed_blocks, counts_after
from splatctrl_cli.field.layout import GridLayout
from splatctrl_cli.field.obstacles import obstacle_spheres
from splatctrl_cli.field.probability import probabilities
from splatctrl_cli.field.report import grid_statistics
from splatctrl_cli.field.slabs import Kept, UnknownSpace, slabs
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_json, write_run
from splatctrl_cli.grid_files.grid_formats import check_formats, write_grid
from splatctrl_cli.jobs.resume import deciding_versions, told_how_to_go_on
from splatctrl_cli.records import DistanceGrid, Label, SplatSet


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    add_options(add_command(subparsers, "sdf-bake", run))


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    console, stopwatch, config = Console(args), Stopwatch(), with_options(configured(args), args)
    formats, labels = names_of(args.formats, FORMATS, "--formats"), labels_of(args.include)
    _check_options(args)
    check_gate_names(args.require, metric_names(with_truth=args.truth is not None))
    out = args.out or Path("field")
    checkpoint = partial_path(out) / CHECKPOINT
    _tell_of_partial(args, checkpoint, console)
    with (
        told_how_to_go_on(checkpoint),
        output_path(out, force=args.force, is_folder=True, checkpoint=CHECKPOINT, resume=args.resume) as partial,
    ):
        job = _read(args, config, formats, labels, stopwatch)
        clear_leftovers(partial)
        report, lines = _bake(job, args, partial, console, stopwatch)
        result = report.summary() | ({"accuracy": report.accuracy} if report.accuracy else {})
        truth = None if report.accuracy is None else report.accuracy.get("truth")
        figures = metrics(result, truth)
        has_occupancy = job.source.occupancy is not None
        verdict = bake_verdict(report, config.field.max_loss, args.require, figures, has_occupancy=has_occupancy)
        _remove(partial / FOLDER)
        write_run(
            partial,
            command="sdf-bake",
            config=config.as_dict(),
            inputs=job.source.digests | ({} if job.previous is None else job.previous.digests),
            metrics=figures,
            stopwatch=stopwatch,
            seed=args.seed,
            verdict=verdict.as_dict(),
        )
    console.log(f"baked in {stopwatch.seconds['bake']:.2f} s; wrote {out}")
    console.concluded(verdict, result, lines, verdict.exit_code)
    return verdict.exit_code


@dataclass(frozen=True, kw_only=True)
class _Job:
    """What was read, and what is to be made of it; chosen: the spheres of the field, splats and then
    balls around unrepresented voxels.
    """

    config: "Config"
    source: "BakeSource"
    previous: "Previous | None"
    chosen: "SplatSet"
    num_unrepresented: int
    labels: "frozenset[Label]"
    formats: tuple[str, ...]
    baker: "Baker"

    @property
    def label_names(self) -> list[str]:
        """As the header has them."""
        return sorted(label.name.lower() for label in self.labels)


def _check_options(args: argparse.Namespace) -> None:
    if (args.truth is None) != (args.seen_by is None):
        raise UsageError("--truth and --seen-by: expected both or neither")
    if args.previous_scene is not None and args.update is None:
        raise UsageError("--previous-scene: belongs to --update", remedy="give the field folder to --update as well")


def _check_references(args: argparse.Namespace, source: "BakeSource") -> None:
    """Raise for what cannot be compared with, before a bake that may take long."""
    for path in (args.truth, args.seen_by, args.reference_mesh):
        if path is not None and not path.exists():
            raise InputError(f"{path}: no such file or folder", remedy="check the path")
    if args.held_out is not None:
        held_out_cameras(args.held_out, source.cameras)


def _tell_of_partial(args: argparse.Namespace, checkpoint: Path, console: Console) -> None:
    partial = checkpoint.parent.parent
    if args.resume and not checkpoint.is_file():
        console.log(f"{partial}: nothing to go on from; starts at the beginning")
    elif checkpoint.is_file() and not args.resume:
        console.log(f"warning: {partial}: an interrupted bake is replaced; --resume would have gone on with it")


def _read(
    args: argparse.Namespace,
    config: "Config",
    formats: tuple[str, ...],
    labels: "frozenset[Label]",
    stopwatch: "Stopwatch",
) -> _Job:
    """Read the splats, and check that the field can be made of them and written."""
    with stopwatch.stage("read"):
        source = read_bake_source(args.scene, args.at)
        previous = None if args.update is None else read_previous(args.update, args.previous_scene or args.scene)
    obstacles = obstacle_spheres(source.splats, source.unrepresented, labels)
    chosen = obstacles.splats
    channels = channels_of(
        args, DEFAULT_CHANNELS if previous is None else tuple(previous.grid.channels), config.field.unknown
    )
    _check_references(args, source)
    check_formats(formats, channels, unknown=config.field.unknown)
    has_box = previous is None or args.box is not None or args.urdf is not None
    box = box_of(args, source.splats, labels, config.field.padding) if has_box or previous is None else previous.box
    layout = GridLayout.over(box, config.field.voxel)
    if previous is not None:
        check_same(previous, layout, config.field, channels, sorted(label.name.lower() for label in labels))
    with stopwatch.stage("bake"):
        baker = Baker(
            chosen,
            layout,
            config.field,
            channels=channels,
            occupancy=source.occupancy,
            thresholds=config.occupancy,
            threads=args.threads,
        )
    return _Job(
        config=config,
        source=source,
        previous=previous,
        chosen=chosen,
        num_unrepresented=obstacles.num_unrepresented,
        labels=labels,
        formats=formats,
        baker=baker,
    )


def _bake(
    job: _Job, args: argparse.Namespace, partial: Path, console: Console, stopwatch: "Stopwatch"
) -> tuple["FieldReport", list[str]]:
    """Bake, compare, and write all but ``run.json``; returns the report and what is printed."""
    with stopwatch.stage("bake"):
        grid, changes = _baked(job, args, partial, console)
    with stopwatch.stage("report"):
        statistics = grid_statistics(grid)
        warnings = warnings_of(grid.header, statistics)
    with stopwatch.stage("write"):
        write_grid(partial, grid, job.formats)
    report = FieldReport(grid=grid, statistics=statistics, warnings=warnings, changes=changes)
    lines = summary_lines(report.summary())
    with stopwatch.stage("accuracy"):
        report, compared_lines = _compared(report, job, args)
        lines += compared_lines
    with stopwatch.stage("report"):
        write_json(partial / "field.json", report.as_dict())
        if not args.no_report:
            write_pictures(partial, report, _middle(job))
    return report, lines


def _baked(
    job: _Job, args: argparse.Namespace, partial: Path, console: Console
) -> tuple["DistanceGrid", "Changes | None"]:
    """The grid, its channels on disk."""
    baker = job.baker
    task, changes, old = _task(job, args)
    if changes is not None and changes.reason:
        console.log(f"--update: every block is baked anew: {changes.reason}")
    store = bake_to_disk(task, partial, console, resume=args.resume)
    if task.kept is not None and old is not None and job.previous is not None:
        counts: Any = job.previous.grid.header["kernel_counts"]
        ranges = list(slabs(baker.layout, baker.channels))
        baker.counts = counts_after(counts, old, baker, task.kept.mask, ranges)
    header = field_header(
        job.source.splats,
        job.chosen,
        job.labels,
        baker,
        has_occupancy=job.source.occupancy is not None,
        num_unrepresented=job.num_unrepresented,
    )
    treated = {} if task.unknown is None else task.unknown.header()
    place = {"digests": job.source.digests, "stamp_ns": job.source.stamp_ns}
    return store.grid({**header, **treated, **place}), changes


def _task(job: _Job, args: argparse.Namespace) -> tuple["BakeTask", "Changes | None", "Baker | None"]:
    """What has to be baked; with --update also what changed, and the baker of the splats before."""
    settings = {
        **deciding_versions(),
        **{f"field.{name}": value for name, value in asdict(job.config.field).items()},
        **{f"occupancy.{name}": value for name, value in asdict(job.config.occupancy).items()},
        **{f"sha256 of {name}": value for name, value in job.source.digests.items()},
        "labels": ",".join(job.label_names),
    }
    if job.previous is None:
        task = BakeTask(baker=job.baker, settings=settings, unknown=_unknown(job), formats=job.formats)
        return task, None, None
    settings |= {f"sha256 of {name}": value for name, value in job.previous.digests.items()}
    past = job.previous.source
    before = obstacle_spheres(past.splats, past.unrepresented, job.labels).splats
    needed = [name for name in ("sdf", "se", "gpdf") if name in job.baker.channels]
    old = Baker(before, job.baker.layout, job.config.field, channels=needed, threads=args.threads)
    changes = changed_blocks(before, old, job.chosen, job.baker)
    kept = None
    if changes.mask is not None:
        kept = Kept(
            grid=job.previous.grid,
            mask=changes.mask,
            occupancy=job.source.occupancy,
            thresholds=job.config.occupancy,
        )
    task = BakeTask(baker=job.baker, settings=settings, kept=kept, unknown=_unknown(job), formats=job.formats)
    return task, changes, old


def _unknown(job: _Job) -> "UnknownSpace | None":
    if job.config.field.unknown == "free":
        return None
    return UnknownSpace(job.baker.layout, job.config.field, job.source.occupancy, job.config.occupancy)


def _compared(report: "FieldReport", job: _Job, args: argparse.Namespace) -> tuple["FieldReport", list[str]]:
    """The report with the accuracy against all that options name, and the tables of it."""
    grid, curves = report.grid, {}
    found: dict[str, Any] = {}
    lines: list[str] = []
    if args.truth is not None:
        forms = probabilities(job.baker.spheres, job.config.field, threads=args.threads)
        compared = compare_with_truth(grid, job.source, args.truth, args.seen_by, seed=args.seed, probabilities=forms)
        found["truth"], curves = compared.as_dict(), dict(compared.reliability)
        lines += ["", *accuracy_lines(compared)]
    if args.reference_mesh is not None:
        mesh = compare_with_mesh(grid, args.reference_mesh, seed=args.seed)
        found["reference_mesh"] = {"file": args.reference_mesh.name, **mesh.as_dict()}
        lines += ["", *reference_lines(mesh.accuracy, "mesh")]
    if args.held_out is not None:
        held_out = compare_with_held_out(grid, job.source, args)
        found["held_out_depth"] = held_out.as_dict()
        lines += ["", *held_out_lines(held_out)]
    return replace(report, accuracy=found or None, reliability=curves), lines


def _middle(job: _Job) -> list[float]:
    """Where slices are shown: in the middle of the splats in the grid but for the outermost, or of the grid [m]."""
    box = job.baker.layout.box
    inside = job.chosen.centers[box.contains(job.chosen.centers)]
    lower, upper = np.percentile(inside, (5, 95), axis=0) if len(inside) else (box.lower, box.upper)
    middle = 0.5 * (lower + upper)
    return [float(value) for value in middle]


def _remove(folder: Path) -> None:
    shutil.rmtree(folder)

"""A bake from its request to its result: a scene's splats as a distance grid, compared with what is known of it."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import FAR_GRID
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate import field_accuracy
from splatctrl_cli.evaluate.field_accuracy import FIELDS
from splatctrl_cli.evaluate.gates import check_gate_names, gate_reasons
from splatctrl_cli.evaluate.metrics import BAD_SHARE, DESCRIBES, FAULTS, LENGTH
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, brief, noted, verdict_of
from splatctrl_cli.field.baker import CHANNELS, DEFAULT_CHANNELS, Baker
from splatctrl_cli.field.distance import KERNEL_OF
from splatctrl_cli.field.grid_cells import LOSS, GridLayout, check_loss
from splatctrl_cli.field.header import field_header
from splatctrl_cli.field.incremental import Changes, changed_blocks, counts_after
from splatctrl_cli.field.obstacles import ObstacleSpheres, obstacle_spheres
from splatctrl_cli.field.report import GridStatistics, grid_statistics
from splatctrl_cli.field.slabs import Kept, UnknownSpace, slabs
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, write_json, write_run
from splatctrl_cli.formats.grid.grid_formats import check_formats, write_grid
from splatctrl_cli.jobs.bake.accuracy import Accuracy, accuracy_of, check_references
from splatctrl_cli.jobs.bake.request import (
    BakeRequest,
    BakeSource,
    Previous,
    check_same,
    covered,
    device_for,
    read_bake_source,
    read_previous,
)
from splatctrl_cli.jobs.bake.slabs import CHECKPOINT, FOLDER, BakeTask, bake_to_disk, clear_leftovers
from splatctrl_cli.jobs.running.device import Device, named
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.running.resume import deciding_versions, told_how_to_go_on
from splatctrl_cli.kernels.cuda.memory import DeviceError
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.report.field_pictures import gradient_picture, probability_picture, slices_picture
from splatctrl_cli.report.reliability import reliability_picture

SUMMARY_METRICS = {
    **dict.fromkeys(("num_splats", "num_splats_left_out", "num_cells"), DESCRIBES),
    **dict.fromkeys(("voxel", "length_scale", "median_radius", "median_spacing"), LENGTH),
    **dict.fromkeys(("never_seen_share", "over_estimating_share"), BAD_SHARE),
    "num_warnings": FAULTS,
}  # and how two runs are compared by them
EXACT = frozenset({"bound", "hard"})


@dataclass(frozen=True, kw_only=True)
class BakeResult:
    """The field folder `out`; summary: what a person wants to know of the field; metrics: the figures that a gate can
    name, as in ``run.json``, whose counts of cells the verdict has. seconds: of each stage.
    """

    __repr__ = brief

    out: Path
    summary: Mapping[str, Any]
    accuracy: Accuracy
    metrics: Mapping[str, float | None]
    verdict: Verdict
    seconds: Mapping[str, float]


def bake(request: BakeRequest, progress: Progress = SILENT) -> BakeResult:
    """Bake into the output folder, or go on with what an interrupted bake left of it.

    Raises SplatCtrlError for what cannot be baked, compared with or written.
    """
    check_request(request)
    stopwatch, out = Stopwatch(), request.out
    checkpoint = partial_path(out) / CHECKPOINT
    _tell_of_partial(request, checkpoint, progress)
    with (
        told_how_to_go_on(checkpoint),
        output_path(
            out, force=request.force, is_folder=True, checkpoint=CHECKPOINT, resume=request.resume
        ) as partial,
    ):
        job = _read(request, stopwatch, progress)
        clear_leftovers(partial)
        with stopwatch.stage("bake"):
            try:
                grid, changes = _baked(job, partial, progress)
            except DeviceError as error:
                raise named(error, job.device, checkpoint) from error
            finally:
                job.baker.close()
        with stopwatch.stage("report"):
            report = FieldReport(grid=grid, statistics=grid_statistics(grid), changes=changes)
        with stopwatch.stage("write"):
            write_grid(partial, grid, request.formats)
        with stopwatch.stage("accuracy"):
            accuracy = accuracy_of(grid, job.baker.spheres, job.source, request)
        with stopwatch.stage("report"):
            compared = accuracy.as_dict()
            write_json(partial / "field.json", report.as_dict() | ({"accuracy": compared} if compared else {}))
            if not request.no_report:
                _draw(partial / "report", report, accuracy, _middle(job))
        summary = report.summary()
        metrics = metrics_of(summary, accuracy)
        verdict = _verdict(request, report, metrics, has_occupancy=job.source.occupancy is not None)
        shutil.rmtree(partial / FOLDER)
        write_run(
            partial,
            command="sdf-bake",
            config=request.config.as_dict(),
            inputs=job.digests,
            metrics={**metrics, "devices": [job.device.as_dict()]},
            stopwatch=stopwatch,
            seed=request.seed,
            verdict=verdict.as_dict(),
        )
    return BakeResult(
        out=out, summary=summary, accuracy=accuracy, metrics=metrics, verdict=verdict, seconds=stopwatch.seconds
    )


def check_request(request: BakeRequest) -> None:
    """Raise UsageError for cells that are too coarse, options that belong together, and gates on unknown figures."""
    check_loss(request.config.field.voxel, request.config.field.max_loss)
    if (request.truth is None) != (request.seen_by is None):
        raise UsageError("--truth and --seen-by: expected both or neither")
    if request.previous_scene is not None and request.update is None:
        raise UsageError("--previous-scene: belongs to --update", remedy="give the field folder to --update as well")
    of_truth = () if request.truth is None else field_accuracy.metric_names(FIELDS)
    check_gate_names(request.require, (*SUMMARY_METRICS, *of_truth))


def _tell_of_partial(request: BakeRequest, checkpoint: Path, progress: Progress) -> None:
    partial = checkpoint.parent.parent
    if request.resume and not checkpoint.is_file():
        progress.log(f"{partial}: nothing to continue from; starts at the beginning")
    elif checkpoint.is_file() and not request.resume:
        progress.log(f"warning: {partial}: an interrupted bake is replaced; --resume would have continued it")


@dataclass(frozen=True, kw_only=True)
class _Job:
    """What was read, and what is to be baked of it."""

    request: BakeRequest
    source: BakeSource
    previous: Previous | None
    obstacles: ObstacleSpheres
    device: Device
    baker: Baker

    @property
    def digests(self) -> dict[str, str]:
        """sha256 of every file that was read."""
        return self.source.digests | ({} if self.previous is None else self.previous.digests)


def _read(request: BakeRequest, stopwatch: Stopwatch, progress: Progress) -> _Job:
    """Read the splats, and check that the field can be made of them and written."""
    config, previous = request.config, None
    with stopwatch.stage("read"):
        source = read_bake_source(request.scene, request.at)
        if request.update is not None:
            previous = read_previous(request.update, request.previous_scene or request.scene)
    obstacles = obstacle_spheres(source.splats, source.unrepresented, request.labels)
    channels = _channels(request, previous)
    check_references(request, source)
    check_formats(request.formats, channels, unknown=config.field.unknown)
    layout = GridLayout.over(covered(request, source, previous), config.field.voxel)
    if previous is not None:
        check_same(previous, layout, config.field, channels, request.label_names)
    with stopwatch.stage("bake"):
        device = device_for(request, layout, len(obstacles.splats.radii), progress)
        baker = Baker(
            obstacles.splats,
            layout,
            config.field,
            channels=channels,
            occupancy=source.occupancy,
            thresholds=config.occupancy,
            threads=request.threads,
            device=device.memory,
        )
    return _Job(request=request, source=source, previous=previous, obstacles=obstacles, device=device, baker=baker)


def _channels(request: BakeRequest, previous: Previous | None) -> tuple[str, ...]:
    """The channels to bake, in their order. Raises UsageError where another one is needed for what is asked."""
    usual = DEFAULT_CHANNELS if previous is None else tuple(previous.grid.channels)
    names = {"sdf", *(usual if request.channels is None else request.channels)}
    names |= {"probability"} if request.with_probability else set()
    chosen = (*(name for name in CHANNELS if name in names), *sorted(names - set(CHANNELS)))
    for option in ("truth", "reference_mesh", "held_out"):
        if getattr(request, option) is not None and not EXACT & names:
            raise UsageError(
                f"--{option.replace('_', '-')}: needs the exact distance",
                remedy="bake the channel bound or hard as well",
            )
    unknown = request.config.field.unknown
    if unknown != "free" and "observed" not in names:
        raise UsageError(
            f"field.unknown = {unknown}: needs to know which cells were seen",
            remedy="bake the channel observed as well",
        )
    return chosen


def _baked(job: _Job, partial: Path, progress: Progress) -> tuple[DistanceGrid, Changes | None]:
    """The grid, its channels on disk; of an update, also what changed."""
    baker, previous, source, config = job.baker, job.previous, job.source, job.request.config
    changes = kept = old = None
    if previous is not None:
        before = obstacle_spheres(previous.source.splats, previous.source.unrepresented, job.request.labels).splats
        needed = [name for name in ("sdf", "se", "gpdf") if name in baker.channels]
        old = Baker(before, baker.layout, config.field, channels=needed, threads=job.request.threads)
        changes = changed_blocks(before, old, job.obstacles.splats, baker)
        if changes.reason:
            progress.log(f"--update: every block is baked anew: {changes.reason}")
        if changes.mask is not None:
            kept = Kept(
                grid=previous.grid, mask=changes.mask, occupancy=source.occupancy, thresholds=config.occupancy
            )
    unknown = None
    if config.field.unknown != "free":
        unknown = UnknownSpace(baker.layout, config.field, source.occupancy, config.occupancy)
    task = BakeTask(baker=baker, settings=_settings(job), kept=kept, unknown=unknown, formats=job.request.formats)
    store = bake_to_disk(task, partial, progress, resume=job.request.resume)
    if kept is not None and old is not None and previous is not None:
        counts: Any = previous.grid.header["kernel_counts"]
        baker.counts = counts_after(counts, old, baker, kept.mask, list(slabs(baker.layout, baker.channels)))
    header = field_header(
        source.splats,
        job.obstacles.splats,
        job.request.labels,
        baker,
        has_occupancy=source.occupancy is not None,
        num_unrepresented=job.obstacles.num_unrepresented,
    )
    treated = {} if unknown is None else unknown.header()
    made = {"digests": source.digests, "stamp_ns": source.stamp_ns, "made_from": source.made_from}
    return store.grid({**header, **treated, **made}), changes


def _settings(job: _Job) -> dict[str, Any]:
    """Everything that decides the bytes beside the grid and its channels."""
    config = job.request.config
    return {
        **deciding_versions(),
        **{f"field.{name}": value for name, value in asdict(config.field).items()},
        **{f"occupancy.{name}": value for name, value in asdict(config.occupancy).items()},
        **{f"sha256 of {name}": value for name, value in job.digests.items()},
        "labels": ",".join(job.request.label_names),
        **({} if job.device.card is None else {"card": job.device.card.name}),
    }


@dataclass(frozen=True, kw_only=True)
class FieldReport:
    """A baked grid with its statistics, and what an update changed."""

    grid: DistanceGrid
    statistics: GridStatistics
    changes: Changes | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those on the splats' health, and on a box that no splat is near."""
        health, lowest = self.grid.header["health"], self.statistics.lowest
        assert isinstance(health, dict)
        if lowest is None or lowest <= FAR_GRID:
            return tuple(health["warnings"])
        far = f"the box holds no splat: the nearest is {lowest:.3g} m from every cell; check --box"
        return (*health["warnings"], far)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as written to ``field.json``: the grid's header and place first."""
        grid, changes, update = self.grid, self.changes, {}
        if changes is not None:
            why = {"why_all": changes.reason} if changes.reason else {}
            update = {"update": {"blocks_baked": changes.num_baked, "blocks": changes.num_blocks, **why}}
        return {
            **grid.header,
            "shape": grid.channels["sdf"].shape,
            "first_cell": grid.origin,
            "voxel": grid.voxel,
            "channels": list(grid.channels),
            "statistics": self.statistics.as_dict(),
            "warnings": self.warnings,
            **update,
        }

    def summary(self) -> dict[str, Any]:
        """What is printed, and what --json has beside the accuracy."""
        header: Mapping[str, Any] = self.grid.header
        num_used, health = sum(header["splats_used"].values()), header["health"]
        # cells where the kernel field of sdf, alone, exceeds the exact distance
        over = header["kernel_counts"].get(f"{KERNEL_OF[header['distance']]}_over_estimates")
        summary = {
            "num_splats": num_used,
            "num_splats_left_out": sum(header["splats_given"].values()) - num_used,
            "shape": list(self.grid.channels["sdf"].shape),
            "num_cells": self.statistics.num_cells,
            "voxel": self.grid.voxel,
            "distance": header["distance"],
            "length_scale": header["length_scale"],
            "median_radius": health["radius"],
            "median_spacing": health["spacing"],
            "never_seen_share": self.statistics.never_seen_share,
            "over_estimating_share": None if over is None else over / self.statistics.num_cells,
            "num_warnings": len(self.warnings),
        }
        if self.changes is not None:
            summary["blocks_baked"] = f"{self.changes.num_baked} of {self.changes.num_blocks}"
        return summary


def metrics_of(summary: Mapping[str, Any], accuracy: Accuracy) -> dict[str, float | None]:
    """Numbers a gate can name: those of the summary, ``seen.hard.0_2cm.rmse`` and so on, ``over_estimate.*``."""
    of_truth = {} if accuracy.truth is None else accuracy.truth.accuracy.figures()
    return {name: summary[name] for name in SUMMARY_METRICS} | of_truth


def counts_of(metrics: Mapping[str, float | None]) -> dict[str, int]:
    """The cells that each of the metrics rests on: those of its band or of the over-estimate, else all."""
    of_bands = {name: f"{name.rpartition('.')[0]}.count" for name in metrics if not name.endswith(".count")}
    counted = {name: of_bands[name] if of_bands.get(name) in metrics else "num_cells" for name in metrics}
    return {name: int(metrics[count] or 0) for name, count in counted.items()}


def _verdict(
    request: BakeRequest, report: FieldReport, metrics: Mapping[str, float | None], *, has_occupancy: bool
) -> Verdict:
    """What cells may lose [m], that a camera saw some of them where that is known, and each ``--require``."""
    statistics, voxel = report.statistics, report.grid.voxel
    num_cells, loss = statistics.num_cells, LOSS * voxel
    reasons = [
        Reason(
            criterion="loss",
            outcome=Outcome.PASSED,
            sentence=f"cells read at most {1e3 * loss:.1f} mm too little of the distance to the splats",
            value=loss,
            threshold=request.config.field.max_loss,
            unit="m",
            count=num_cells,
        )
    ]
    if has_occupancy and statistics.never_seen_share == 1:
        reasons.append(
            Reason(
                criterion="known space",
                outcome=Outcome.NOT_EVALUABLE,
                sentence="no cell of the grid was ever seen by a camera",
                value=1.0,
                threshold=1.0,
                remedy="give a --box that the cameras saw",
                count=num_cells,
            )
        )
    reasons += [noted("field", text) for text in report.warnings]
    shape, counts = report.grid.channels["sdf"].shape, counts_of(metrics)
    return verdict_of(
        "sdf-bake",
        [*reasons, *gate_reasons(request.require, metrics, counts)],
        scope=f"{' x '.join(map(str, shape))} cells of {voxel:g} m, {metrics['num_splats']} splats",
        counts=counts,
    )


def _draw(folder: Path, report: FieldReport, accuracy: Accuracy, point: Sequence[float]) -> None:
    """Slices through `point` [m], the gradient, and the grid's other channels."""
    folder.mkdir()
    grid, lengths = report.grid, report.statistics.gradient
    slices_picture(folder / "slices.png", grid, point)
    if lengths is not None:
        gradient_picture(folder / "gradient.png", grid, lengths.histogram, lengths.bin_width, point)
    if "probability" in grid.channels:
        probability_picture(folder / "probability.png", grid, point)
    if accuracy.truth is not None and accuracy.truth.reliability:
        curves = accuracy.truth.reliability
        reliability_picture(folder / "reliability.png", curves, "Probability against the truth")


def _middle(job: _Job) -> list[float]:
    """Where slices are shown: in the middle of the splats in the grid but for the outermost, or of the grid [m]."""
    box, centers = job.baker.layout.box, job.obstacles.splats.centers
    inside = centers[box.contains(centers)]
    lower, upper = np.percentile(inside, (5, 95), axis=0) if len(inside) else (box.lower, box.upper)
    return [float(value) for value in 0.5 * (lower + upper)]

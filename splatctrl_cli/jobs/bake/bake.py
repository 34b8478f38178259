"""A bake: splats to a distance grid, slab by slab on disk."""

import shutil
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate import field_accuracy
from splatctrl_cli.evaluate.field_accuracy import FIELDS
from splatctrl_cli.evaluate.verdict import JudgedResult, check_gate_names
from splatctrl_cli.field.baker import DEFAULT_CHANNELS, Baker, Changes, changed_blocks, counts_after
from splatctrl_cli.field.clusters import ObstacleSpheres, obstacle_spheres
from splatctrl_cli.field.grid_cells import GridLayout, check_loss, check_room
from splatctrl_cli.field.slabs import (
    EarlierBake,
    UnknownSpace,
    bake_planes,
    bytes_per_cell,
    check_slab_memory,
    field_header,
    grid_statistics,
    slabs,
)
from splatctrl_cli.files.output import Stopwatch, output_path, partial_path, remove, write_json, write_run
from splatctrl_cli.formats.grid.grid_format import CHANNELS, GridSlabs, SlabPlan, resume_slabs, start_slabs
from splatctrl_cli.formats.grid.grid_formats import FORMATS, check_formats, write_grid
from splatctrl_cli.jobs.bake.accuracy import (
    SUMMARY_METRICS,
    accuracy_of,
    bake_verdict,
    check_references,
    field_document,
    metrics_of,
    summary_of,
)
from splatctrl_cli.jobs.bake.request import (
    BakeRequest,
    BakeSource,
    Previous,
    check_same,
    choose_box,
    device_for,
    read_bake_source,
    read_previous,
)
from splatctrl_cli.jobs.running.device import (
    Device,
    advise_resumption,
    check_resumption,
    deciding_versions,
    explain_faults,
)
from splatctrl_cli.jobs.running.progress import SILENT, Progress, Wait
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.report.field_pictures import (
    Reliability,
    gradient_picture,
    probability_picture,
    reliability_picture,
    slices_picture,
)

FOLDER = "channels"
CHECKPOINT = f"{FOLDER}/progress.json"


def bake_to_disk(
    job: "_Job", earlier: EarlierBake | None, unknown: UnknownSpace | None, partial: Path, progress: Progress
) -> GridSlabs:
    """Bake the channels into ``partial/channels``; the baker's counts then cover all slabs.

    earlier: unchanged cells of an update; unknown: treatment of unobserved space. --resume continues after the last
    slab. Raises UsageError for settings other than the interrupted bake's, or too little disk or memory.
    """
    baker, request, folder = job.baker, job.request, partial / FOLDER
    layout, config = baker.layout, request.config
    check_slab_memory(layout, baker.channels)
    plan = SlabPlan(
        origin=(float(layout.origin[0]), float(layout.origin[1]), float(layout.origin[2])),
        voxel=layout.voxel,
        shape=layout.shape,
        channels=baker.channels,
        settings={  # everything else that decides the bytes
            **deciding_versions(),
            **{f"field.{name}": value for name, value in asdict(config.field).items()},
            **{f"occupancy.{name}": value for name, value in asdict(config.occupancy).items()},
            **{f"sha256 of {name}": value for name, value in job.digests.items()},
            "labels": ",".join(request.label_names),
            **({} if job.device.card is None else {"card": job.device.card.name}),
        },
    )
    if not (folder / "progress.json").is_file():
        check_disk(partial, layout, baker.channels, request.formats)
        check_vdb(layout, baker.channels, request.formats)
    store = resume_slabs(folder, plan) if request.resume else start_slabs(folder, plan)
    if store.num_layers:
        progress.log(f"{partial}: continues after {store.num_layers} of {layout.shape[0]} planes")
        baker.counts = {name: store.counts[name] for name in baker.counts}
        if unknown is not None:
            unknown.num_never_seen, unknown.num_changed = store.counts["never_seen"], store.counts["changed"]
    wait = Wait(progress, "bakes", "planes", layout.shape[0])
    with tqdm(
        total=layout.shape[0], initial=store.num_layers, unit=" planes", disable=True if progress.is_quiet else None
    ) as bar:
        for first, last in slabs(layout, baker.channels, store.num_layers):
            planes = bake_planes(baker, first, last, earlier)
            counts = baker.counts
            if unknown is not None:
                planes = unknown.apply(planes, first, last, baker.bound_margin)
                counts = {**counts, "never_seen": unknown.num_never_seen, "changed": unknown.num_changed}
            store.write(planes, counts)
            bar.update(last - first)
            if bar.disable:
                wait.at(last)
    return store


def check_disk(folder: Path, layout: GridLayout, channels: Collection[str], formats: Collection[str]) -> None:
    """Raise UsageError if channels and output files do not fit the disk."""
    per_cell = bytes_per_cell(channels)
    sizes = (FORMATS[name].bytes_per_cell for name in formats)
    copies = sum(per_cell if size is None else size for size in sizes)
    needed = (per_cell + copies) * layout.num_cells + (1 << 26)  # bytes for what is small
    free = shutil.disk_usage(folder).free
    refuse_if(
        needed > free,
        f"grid of {' x '.join(map(str, layout.shape))} cells: needs {needed / 2**30:.1f} GiB of disk ({needed} bytes)"
        f", {free / 2**30:.1f} GiB ({free} bytes) is free at {folder.parent}",
        remedy="give a larger --voxel, a smaller --box, fewer --channels or --formats, or another --out",
        error=UsageError,
    )


def check_vdb(layout: GridLayout, channels: Collection[str], formats: Collection[str]) -> None:
    """Raise UsageError if OpenVDB, which holds the grid in memory, lacks room."""
    if "vdb" in formats:
        remedy = "leave it out of --formats (nrrd needs no memory), or give a larger --voxel or fewer --channels"
        # 7 copies of the channels, in memory: 454 MiB were measured for one of 64 MiB
        check_room("format vdb:", 7 * bytes_per_cell(channels) * layout.num_cells, remedy)


def bake(request: BakeRequest, progress: Progress = SILENT) -> JudgedResult:
    """Bake into the output folder, or continue an interrupted bake. Raises SplatCtrlError.

    Document: a summary, and the accuracy by reference (truth, reference_mesh, held_out_depth), as in ``field.json``.
    """
    check_request(request)
    stopwatch, out = Stopwatch(), request.out
    checkpoint = partial_path(out) / CHECKPOINT
    check_resumption(checkpoint, "bake", progress, resume=request.resume)
    with (
        advise_resumption(checkpoint),
        output_path(
            out, force=request.force, is_folder=True, checkpoint=CHECKPOINT, resume=request.resume
        ) as partial,
    ):
        job = _read(request, stopwatch, progress)
        for path in partial.iterdir():  # all but an interrupted bake's channels is written again
            if path.name != FOLDER:
                remove(path)
        with stopwatch.stage("bake"), closing(job.baker), explain_faults(job.device, checkpoint):
            grid, changes = _bake_grid(job, partial, progress)
        with stopwatch.stage("report"):
            statistics = grid_statistics(grid)
            document = field_document(grid, statistics, changes)
        with stopwatch.stage("write"):
            write_grid(partial, grid, request.formats)
        with stopwatch.stage("accuracy"):
            accuracy, curves = accuracy_of(grid, job.baker.spheres, job.source, request)
        with stopwatch.stage("report"):
            write_json(partial / "field.json", document | ({"accuracy": accuracy} if accuracy else {}))
            if not request.no_report:
                _draw(partial / "report", grid, statistics["gradient"], curves, _middle(job))
        summary = summary_of(document)
        metrics = metrics_of(summary, accuracy)
        verdict = bake_verdict(request, document, metrics, has_occupancy=job.source.occupancy is not None)
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
    document = {**summary, **({"accuracy": accuracy} if accuracy else {})}
    return JudgedResult(out=out, metrics=metrics, document=document, verdict=verdict, seconds=stopwatch.seconds)


def check_request(request: BakeRequest) -> None:
    """Raise UsageError for too coarse cells, incomplete options, and gates on unknown figures."""
    check_loss(request.config.field.voxel, request.config.field.max_loss)
    refuse_if(
        (request.truth is None) != (request.seen_by is None),
        "--truth and --seen-by: expected both or neither",
        error=UsageError,
    )
    refuse_if(
        request.previous_scene is not None and request.update is None,
        "--previous-scene: belongs to --update",
        remedy="give the field folder to --update as well",
        error=UsageError,
    )
    of_truth = () if request.truth is None else field_accuracy.metric_scales(FIELDS)
    check_gate_names(request.require, (*SUMMARY_METRICS, *of_truth))


@dataclass(frozen=True, kw_only=True)
class _Job:
    request: BakeRequest
    source: BakeSource
    previous: Previous | None
    obstacles: ObstacleSpheres
    device: Device
    baker: Baker

    @property
    def digests(self) -> dict[str, str]:
        return self.source.digests | ({} if self.previous is None else self.previous.digests)


def _read(request: BakeRequest, stopwatch: Stopwatch, progress: Progress) -> _Job:
    config, previous = request.config, None
    with stopwatch.stage("read"):
        source = read_bake_source(request.scene, request.at)
        if request.update is not None:
            previous = read_previous(request.update, request.previous_scene or request.scene)
    obstacles = obstacle_spheres(source.splats, source.unrepresented, request.labels)
    channels = _channels(request, previous)
    check_references(request, source)
    check_formats(request.formats, channels, unknown=config.field.unknown)
    layout = GridLayout.over(choose_box(request, source, previous), config.field.voxel)
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
    usual = DEFAULT_CHANNELS if previous is None else tuple(previous.grid.channels)
    wanted = usual if request.channels is None else request.channels
    names = {"sdf", *wanted, *(("probability",) if request.with_probability else ())}
    chosen = (*(name for name in CHANNELS if name in names), *sorted(names - set(CHANNELS)))
    for option in ("truth", "reference_mesh", "held_out"):
        refuse_if(
            getattr(request, option) is not None and not {"bound", "hard"} & names,
            f"--{option.replace('_', '-')}: needs the exact distance",
            remedy="bake the channel bound or hard as well",
            error=UsageError,
        )
    unknown = request.config.field.unknown
    refuse_if(
        unknown != "free" and "observed" not in names,
        f"field.unknown = {unknown}: needs to know which cells were seen",
        remedy="bake the channel observed as well",
        error=UsageError,
    )
    return chosen


def _bake_grid(job: _Job, partial: Path, progress: Progress) -> tuple[DistanceGrid, Changes | None]:
    baker, previous, source, config = job.baker, job.previous, job.source, job.request.config
    changes = earlier = old = None
    if previous is not None:
        before = obstacle_spheres(previous.source.splats, previous.source.unrepresented, job.request.labels).splats
        old = Baker(
            before,
            baker.layout,
            config.field,
            channels=[name for name in ("sdf", "se", "gpdf") if name in baker.channels],
            threads=job.request.threads,
        )
        changes = changed_blocks(before, old, job.obstacles.splats, baker)
        if changes.reason:
            progress.log(f"--update: every block is baked anew: {changes.reason}")
        if changes.mask is not None:
            earlier = EarlierBake(
                grid=previous.grid, mask=changes.mask, occupancy=source.occupancy, thresholds=config.occupancy
            )
    is_free = config.field.unknown == "free"
    unknown = None if is_free else UnknownSpace(baker.layout, config.field, source.occupancy, config.occupancy)
    store = bake_to_disk(job, earlier, unknown, partial, progress)
    if earlier is not None and old is not None and previous is not None:
        counts: Any = previous.grid.header["kernel_counts"]
        baker.counts = counts_after(counts, old, baker, earlier.mask, list(slabs(baker.layout, baker.channels)))
    header = field_header(
        source.splats,
        job.obstacles.splats,
        job.request.labels,
        baker,
        has_occupancy=source.occupancy is not None,
        num_unrepresented=job.obstacles.num_unrepresented,
    )
    header |= {} if unknown is None else unknown.header()
    provenance = {"digests": source.digests, "stamp_ns": source.stamp_ns, "made_from": source.made_from}
    return store.grid({**header, **provenance}), changes


def _draw(
    folder: Path,
    grid: DistanceGrid,
    lengths: Mapping[str, Any] | None,
    curves: Mapping[str, Reliability],
    point: Sequence[float],
) -> None:
    folder.mkdir()
    slices_picture(folder / "slices.png", grid, point)
    if lengths is not None:
        gradient_picture(folder / "gradient.png", grid, lengths["histogram"], lengths["bin_width"], point)
    if "probability" in grid.channels:
        probability_picture(folder / "probability.png", grid, point)
    if curves:
        reliability_picture(folder / "reliability.png", curves, "Probability against the truth")


def _middle(job: _Job) -> list[float]:
    """Point [m] of the drawn slices: the middle of the grid's splats without outliers."""
    box, centers = job.baker.layout.box, job.obstacles.splats.centers
    inside = centers[box.contains(centers)]
    lower, upper = np.percentile(inside, (5, 95), axis=0) if len(inside) else (box.lower, box.upper)
    return [float(value) for value in 0.5 * (lower + upper)]

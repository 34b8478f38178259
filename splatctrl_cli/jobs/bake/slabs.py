"""The bake itself: slab by slab onto the disk, so that it can be larger than memory, and be continued."""

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.grid_cells import GridLayout, check_room
from splatctrl_cli.field.slabs import Kept, UnknownSpace, baked_planes, bytes_per_cell, check_slab_memory, slabs
from splatctrl_cli.formats.grid.grid_format import GridSlabs, SlabPlan, resume_slabs, start_slabs
from splatctrl_cli.formats.grid.grid_formats import FORMATS
from splatctrl_cli.jobs.running.progress import Progress, Wait

FOLDER = "channels"
CHECKPOINT = f"{FOLDER}/progress.json"
VDB_COPIES = 7  # of the channels, in memory: 454 MiB were measured for one of 64 MiB


@dataclass(frozen=True, kw_only=True)
class BakeTask:
    """What is baked; `settings`: all that decides the bytes, as plain values; `kept` is what an update keeps;
    `unknown` is what is done with unknown space (None: nothing).
    """

    baker: Baker
    settings: Mapping[str, Any]
    kept: Kept | None = None
    unknown: UnknownSpace | None = None
    formats: tuple[str, ...] = ()


def bake_to_disk(task: BakeTask, partial: Path, progress: Progress, *, resume: bool) -> GridSlabs:
    """The channels in ``partial/channels``; the baker's counts are then those of all that was baked.

    With `resume` it goes on after the last slab that an interrupted bake of the same settings left. Raises UsageError
    for one of other settings, and where the disk or the memory has no room.
    """
    baker, folder = task.baker, partial / FOLDER
    layout = baker.layout
    check_slab_memory(layout, baker.channels)
    plan = SlabPlan(
        origin=(float(layout.origin[0]), float(layout.origin[1]), float(layout.origin[2])),
        voxel=layout.voxel,
        shape=layout.shape,
        channels=baker.channels,
        settings=task.settings,
    )
    if not (folder / "progress.json").is_file():
        check_disk(partial, layout, baker.channels, task.formats)
        check_vdb(layout, baker.channels, task.formats)
    store = resume_slabs(folder, plan) if resume else start_slabs(folder, plan)
    if store.num_layers:
        progress.log(f"{partial}: continues after {store.num_layers} of {layout.shape[0]} planes")
        _set_counts(task, store.counts)
    wait = Wait(progress, "bakes", "planes", layout.shape[0])
    hidden = True if progress.is_quiet else None
    with tqdm(total=layout.shape[0], initial=store.num_layers, unit=" planes", disable=hidden) as bar:
        for first, last in slabs(layout, baker.channels, store.num_layers):
            planes = baked_planes(baker, first, last, task.kept)
            if task.unknown is not None:
                planes = task.unknown.apply(planes, first, last, baker.bound_margin)
            store.write(planes, _counts_now(task))
            bar.update(last - first)
            if bar.disable:
                wait.at(last)
    return store


def clear_leftovers(partial: Path) -> None:
    """Remove what an interrupted run had written beside the channels: all of it is written again."""
    for path in partial.iterdir():
        if path.name != FOLDER:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def check_disk(folder: Path, layout: GridLayout, channels: Collection[str], formats: Collection[str]) -> None:
    """Raise UsageError where the channels and the files made of them do not fit the disk."""
    per_cell = bytes_per_cell(channels)
    copies = sum(FORMATS[name].size_per_cell(per_cell) for name in formats)
    needed = (per_cell + copies) * layout.num_cells + (1 << 26)  # bytes for what is small
    free = shutil.disk_usage(folder).free
    if needed > free:
        size = " x ".join(str(n) for n in layout.shape)
        raise UsageError(
            f"grid of {size} cells: needs {needed / 2**30:.1f} GiB of disk ({needed} bytes), "
            f"{free / 2**30:.1f} GiB ({free} bytes) is free at {folder.parent}",
            remedy="give a larger --voxel, a smaller --box, fewer --channels or --formats, or another --out",
        )


def check_vdb(layout: GridLayout, channels: Collection[str], formats: Collection[str]) -> None:
    """Raise UsageError where OpenVDB is asked for and cannot hold the grid in memory, as its library does."""
    if "vdb" in formats:
        remedy = "leave it out of --formats (nrrd needs no memory), or give a larger --voxel or fewer --channels"
        check_room("format vdb:", VDB_COPIES * bytes_per_cell(channels) * layout.num_cells, remedy)


def _counts_now(task: BakeTask) -> dict[str, int]:
    """What was counted so far."""
    unknown = task.unknown
    treated = {} if unknown is None else {"never_seen": unknown.num_never_seen, "changed": unknown.num_changed}
    return {**task.baker.counts, **treated}


def _set_counts(task: BakeTask, counts: Mapping[str, int]) -> None:
    task.baker.counts = {name: counts[name] for name in task.baker.counts}
    if task.unknown is not None:
        task.unknown.num_never_seen, task.unknown.num_changed = counts["never_seen"], counts["changed"]

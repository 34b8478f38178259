"""A bake's request and input: the scene, and an update's previous field."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli import __version__
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.config.fixed import CARD_LEAST_BAKE, CARD_SPLATS
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, refuse_faults, refuse_if
from splatctrl_cli.field.clusters import DEFAULT_LABELS, field_splats
from splatctrl_cli.field.distance import KERNEL_OF
from splatctrl_cli.field.grid_cells import GridLayout, bounding_box, check_room
from splatctrl_cli.files.output import Parts, sha256
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, Snapshot, open_scene
from splatctrl_cli.formats.splat.splats import read_spheres
from splatctrl_cli.jobs.running.device import CUDA, TO_CPU, Device, RunOptions, choose_device
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.jobs.runs.run_folder import read_object
from splatctrl_cli.records import Box, DistanceGrid, Label, SplatSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.voxels import Balls, OccupancyGrid


@dataclass(frozen=True, kw_only=True)
class BakeRequest(RunOptions):
    """Bake of `scene` (reconstruct's folder, or a splat file) into the folder `out`.

    at: time after the scene's start [s], None for its end. labels: of the splats in the field. The grid covers `box`,
    else the robot's reach, else the splats. channels: besides sdf, None for the default set. The field is compared
    with `truth` where cameras of `seen_by` looked, `reference_mesh`, and depth in the log `held_out`.
    held_out_cameras: empty for all that did not train. update: an earlier field of `previous_scene` (None: `scene`);
    only changes are baked.
    """

    scene: Path
    out: Path = Path("field")
    at: float | None = None
    labels: frozenset[Label] = DEFAULT_LABELS
    box: Box | None = None
    urdf: Path | None = None
    spheres: Path | None = None
    channels: tuple[str, ...] | None = None
    with_probability: bool = False
    formats: tuple[str, ...] = ("npz", "vti")
    truth: Path | None = None
    seen_by: Path | None = None
    reference_mesh: Path | None = None
    held_out: Path | None = None
    held_out_cameras: tuple[str, ...] = ()
    no_report: bool = False
    update: Path | None = None
    previous_scene: Path | None = None
    resume: bool = False
    require: tuple[str, ...] = ()

    @property
    def label_names(self) -> list[str]:
        return sorted(label.name.lower() for label in self.labels)


@dataclass(frozen=True, kw_only=True)
class BakeSource:
    """Splats and the occupancy of the same moment, which a bare splat file lacks.

    unrepresented: occupied voxels without a splat. workspace: the box outside which no splats are kept.
    """

    splats: SplatSet
    digests: dict[str, str]
    occupancy: OccupancyGrid | None = None
    unrepresented: Balls | None = None
    stamp_ns: int | None = None
    workspace: Box | None = None
    cameras: tuple[str, ...] | None = None
    made_from: Mapping[str, Any] = field(default_factory=dict)


def read_bake_source(path: Path, at_seconds: float | None) -> BakeSource:
    """Read the splats at `path`, as known `at_seconds` after the first snapshot (None: the end).

    Raises InputError without a scene, UsageError for a time in a bare splat file, NotEvaluableError without a
    snapshot then.
    """
    refuse_if(
        not path.exists(), f"{path}: no such file or folder", remedy="give what reconstruct wrote, or a splats.ply"
    )
    if path.is_dir():
        return _read_folder(path, at_seconds)
    if at_seconds is not None:
        raise UsageError(f"--at {at_seconds:g}: {path} is one splat set", remedy="give the scene's folder")
    return BakeSource(splats=read_spheres(path), digests={path.name: sha256(path)})


def _read_folder(path: Path, at_seconds: float | None) -> BakeSource:
    scene = open_scene(path)
    final = scene.occupancy()
    then: SceneFolder | Snapshot = scene
    wanted_ns, files = None, [path / "splats.ply", path / "occupancy.npz"]
    if at_seconds is not None:
        refuse_if(
            not scene.snapshots, f"{path}: has no snapshots", remedy="bake without --at", error=NotEvaluableError
        )
        wanted_ns = scene.snapshots[0].stamp_ns + round(at_seconds * 1e9)
        then = scene.snapshot_at(wanted_ns)
        files = [then.path, then.occupancy_path]
    occupancy = final if wanted_ns is None else then.occupancy()
    lower = final.origin + 0.5 * final.voxel  # without the border voxels: a surface there may have splats beyond it
    upper = lower + final.voxel * (np.array(final.log_odds.shape) - 2)
    return BakeSource(
        splats=then.splats(),
        occupancy=occupancy,
        unrepresented=scene.unrepresented_at(wanted_ns),
        stamp_ns=then.stamp_ns,
        workspace=Box(lower=lower, upper=upper),
        cameras=scene.cameras,
        made_from=scene.made_from,
        digests={file.name: sha256(file) for file in (files if occupancy is not None else files[:1])},
    )


@dataclass(frozen=True, kw_only=True)
class Previous:
    """Baked field with its run.json and the source of its splats."""

    path: Path
    grid: DistanceGrid
    run: dict[str, Any]
    source: BakeSource
    digests: dict[str, str]

    @property
    def box(self) -> Box:
        """Box of the cell centres; the same box and voxel give the same cells."""
        x, y, z = self.grid.channels["sdf"].shape
        return GridLayout(origin=self.grid.origin, voxel=self.grid.voxel, shape=(x, y, z)).box


def read_previous(path: Path, scene: Path) -> Previous:
    """Read the field in folder `path` and the splats of `scene` it was baked from.

    Raises InputError for a missing or damaged field, UsageError for another scene or version.
    """
    refuse_if(not path.is_dir(), f"--update {path}: no such folder", remedy="give a folder that sdf-bake wrote")
    file = path / "field.npz"
    if file.is_file():
        check_room(f"--update: {file}", file.stat().st_size, "bake without --update, which needs less")
    with refuse_faults(
        lambda _: f"--update {path}: has no readable run.json", InputError, remedy="bake it once without --update"
    ):
        run = read_object(path / "run.json")
    grid = read_npz(Parts.from_run(path, run).checked(file))
    is_ours = run.get("command") == "sdf-bake" and run.get("splatctrl") == __version__
    refuse_if(
        not is_ours or "unrepresented_voxels" not in grid.header,
        f"--update {path}: expected a field that sdf-bake of splatctrl {__version__} wrote, got one of "
        f"{run.get('command')} of {run.get('splatctrl')}",
        remedy="bake it once without --update",
        error=UsageError,
    )
    return Previous(
        path=path,
        grid=grid,
        run=run,
        source=source_of_grid(f"--update {path}", grid, scene),
        digests={str(file): sha256(file)},
    )


def check_same(
    previous: Previous, layout: GridLayout, config: FieldConfig, channels: tuple[str, ...], labels: list[str]
) -> None:
    """Raise UsageError naming settings that differ from the previous bake."""
    grid = previous.grid
    used = previous.run.get("config", {}).get("field", {})
    # voxel is compared with the grid's; the others change no cell
    settings = {name: value for name, value in vars(config).items() if name not in ("voxel", "padding", "max_loss")}
    then_and_now: dict[str, tuple[object, object]] = {
        "field.voxel": (grid.voxel, layout.voxel),
        "cells": (" x ".join(map(str, grid.channels["sdf"].shape)), " x ".join(map(str, layout.shape))),
        "first cell": (grid.origin.tolist(), layout.origin.tolist()),
        "channels": (",".join(sorted(grid.channels)), ",".join(sorted(channels))),
        "labels": (grid.header.get("labels"), labels),
        **{f"field.{name}": (used.get(name), value) for name, value in settings.items()},
    }
    differing = [f"{name} was {then}, is {now}" for name, (then, now) in then_and_now.items() if then != now]
    more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
    refuse_if(
        differing,
        f"--update {previous.path}: that field was baked with other settings: {', '.join(differing[:3])}{more}",
        remedy="give the same settings, or bake without --update",
        error=UsageError,
    )


def source_of_grid(where: str, grid: DistanceGrid, scene: Path) -> BakeSource:
    """Read the splats of `scene` at the grid's time.

    Raises UsageError, starting with `where`, if the grid was not baked from these splats.
    """
    digests, stamp_ns = grid.header.get("digests"), grid.header.get("stamp_ns")
    wanted = next(iter(digests.values()), None) if isinstance(digests, dict) else None
    source = read_bake_source(scene, None)
    if next(iter(source.digests.values())) != wanted and scene.is_dir() and isinstance(stamp_ns, int):
        snapshots = open_scene(scene).snapshots
        if snapshots and stamp_ns >= snapshots[0].stamp_ns:
            source = read_bake_source(scene, (stamp_ns - snapshots[0].stamp_ns) * 1e-9)
    option = "--previous-scene" if where.startswith("--update") else "--scene"
    refuse_if(
        next(iter(source.digests.values())) != wanted,
        f"{where}: was not baked from the splats of {scene}",
        remedy=f"give the scene that it was baked from as {option}",
        error=UsageError,
    )
    return source


def choose_box(request: BakeRequest, source: BakeSource, previous: Previous | None) -> Box:
    """Box of the grid: given, else of the robot's reach, previous field, or splats."""
    if request.box is not None:
        return request.box
    if request.urdf is not None:
        base = source.made_from.get("robot_base")
        T = None if base is None else np.array(base)
        return RobotModel.from_urdf(request.urdf, request.spheres, T_world_base=T).reach_box
    padding = request.config.field.padding
    return bounding_box(field_splats(source.splats, request.labels), padding) if previous is None else previous.box


def device_for(request: BakeRequest, layout: GridLayout, num_splats: int, progress: Progress) -> Device:
    """Choose the device; updates bake on the processor. Raises UsageError for an unusable card."""
    if request.update is not None:
        refuse_if(
            request.device.startswith(CUDA),
            f"--device {request.device}: --update bakes on the processor",
            remedy=TO_CPU,
            error=UsageError,
        )
        return Device()
    is_matern = KERNEL_OF[request.config.field.distance] == "gpdf"
    return choose_device(
        request.device, layout.num_cells * (num_splats if is_matern else CARD_SPLATS) >= CARD_LEAST_BAKE, progress
    )

"""The field that ``sdf-bake --update`` starts from: read, and checked to be what this bake would have given then."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli import __version__
from splatctrl_cli.cli.bake_source import BakeSource, read_bake_source
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.field.layout import GridLayout, available_memory
from splatctrl_cli.files.output import sha256
from splatctrl_cli.files.parts import Parts
from splatctrl_cli.grid_files.grid import read_npz
from splatctrl_cli.records import Box, DistanceGrid
from splatctrl_cli.scene_files.scene_folder import open_scene

NOT_COMPARED = ("voxel", "padding", "max_loss")  # voxel is compared with the grid's; the others change no cell


@dataclass(frozen=True, kw_only=True)
class Previous:
    """A baked field, the configuration it was baked with (`run`: the folder's run.json), and its splats' source."""

    path: Path
    grid: "DistanceGrid"
    run: dict[str, Any]
    source: "BakeSource"
    digests: dict[str, str]

    @property
    def box(self) -> "Box":
        """The box of the cell centres: a grid over it, with the same voxel, has the same cells."""
        shape = self.grid.channels["sdf"].shape
        upper = [o + self.grid.voxel * (n - 1) for o, n in zip(self.grid.origin.tolist(), shape, strict=True)]
        return Box(lower=self.grid.origin, upper=self.grid.origin * 0 + upper)


def read_previous(path: Path, scene: Path) -> Previous:
    """The field in folder `path`, with the splats of `scene` that it was baked from.

    Raises InputError for a field that is not there, damaged or foreign, UsageError where the scene is not its own or
    another version baked it.
    """
    if not path.is_dir():
        raise InputError(f"--update {path}: no such folder", remedy="give a folder that sdf-bake wrote")
    file = path / "field.npz"
    if file.is_file():
        _check_memory(file)
    run = _run_of(path)
    grid = read_npz(Parts.of_run(path, run).checked(file))
    is_ours = run.get("command") == "sdf-bake" and run.get("splatctrl") == __version__
    if not is_ours or "unrepresented_voxels" not in grid.header:
        raise UsageError(
            f"--update {path}: expected a field that sdf-bake of splatctrl {__version__} wrote, got one of "
            f"{run.get('command')} of {run.get('splatctrl')}",
            remedy="bake it once without --update",
        )
    return Previous(
        path=path, grid=grid, run=run, source=_its_source(path, grid, scene), digests={str(file): sha256(file)}
    )


def check_same(
    previous: Previous, layout: "GridLayout", config: "FieldConfig", channels: tuple[str, ...], labels: list[str]
) -> None:
    """Raise UsageError naming what differs between the bake before and this one."""
    grid = previous.grid
    before: dict[str, object] = {"field.voxel": grid.voxel, "cells": " x ".join(map(str, grid.channels["sdf"].shape))}
    now: dict[str, object] = {"field.voxel": layout.voxel, "cells": " x ".join(map(str, layout.shape))}
    before["first cell"], now["first cell"] = grid.origin.tolist(), np.asarray(layout.origin).tolist()
    before["channels"], now["channels"] = ",".join(sorted(grid.channels)), ",".join(sorted(channels))
    before["labels"], now["labels"] = grid.header.get("labels"), labels
    used = previous.run.get("config", {}).get("field", {})
    for name, value in vars(config).items():
        if name not in NOT_COMPARED:
            before[f"field.{name}"], now[f"field.{name}"] = used.get(name), value
    differing = [name for name in now if before[name] != now[name]]
    if differing:
        said = ", ".join(f"{name} was {before[name]}, is {now[name]}" for name in differing[:3])
        more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise UsageError(
            f"--update {previous.path}: that field was baked otherwise: {said}{more}",
            remedy="give the options it was baked with, or bake without --update",
        )


def _run_of(folder: Path) -> dict[str, Any]:
    try:
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        run = None
    if not isinstance(run, dict):
        raise InputError(f"--update {folder}: has no readable run.json", remedy="bake it once without --update")
    return run


def _check_memory(file: Path) -> None:
    needed, free = file.stat().st_size, available_memory()
    if needed > free:
        raise UsageError(
            f"--update: {file} needs {needed / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB is free",
            remedy="bake without --update, which needs less",
        )


def _its_source(path: Path, grid: "DistanceGrid", scene: Path) -> "BakeSource":
    """The splats of `scene` at the field's time. Raises UsageError where they are not those it was baked from."""
    digests, stamp_ns = grid.header.get("digests"), grid.header.get("stamp_ns")
    wanted = next(iter(digests.values()), None) if isinstance(digests, dict) else None
    source = read_bake_source(scene, None)
    if next(iter(source.digests.values())) != wanted and scene.is_dir() and isinstance(stamp_ns, int):
        snapshots = open_scene(scene).snapshots
        if snapshots and stamp_ns >= snapshots[0].stamp_ns:
            source = read_bake_source(scene, (stamp_ns - snapshots[0].stamp_ns) * 1e-9)
    if next(iter(source.digests.values())) != wanted:
        raise UsageError(
            f"--update {path}: was not baked from the splats of {scene}",
            remedy="give the scene that it was baked from as --previous-scene",
        )
    return source

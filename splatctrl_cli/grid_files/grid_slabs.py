"""Channels of a grid on disk, filled from one end of x to the other: for grids larger than memory.

A folder holds one ``NAME.npy`` a channel, at its full size from the start, and ``progress.json``: what is being baked
and how many layers of x are on disk. A slab of layers is one run of bytes in each file. What an interrupted bake left
is continued; what is finished is written into every format from memory maps.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.files.output import write_durably, write_json
from splatctrl_cli.grid_files.grid_format import CHANNELS, Shape
from splatctrl_cli.records import DistanceGrid

PROGRESS = "progress.json"


@dataclass(frozen=True, kw_only=True)
class SlabPlan:
    """What is baked: origin and voxel [m], cells, channels, and the settings that decide their values (JSON)."""

    origin: tuple[float, float, float]
    voxel: float
    shape: Shape
    channels: tuple[str, ...]
    settings: Mapping[str, object] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        plain: dict[str, object] = json.loads(json.dumps(asdict(self)))
        return plain


class GridSlabs:
    """The channels of a `SlabPlan` in `folder`; `num_layers` of x are on disk, and what was counted up to there."""

    def __init__(
        self, folder: Path, plan: SlabPlan, num_layers: int, counts: Mapping[str, int] | None = None
    ) -> None:
        self.folder = folder
        self.plan = plan
        self.num_layers = num_layers
        self.counts = counts or {}

    def write(self, slab: Mapping[str, NDArray[np.generic]], counts: Mapping[str, int] | None = None) -> None:
        """Put the next layers of x, ``(L, Y, Z[, 3])`` of every channel, on disk, and count them when they are there.

        counts: what the maker of the slabs counted up to the end of this one.

        Raises InputError for channels or shapes that are not those of the plan.
        """
        if slab.keys() != set(self.plan.channels):
            raise InputError(f"slab: expected the channels {', '.join(self.plan.channels)}, got {', '.join(slab)}")
        num = len(slab[self.plan.channels[0]])
        for name in self.plan.channels:
            wanted = (CHANNELS[name].dtype, self._shape(name, num))
            values = slab[name]
            if (values.dtype.str, values.shape) != wanted or num + self.num_layers > self.plan.shape[0]:
                raise InputError(
                    f"slab: {name} at layer {self.num_layers} of {self.plan.shape[0]}: expected {wanted}, "
                    f"got {(values.dtype.str, values.shape)}"
                )
            self._write_channel(name, values)
        self.num_layers += num
        self.counts = counts or {}
        _write_progress(self.folder, self.plan, self.num_layers, self.counts)

    def is_whole(self) -> bool:
        """Whether every layer is on disk."""
        return self.num_layers == self.plan.shape[0]

    def grid(self, header: Mapping[str, object]) -> DistanceGrid:
        """The grid, its channels read-only memory maps. Raises InputError before every layer is there."""
        if not self.is_whole():
            raise InputError(
                f"{self.folder}: expected {self.plan.shape[0]} layers, got {self.num_layers}",
                remedy="continue the bake",
            )
        channels: dict[str, NDArray[np.generic]] = {
            name: np.lib.format.open_memmap(self._path(name), mode="r") for name in self.plan.channels
        }
        origin = np.array(self.plan.origin, np.float64)
        return DistanceGrid(origin=origin, voxel=self.plan.voxel, channels=channels, header=dict(header))

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npy"

    def _shape(self, name: str, num_layers: int) -> tuple[int, ...]:
        return CHANNELS[name].shape((num_layers, *self.plan.shape[1:]))

    def _write_channel(self, name: str, values: NDArray[np.generic]) -> None:
        path = self._path(name)
        layer = np.dtype(CHANNELS[name].dtype).itemsize * int(np.prod(self._shape(name, 1)))
        with path.open("r+b") as stream:
            stream.seek(path.stat().st_size - layer * (self.plan.shape[0] - self.num_layers))
            stream.write(np.ascontiguousarray(values).data)
            stream.flush()
            os.fsync(stream.fileno())


def start_slabs(folder: Path, plan: SlabPlan) -> GridSlabs:
    """An empty store in `folder`, which is made: every file at its full size. A full disk is an OSError here."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / PROGRESS).unlink(missing_ok=True)
    for name in plan.channels:
        path = folder / f"{name}.npy"
        path.unlink(missing_ok=True)
        np.lib.format.open_memmap(path, "w+", np.dtype(CHANNELS[name].dtype), CHANNELS[name].shape(plan.shape))
        with path.open("r+b") as stream:
            os.posix_fallocate(stream.fileno(), 0, path.stat().st_size)
    _write_progress(folder, plan, 0, {})
    return GridSlabs(folder, plan, 0)


def resume_slabs(folder: Path, plan: SlabPlan) -> GridSlabs:
    """The store that an interrupted bake of the same plan left in `folder`, an empty one where it left none.

    Raises UsageError where it was of another plan, naming what differs, InputError where it is damaged.
    """
    try:
        progress = json.loads((folder / PROGRESS).read_text(encoding="utf-8"))
        left, num_layers, counts = dict(progress["plan"]), int(progress["num_layers"]), dict(progress["counts"])
    except FileNotFoundError:
        return start_slabs(folder, plan)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / PROGRESS}: not readable: {error!r}", remedy="bake without --resume") from None
    wanted = plan.as_dict()
    differs = [key for key in wanted if left.get(key) != wanted[key]]
    if differs:
        told = ", ".join(_difference(key, left.get(key), wanted[key]) for key in differs)
        raise UsageError(f"{folder}: cannot be continued: {told}", remedy="bake without --resume")
    for name in plan.channels:
        path = folder / f"{name}.npy"
        size = CHANNELS[name].shape(plan.shape)
        try:
            found = np.lib.format.open_memmap(path, mode="r").shape
        except (OSError, ValueError):  # not there, or cut
            found = ()
        if found != size:
            raise InputError(f"{path}: expected {size}, got no such array", remedy="bake without --resume")
    return GridSlabs(folder, plan, num_layers, counts)


def _difference(key: str, left: object, wanted: object) -> str:
    if isinstance(left, dict) and isinstance(wanted, dict):
        names = sorted(name for name in {*left, *wanted} if left.get(name) != wanted.get(name))
        return ", ".join(f"{name} was {left.get(name)!r}, is {wanted.get(name)!r}" for name in names)
    return f"{key} was {left!r}, is {wanted!r}"


def _write_progress(folder: Path, plan: SlabPlan, num_layers: int, counts: Mapping[str, int]) -> None:
    progress = {"plan": plan.as_dict(), "num_layers": num_layers, "counts": counts}
    write_durably(folder / PROGRESS, lambda path: write_json(path, progress))

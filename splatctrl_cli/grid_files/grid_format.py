"""What a file format of a baked distance grid declares, and what `info` says of the heads of such files."""

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.grid_files.grid_channels import CHANNELS, GridHead
from splatctrl_cli.records import DistanceGrid

STEM = "field"
FIELD_FACTS = (
    *("distance", "kernel", "length_scale", "weights", "unknown", "probability", "sign", "frame", "labels"),
    *("splats_used", "observed", "stamp_ns"),
)


@dataclass(frozen=True, kw_only=True)
class GridFormat:
    """One kind of file, in the ``ENTRIES`` of its module: all that the program and its docs know of it.

    `name` is what --formats takes; `write` writes the grid as a path that ends in `suffix`, or with `is_per_channel`
    a file a channel beside it; `describe` takes a path and the file's first bytes and returns None for a file of
    another kind; `read` gives back a grid that was written.
    `needs` are channels of which the grid must have one; `holds_unknown` is whether cells that are NaN can be told;
    `bytes_per_cell` is its size on the disk, None for that of all channels; `check` raises UsageError where what
    writes it is not installed. `docs` is its row in docs/artefacts.md, cells between bars: name, file, who opens it,
    checked, cost.
    """

    name: str
    order: int
    suffix: str
    write: Callable[[Path, DistanceGrid], None]
    describe: Callable[[Path, bytes], Summary | None]
    read: Callable[[Path], DistanceGrid] | None = None
    is_per_channel: bool = False
    needs: frozenset[str] = frozenset({"sdf"})
    holds_unknown: bool = True
    bytes_per_cell: int | None = None
    check: Callable[[], object] = lambda: None
    docs: str = ""

    def files(self, channels: Collection[str]) -> tuple[str, ...]:
        """The names of the files that hold a grid of some channels."""
        stems = [f"{STEM}.{channel}" for channel in channels] if self.is_per_channel else [STEM]
        return tuple(f"{stem}{self.suffix}" for stem in stems)

    def size_per_cell(self, bytes_of_channels: int) -> int:
        """Bytes on the disk for a cell whose channels have so many in memory."""
        return bytes_of_channels if self.bytes_per_cell is None else self.bytes_per_cell


def covers(first_cell: Any, voxel: float, shape: Any) -> dict[str, object]:
    """Cells, extent and the centres of the first and last cell [m] of a grid."""
    first, sides = np.asarray(first_cell, np.float64), voxel * (np.asarray(shape) - 1)
    return {
        "shape": [int(n) for n in shape],
        "extent_m": np.round(sides, 6).tolist(),
        "first_cell": np.round(first, 6).tolist(),
        "last_cell": np.round(first + sides, 6).tolist(),
        "voxel": voxel,
    }


def header_facts(header: Mapping[str, Any]) -> dict[str, object]:
    """How a grid was made, of what its header says."""
    return {key: header[key] for key in FIELD_FACTS if header.get(key) is not None}


def summary_of(path: Path, kind: str, head: GridHead) -> Summary:
    """What a grid covers, how it was made, and its channels."""
    rows = [[name, CHANNELS[name].dtype.lstrip("<|"), CHANNELS[name].unit or "-"] for name in head.channels]
    facts = {**covers(head.origin, head.voxel, head.shape), **header_facts(head.header)}
    table = Grid(name="channels", header=("channel", "dtype", "unit"), rows=rows)
    return Summary(path=str(path), kind=kind, facts=facts, grids=(table,))


def json_value(text: object) -> object:
    """What a JSON text holds; any other value as it is."""
    try:
        return json.loads(text) if isinstance(text, str) else text
    except ValueError:
        return text

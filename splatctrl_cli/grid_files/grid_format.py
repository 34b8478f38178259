"""What a file format of a baked distance grid declares, the channels it may hold, and what `info` says of its head.

A channel may be a memory map larger than memory: nothing here holds more of one than `CHUNK` bytes at a time.
"""

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.records import DistanceGrid

FORMAT = "splatctrl distance grid"
VERSION = 2
CHUNK = 1 << 24  # [bytes] of a channel that are copied at a time
TILE = 16  # layers of x that are turned at a time: four times as fast as all at once, 512 x 512 x 512 float32
Shape = tuple[int, int, int]
STEM = "field"
FIELD_FACTS = (
    *("distance", "kernel", "length_scale", "weights", "unknown", "probability", "sign", "frame", "labels"),
    *("splats_used", "observed", "stamp_ns"),
)


@dataclass(frozen=True, kw_only=True)
class Channel:
    """How a channel is stored: dtype, values per cell, unit, and whether the policy on unknown space may blank it."""

    dtype: str
    components: int = 1
    unit: str = ""
    may_be_unknown: bool = False

    def shape(self, cells: Shape) -> tuple[int, ...]:
        """The array's shape on a grid of `cells`."""
        return cells if self.components == 1 else (*cells, self.components)


_DISTANCE = Channel(dtype="<f4", unit="m")
CHANNELS: Mapping[str, Channel] = {
    "sdf": Channel(dtype="<f4", unit="m", may_be_unknown=True),
    "gradient": Channel(dtype="<f4", components=3, may_be_unknown=True),
    "bound": _DISTANCE,
    "observed": Channel(dtype="|u1"),
    "probability": Channel(dtype="<f4", may_be_unknown=True),
    "label": Channel(dtype="|u1"),
    "hard": _DISTANCE,
    "se": _DISTANCE,
    "gpdf": _DISTANCE,
}


@dataclass(frozen=True, kw_only=True)
class GridHead:
    """A file of a distance grid without its values: origin (3,) float64 and voxel [m], cells along x, y, z."""

    origin: NDArray[np.float64]
    voxel: float
    shape: Shape
    channels: tuple[str, ...]
    header: dict[str, object]


def file_header(grid: DistanceGrid) -> dict[str, object]:
    """The header as files hold it: with the format and version that they are written in."""
    return {**grid.header, "format": FORMAT, "version": VERSION}


def header_text(grid: DistanceGrid) -> str:
    return json.dumps(file_header(grid), indent=1, allow_nan=False)


def parse_header(name: str, text: str) -> dict[str, object]:
    """The header that `text` is. Raises InputError naming `name` for other text, or another version."""
    try:
        parsed = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{name}: header: not JSON: {error}", remedy="bake it again") from None
    if not isinstance(parsed, dict) or parsed.get("version") != VERSION:
        version = parsed.get("version") if isinstance(parsed, dict) else None
        raise InputError(
            f"{name}: header: expected version {VERSION}, got {version!r}", remedy="bake it again with this splatctrl"
        )
    return parsed


def check_layout(name: str, arrays: Mapping[str, tuple[str, tuple[int, ...]]]) -> Shape:
    """Cells along x, y and z of channels given as dtype and shape by name.

    Raises InputError naming `name` and the channel where there is no sdf, or one of a name, dtype or shape that a
    grid does not have.
    """
    strange = [channel for channel in arrays if channel not in CHANNELS]
    if strange or "sdf" not in arrays:
        raise InputError(
            f"{name}: expected the channel sdf and any of {', '.join(list(CHANNELS)[1:])}, "
            f"got {', '.join(arrays) or 'none'}",
            remedy="give a grid that sdf-bake wrote",
        )
    cells = arrays["sdf"][1]
    if len(cells) != 3 or min(cells) < 1:
        raise InputError(f"{name}: sdf: expected (X, Y, Z) cells, got {cells}", remedy="bake it again")
    shape = (cells[0], cells[1], cells[2])
    for channel, got in arrays.items():
        wanted = (CHANNELS[channel].dtype, CHANNELS[channel].shape(shape))
        if got != wanted:
            raise InputError(
                f"{name}: {channel}: expected {wanted[0]} {wanted[1]}, got {got[0]} {got[1]}", remedy="bake it again"
            )
    return shape


def check_grid(grid: DistanceGrid) -> Shape:
    """Cells along x, y and z of a grid to write. Raises InputError as `check_layout` does."""
    return check_layout("grid to write", {name: (v.dtype.str, v.shape) for name, v in grid.channels.items()})


def check_finite(name: str, grid: DistanceGrid) -> None:
    """Raise InputError for a value that is not finite, where the header's policy on unknown space is not `nan`."""
    for channel, values in grid.channels.items():
        if not np.issubdtype(values.dtype, np.floating):
            continue
        blank = CHANNELS[channel].may_be_unknown and grid.header.get("unknown") == "nan"
        for layers in slabs(values):
            bad = np.isinf(layers) if blank else ~np.isfinite(layers)
            if bad.any():
                raise InputError(
                    f"{name}: {channel}: expected finite values, got {layers[bad][0]}", remedy="bake it again"
                )


def slabs(values: NDArray[np.generic]) -> Iterator[NDArray[np.generic]]:
    """The channel in runs of layers of x, of `CHUNK` bytes or one layer."""
    step = max(1, CHUNK // max(1, values.nbytes // len(values)))
    for start in range(0, len(values), step):
        yield np.ascontiguousarray(values[start : start + step])


def x_fastest(values: NDArray[np.generic]) -> Iterator[NDArray[np.generic]]:
    """The channel in runs of planes of z, as (z, y, x) or (z, y, x, 3), of `CHUNK` bytes or one plane."""
    x, y, z = values.shape[:3]
    step = max(1, CHUNK // max(1, values.nbytes // z))
    for start in range(0, z, step):
        planes = np.empty((min(step, z - start), y, x, *values.shape[3:]), values.dtype)
        for at in range(0, x, TILE):
            tile = values[at : at + TILE, :, start : start + step]
            planes[:, :, at : at + TILE] = tile.transpose(2, 1, 0, *range(3, values.ndim))
        yield planes


def from_x_fastest(planes: NDArray[np.generic]) -> NDArray[np.generic]:
    """The channel (X, Y, Z[, 3]) of values that lie as `x_fastest` yields them."""
    return np.ascontiguousarray(planes.transpose(2, 1, 0, *range(3, planes.ndim)))


@dataclass(frozen=True, kw_only=True)
class GridFormat:
    """One kind of file, in the ``ENTRIES`` of its module: all that the program and its docs know of it.

    `name` is what --formats takes; `write` writes the grid as a path that ends in `suffix`, or with `is_per_channel`
    a file a channel beside it; `describe` takes a path and the file's first bytes and returns None for a file of
    another kind; `read` gives back a grid that was written.
    `needs` are channels of which the grid must have one; `holds_unknown`: it can mark cells without a distance;
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

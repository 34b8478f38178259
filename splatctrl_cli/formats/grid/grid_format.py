"""The file formats of a baked distance grid: declarations, channels and headers.

A memory map may exceed memory: at most `CHUNK` bytes are copied at once.

`GridSlabs` fills a grid on disk along x: a ``NAME.npy`` per channel at full size, and ``progress.json`` with the plan
and finished layers. An interrupted bake can continue.
"""

import json
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, UsageError, refuse_faults, refuse_if
from splatctrl_cli.files.output import write_durably, write_json
from splatctrl_cli.files.summary import Grid, Summary
from splatctrl_cli.records import DistanceGrid, Values

FORMAT = "splatctrl distance grid"
VERSION = 2
CHUNK = 1 << 24  # [bytes] of a channel that are copied at a time
TILE = 16  # layers of x that are transposed at a time: four times as fast as all at once, 512 x 512 x 512 float32
Shape = tuple[int, int, int]
STEM = "field"
FIELD_FACTS = (
    *("distance", "kernel", "length_scale", "weights", "unknown", "probability", "sign", "frame", "labels"),
    *("splats_used", "observed", "stamp_ns"),
)


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A channel's storage; may_be_unknown: cells in unknown space may be NaN."""

    dtype: str
    components: int = 1
    unit: str = ""
    may_be_unknown: bool = False

    def shape(self, cells: Shape) -> tuple[int, ...]:
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


def file_header(grid: DistanceGrid) -> dict[str, object]:
    return {**grid.header, "format": FORMAT, "version": VERSION}


def header_text(grid: DistanceGrid) -> str:
    return json.dumps(file_header(grid), indent=1, allow_nan=False)


def parse_header(name: str, text: str) -> dict[str, object]:
    """Parse a header. Raises InputError naming `name` if invalid or of another version."""
    with refuse_faults(f"{name}: header: not JSON", json.JSONDecodeError, remedy="bake it again"):
        parsed: dict[str, object] = json.loads(text)
    version = parsed.get("version") if isinstance(parsed, dict) else None
    refuse_if(
        version != VERSION,
        f"{name}: header: expected version {VERSION}, got {version!r}",
        remedy="bake it again with this splatctrl",
    )
    return parsed


def check_layout(name: str, arrays: Mapping[str, tuple[str, tuple[int, ...]]]) -> Shape:
    """Cells along x, y, z of channels given as dtype and shape.

    Raises InputError without sdf, or for an unknown name, dtype or shape.
    """
    refuse_if(
        not {"sdf"} <= arrays.keys() <= CHANNELS.keys(),
        f"{name}: expected the channel sdf and any of {', '.join(list(CHANNELS)[1:])}, "
        f"got {', '.join(arrays) or 'none'}",
        remedy="give a grid that sdf-bake wrote",
    )
    cells = arrays["sdf"][1]
    refuse_if(
        len(cells) != 3 or min(cells) < 1,
        f"{name}: sdf: expected (X, Y, Z) cells, got {cells}",
        remedy="bake it again",
    )
    shape = (cells[0], cells[1], cells[2])
    for channel, got in arrays.items():
        expected = (CHANNELS[channel].dtype, CHANNELS[channel].shape(shape))
        refuse_if(
            got != expected,
            f"{name}: {channel}: expected {expected[0]} {expected[1]}, got {got[0]} {got[1]}",
            remedy="bake it again",
        )
    return shape


def check_grid(grid: DistanceGrid) -> Shape:
    """A grid's cells. Raises as `check_layout`."""
    return check_layout("grid to write", {name: (v.dtype.str, v.shape) for name, v in grid.channels.items()})


def check_finite(name: str, grid: DistanceGrid) -> None:
    """Raise InputError for a non-finite value; the policy `nan` allows NaN in channels that `may_be_unknown`."""
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


def slabs(values: Values) -> Iterator[Values]:
    """Yield x layers in runs of `CHUNK` bytes."""
    step = max(1, CHUNK // max(1, values.nbytes // len(values)))
    for start in range(0, len(values), step):
        yield np.ascontiguousarray(values[start : start + step])


def x_fastest(values: Values) -> Iterator[Values]:
    """Yield z planes, (z, y, x[, 3]), in runs of `CHUNK` bytes."""
    x, y, z = values.shape[:3]
    step = max(1, CHUNK // max(1, values.nbytes // z))
    for start in range(0, z, step):
        planes = np.empty((min(step, z - start), y, x, *values.shape[3:]), values.dtype)
        for at in range(0, x, TILE):
            planes[:, :, at : at + TILE] = values[at : at + TILE, :, start : start + step].transpose(
                2, 1, 0, *range(3, values.ndim)
            )
        yield planes


@dataclass(frozen=True, kw_only=True)
class GridFormat:
    """A file format, in its module's ``ENTRIES``.

    `name`: the --formats value. `write`: to a path with `suffix`, or a file per channel if `is_per_channel`;
    InputError for invalid channels. `describe`: from a path and its first bytes; None for another kind. `needs`: at
    least one of these channels. `holds_unknown`: stores cells without a distance. `bytes_per_cell`: on disk, None for
    the sum of all channels. `check` raises UsageError without its library. `docs`: row in docs/artefacts.md: name |
    file | who opens it.
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
        stems = [f"{STEM}.{channel}" for channel in channels] if self.is_per_channel else [STEM]
        return tuple(f"{stem}{self.suffix}" for stem in stems)


def covers(first_cell: Any, voxel: float, shape: Any) -> dict[str, object]:
    """Cells, extent, and first and last cell's centres [m]."""
    first, sides = np.asarray(first_cell, np.float64), voxel * (np.asarray(shape) - 1)
    return {
        "shape": [int(n) for n in shape],
        "extent_m": np.round(sides, 6).tolist(),
        "first_cell": np.round(first, 6).tolist(),
        "last_cell": np.round(first + sides, 6).tolist(),
        "voxel": voxel,
    }


def header_facts(header: Mapping[str, Any]) -> dict[str, object]:
    return {key: header[key] for key in FIELD_FACTS if header.get(key) is not None}


def summary_of(path: Path, kind: str, grid: DistanceGrid) -> Summary:
    table = Grid(
        name="channels",
        header=("channel", "dtype", "unit"),
        rows=[[name, CHANNELS[name].dtype.lstrip("<|"), CHANNELS[name].unit or "-"] for name in grid.channels],
    )
    facts = {**covers(grid.origin, grid.voxel, grid.channels["sdf"].shape), **header_facts(grid.header)}
    return Summary(path=str(path), kind=kind, facts=facts, grids=(table,))


def json_value(text: object) -> object:
    try:
        return json.loads(text) if isinstance(text, str) else text
    except ValueError:
        return text


PROGRESS = "progress.json"


@dataclass(frozen=True, kw_only=True)
class SlabPlan:
    """A bake's plan: origin, voxel [m], cells, channels, settings (JSON)."""

    origin: tuple[float, float, float]
    voxel: float
    shape: Shape
    channels: tuple[str, ...]
    settings: Mapping[str, object] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        plain: dict[str, object] = json.loads(json.dumps(asdict(self)))
        return plain


class GridSlabs:
    """A `SlabPlan` in `folder`: `num_layers` of x are on disk, with the baker's `counts`."""

    def __init__(
        self, folder: Path, plan: SlabPlan, num_layers: int, counts: Mapping[str, int] | None = None
    ) -> None:
        self.folder, self.plan = folder, plan
        self.num_layers, self.counts = num_layers, counts or {}

    def write(self, slab: Mapping[str, Values], counts: Mapping[str, int] | None = None) -> None:
        """Write the next x layers, ``(L, Y, Z[, 3])`` per channel, then the progress.

        counts: the baker's so far. Raises InputError if channels or shapes differ from the plan.
        """
        refuse_if(
            slab.keys() != set(self.plan.channels),
            f"slab: expected the channels {', '.join(self.plan.channels)}, got {', '.join(slab)}",
        )
        num = len(slab[self.plan.channels[0]])
        for name in self.plan.channels:
            expected = (CHANNELS[name].dtype, CHANNELS[name].shape((num, *self.plan.shape[1:])))
            values = slab[name]
            refuse_if(
                (values.dtype.str, values.shape) != expected or num + self.num_layers > self.plan.shape[0],
                f"slab: {name} at layer {self.num_layers} of {self.plan.shape[0]}: expected {expected}, "
                f"got {(values.dtype.str, values.shape)}",
            )
            path = self.folder / f"{name}.npy"
            layer = np.dtype(CHANNELS[name].dtype).itemsize * int(
                np.prod(CHANNELS[name].shape((1, *self.plan.shape[1:])))
            )
            with path.open("r+b") as stream:
                stream.seek(path.stat().st_size - layer * (self.plan.shape[0] - self.num_layers))
                stream.write(np.ascontiguousarray(values).data)
                stream.flush()
                os.fsync(stream.fileno())
        self.num_layers += num
        self.counts = counts or {}
        _write_progress(self.folder, self.plan, self.num_layers, self.counts)

    def is_whole(self) -> bool:
        return self.num_layers == self.plan.shape[0]

    def grid(self, header: Mapping[str, object]) -> DistanceGrid:
        """Open as read-only memory maps. Raises InputError before the grid is whole."""
        refuse_if(
            not self.is_whole(),
            f"{self.folder}: expected {self.plan.shape[0]} layers, got {self.num_layers}",
            remedy="continue the bake",
        )
        channels: dict[str, Values] = {
            name: np.lib.format.open_memmap(self.folder / f"{name}.npy", mode="r") for name in self.plan.channels
        }
        return DistanceGrid(
            origin=np.array(self.plan.origin, np.float64),
            voxel=self.plan.voxel,
            channels=channels,
            header=dict(header),
        )


def start_slabs(folder: Path, plan: SlabPlan) -> GridSlabs:
    """Create an empty store at full size. Raises OSError for a full disk."""
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
    """The store of an interrupted bake of this plan, or a new one.

    Raises UsageError naming another plan's differences, InputError if damaged.
    """
    try:
        progress = json.loads((folder / PROGRESS).read_text(encoding="utf-8"))
        left, num_layers, counts = dict(progress["plan"]), int(progress["num_layers"]), dict(progress["counts"])
    except FileNotFoundError:
        return start_slabs(folder, plan)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / PROGRESS}: not readable: {error!r}", remedy="bake without --resume") from None
    expected = plan.as_dict()
    differs = [key for key in expected if left.get(key) != expected[key]]
    changes = ", ".join(_difference(key, left.get(key), expected[key]) for key in differs)
    refuse_if(differs, f"{folder}: cannot be continued: {changes}", remedy="bake without --resume", error=UsageError)
    for name in plan.channels:
        path = folder / f"{name}.npy"
        size = CHANNELS[name].shape(plan.shape)
        try:
            shape = np.lib.format.open_memmap(path, mode="r").shape
        except (OSError, ValueError):  # not there, or cut
            shape = ()
        refuse_if(shape != size, f"{path}: expected {size}, got no such array", remedy="bake without --resume")
    return GridSlabs(folder, plan, num_layers, counts)


def _difference(key: str, left: object, expected: object) -> str:
    if isinstance(left, dict) and isinstance(expected, dict):
        names = sorted(name for name in {*left, *expected} if left.get(name) != expected.get(name))
        return ", ".join(f"{name} was {left.get(name)!r}, is {expected.get(name)!r}" for name in names)
    return f"{key} was {left!r}, is {expected!r}"


def _write_progress(folder: Path, plan: SlabPlan, num_layers: int, counts: Mapping[str, int]) -> None:
    progress = {"plan": plan.as_dict(), "num_layers": num_layers, "counts": counts}
    write_durably(folder / PROGRESS, lambda path: write_json(path, progress))

"""A distance grid: layout, memory, views of cameras, distance field, never-seen cells."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_cdt, distance_transform_edt

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import InputError, UsageError, refuse_if, require
from splatctrl_cli.field.clusters import checked_points
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import (
    Bool,
    Box,
    Columns,
    DistanceGrid,
    Float32,
    Float64,
    SplatSet,
    UInt8,
    Values,
)
from splatctrl_cli.voxels import OccupancyGrid, VoxelState

PROC, CGROUP = Path("/proc"), Path("/sys/fs/cgroup")

RESOLUTION = 2e-6  # [m] float32 distances that differ by less are the same
HALF_DIAGONAL = 0.5 * 3.0**0.5  # of a cell, in voxels
LOSS = 2.0 * HALF_DIAGONAL  # largest loss of the certified distance, in voxels

Shape = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class GridLayout:
    """Cells of `voxel` [m], centred at ``origin + voxel (i, j, k)``, world."""

    origin: Float64
    voxel: float
    shape: Shape

    @classmethod
    def over(cls, box: Box, voxel: float) -> "GridLayout":
        """Cover a box with cell centres from its lower corner, at least two per axis.

        Raises UsageError for a voxel or box without size.
        """
        refuse_if(
            not (np.isfinite(voxel) and voxel > 0), f"voxel: expected a size above 0 m, got {voxel}", error=UsageError
        )
        extent = box.upper - box.lower
        refuse_if(
            not np.isfinite(extent).all() or not (extent > 0).all(),
            f"box: expected lower < upper along each axis, got {box.lower.tolist()}, {box.upper.tolist()}",
            error=UsageError,
        )
        x, y, z = (max(2, int(np.ceil(side / voxel - 1e-6)) + 1) for side in extent)
        return cls(origin=box.lower.copy(), voxel=voxel, shape=(x, y, z))

    @property
    def box(self) -> Box:
        """Box of the cell centres."""
        return Box(lower=self.origin, upper=self.origin + self.voxel * (np.array(self.shape) - 1))

    @property
    def num_cells(self) -> int:
        return self.shape[0] * self.shape[1] * self.shape[2]


def bounding_box(splats: SplatSet, padding: float) -> Box:
    """Box of the spheres, widened by `padding` [m] per side."""
    lower = (splats.centers - splats.radii[:, None]).min(axis=0).astype(np.float64)
    upper = (splats.centers + splats.radii[:, None]).max(axis=0).astype(np.float64)
    return Box(lower=lower - padding, upper=upper + padding)


def check_loss(voxel: float, max_loss: float) -> None:
    """Raise UsageError if cells of `voxel` [m] may lose more than max_loss [m] of distance.

    The certified distance loses at most a diagonal, ``sqrt(3) voxel``; interpolation loses half.
    """
    loss = LOSS * voxel
    if loss > max_loss:
        largest = math.floor(max_loss / LOSS * 1e4) / 1e4
        raise UsageError(
            f"field.voxel: expected at most {largest:g} m, which loses up to field.max_loss = {max_loss:g} m of"
            f" clearance, got {voxel:g} m, which loses up to {loss:.4g} m",
            remedy=f"give --voxel {largest:g} or less",
        )


def check_memory(layout: GridLayout, bytes_per_cell: int) -> None:
    """Raise UsageError if a grid needs more memory than is free."""
    needed, free = bytes_per_cell * layout.num_cells, available_memory()
    size = " x ".join(str(n) for n in layout.shape)
    refuse_if(
        needed > free,
        f"grid of {size} cells: needs {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB is free",
        remedy="give a larger --voxel or a smaller --box; the command sdf-bake keeps a grid on disk",
        error=UsageError,
    )


def check_room(what: str, needed: int, remedy: str) -> None:
    """Raise UsageError if `what` needs more memory [bytes] than is free."""
    free = available_memory()
    refuse_if(
        needed > free,
        f"{what} needs {needed / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB is free",
        remedy=remedy,
        error=UsageError,
    )


def available_memory() -> int:
    """Bytes free without swapping, within the control group's limit."""
    for line in (PROC / "meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return min([int(line.split()[1]) * 1024, *_group_room()])
    raise UsageError("/proc/meminfo: no MemAvailable line", remedy="run on Linux 3.14 or newer")


def _group_room() -> list[int]:
    try:
        limit = (CGROUP / "memory.max").read_text(encoding="ascii").strip()
        used = int((CGROUP / "memory.current").read_text(encoding="ascii"))
    except OSError:
        return []
    return [] if limit == "max" else [max(int(limit) - used, 0)]


def observed_planes(
    occupancy: OccupancyGrid | None, layout: GridLayout, thresholds: OccupancyConfig, first: int, last: int
) -> UInt8:
    """`VoxelState` (last - first, Y, Z) at centres of x-planes [first, last).

    Cells are never seen outside the occupancy grid, or without a grid.
    """
    observed = np.full((last - first, *layout.shape[1:]), VoxelState.NEVER_SEEN, dtype=np.uint8)
    if occupancy is None:
        return observed
    states = occupancy.states(thresholds.free_below, thresholds.occupied_above)
    nodes, inside = [], []
    for axis, cells in enumerate((np.arange(first, last), np.arange(layout.shape[1]), np.arange(layout.shape[2]))):
        centers = layout.origin[axis] + layout.voxel * cells
        node = np.floor((centers - occupancy.origin[axis]) / occupancy.voxel + 0.5).astype(np.int64)
        is_inside = (node >= 0) & (node < states.shape[axis])
        nodes.append(node[is_inside])
        inside.append(np.flatnonzero(is_inside))
    observed[np.ix_(*inside)] = states[np.ix_(*nodes)]
    return observed


class GridField:
    """Trilinear interpolation between cell centres.

    Outside the box of centres: the value at its nearest point minus the distance to it, a lower bound. Next to a NaN
    cell (policy ``nan``), it and `certified` are NaN.
    """

    def __init__(self, grid: DistanceGrid, channel: str = "sdf") -> None:
        """Raises InputError without the channel or for one cell along an axis."""
        refuse_if(
            channel not in grid.channels,
            f"distance grid: no channel {channel!r}",
            remedy=f"it has: {', '.join(grid.channels)}",
        )
        self._values = np.ascontiguousarray(grid.channels[channel], dtype=np.float32)
        refuse_if(
            self._values.ndim != 3 or min(self._values.shape) < 2,
            f"distance grid: expected at least 2 cells along each axis, got {self._values.shape}",
            remedy="bake a larger box or a smaller voxel",
        )
        self._has_blank = bool(np.isnan(self._values).any())
        bound = grid.channels.get("bound")
        self._bound = None if bound is None else np.ascontiguousarray(bound, dtype=np.float32)
        self._origin = np.ascontiguousarray(grid.origin, dtype=np.float64)
        self._voxel = grid.voxel
        self.box = Box(lower=self._origin, upper=self._origin + grid.voxel * (np.array(self._values.shape) - 1))

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and the interpolant's gradient, as in `DistanceField.query`."""
        return native.interpolate(self._values, self._origin, self._voxel, checked_points(points))

    def certified(self, points: Float64) -> Float64:
        """Lower bound (Q,) [m] of the exact distance to splats, not to objects.

        ``max over the corners of (hard(corner) - |x - corner|)``, less rounding. NaN where `query` gives NaN. Raises
        InputError without the channel bound.
        """
        bound = require(self._bound, "distance grid: no channel 'bound'", remedy="bake it with --channels sdf,bound")
        # The channel bounds a whole cell: at its centre the exact distance is half a diagonal more.
        lowest = native.lipschitz_bound(bound, self._origin, self._voxel, checked_points(points))
        certified = np.asarray(lowest + HALF_DIAGONAL * self._voxel)
        if self._has_blank:
            certified[np.isnan(self.query(points)[0])] = np.nan
        return certified


def exact_channel(grid: DistanceGrid) -> Float32:
    """Exact distance (X, Y, Z) [m]: the channel hard, or bound plus its margin.

    Raises InputError without these channels.
    """
    if "hard" in grid.channels:
        return np.asarray(grid.channels["hard"], dtype=np.float32)
    margin = grid.header.get("bound_margin")
    if "bound" not in grid.channels or not isinstance(margin, float):
        raise InputError("distance grid: no channel 'hard' or 'bound'", remedy="bake it with --channels sdf,bound")
    return np.asarray(grid.channels["bound"], dtype=np.float32) + np.float32(margin)


BLANKED = ("sdf", "gradient", "probability")  # by policy nan
ROUNDING = 1e-6  # [m], and share of a distance: rounding of float32
BOUND = (
    "no point of the cell is nearer to a splat's sphere or a never-seen cell; "
    "bound + bound_margin is the lesser of hard and the distance to never-seen cells at its centre"
)

Channels = dict[str, Values]


def blank(channels: Mapping[str, Values], is_unknown: Bool) -> Channels:
    """Set distance, gradient, probability (X, Y, Z) to NaN where unknown."""
    blanked = dict(channels)
    for name in BLANKED:
        if name in channels:
            where = is_unknown if channels[name].ndim == 3 else is_unknown[..., None]
            blanked[name] = np.where(where, np.float32(np.nan), channels[name])
    return blanked


@dataclass(frozen=True, kw_only=True)
class Cubes(Columns):
    """The never-seen cells (X, Y, Z) of a grid as solid cubes.

    distance: lower bound [m] of the signed distance from cell centres; away (..., 3): unit vectors along which it
    grows.
    """

    is_unknown: Bool
    distance: Float32
    away: Float32

    @classmethod
    def of(cls, is_unknown: Bool, voxel: float) -> "Cubes":
        """Bound the distances in a grid with known and unknown cells.

        Outside cubes: the larger of the nearest centre's distance minus half a diagonal, and the chessboard distance
        minus half a cell. Inside: half a cell minus the distance to the nearest known centre.
        """
        indices = np.indices(is_unknown.shape, dtype=np.int32)
        distance, nearest = distance_transform_edt(~is_unknown, return_indices=True)
        away = (indices - nearest).astype(np.float32)
        lowest = np.maximum(distance - HALF_DIAGONAL, distance_transform_cdt(~is_unknown, "chessboard") - 0.5)
        distance, nearest = distance_transform_edt(is_unknown, return_indices=True)
        np.copyto(away, nearest - indices, where=is_unknown, casting="same_kind")
        lowest = np.where(is_unknown, 0.5 - distance, lowest)
        away /= np.sqrt(np.square(away).sum(axis=0))
        return cls(
            is_unknown=is_unknown,
            distance=(voxel * lowest - ROUNDING * (1.0 + voxel * np.abs(lowest))).astype(np.float32),
            away=np.moveaxis(away, 0, -1),
        )

    def join(self, channels: Mapping[str, Values], bound_margin: float) -> tuple[Channels, int]:
        """Channels of field or cubes, whichever is nearer, and the number of changed cells."""
        joined = dict(channels)
        is_nearer = np.asarray(self.distance < np.asarray(channels["sdf"], dtype=np.float32))
        joined["sdf"] = np.where(is_nearer, self.distance, channels["sdf"])
        if "gradient" in channels:
            joined["gradient"] = np.where(is_nearer[..., None], self.away, channels["gradient"])
        if "bound" in channels:
            joined["bound"] = np.minimum(channels["bound"], self.distance - np.float32(bound_margin))
        if "probability" in channels:
            joined["probability"] = np.where(self.is_unknown, np.float32(1.0), channels["probability"])
        return joined, int(np.count_nonzero(is_nearer))

"""Layout of a distance grid, its memory, and what cameras saw in it."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Box, Float64, SplatSet, UInt8
from splatctrl_cli.voxels import OccupancyGrid, VoxelState

PROC, CGROUP = Path("/proc"), Path("/sys/fs/cgroup")

RESOLUTION = 2e-6  # [m] float32 distances nearer than this are the same
HALF_DIAGONAL = 0.5 * 3.0**0.5  # of a cell, in voxels
LOSS = 2.0 * HALF_DIAGONAL  # largest loss of the certified distance, in voxels

Shape = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class GridLayout:
    """Cells of `voxel` [m], centred at ``origin + voxel (i, j, k)``, world [m]."""

    origin: Float64
    voxel: float
    shape: Shape

    @classmethod
    def over(cls, box: Box, voxel: float) -> "GridLayout":
        """Cover a box with centres, from lower corner to upper or just beyond, two at least.

        Raises UsageError for a voxel or box without size.
        """
        if not (np.isfinite(voxel) and voxel > 0):
            raise UsageError(f"voxel: expected a size above 0 m, got {voxel}")
        extent = box.upper - box.lower
        if not np.isfinite(extent).all() or not (extent > 0).all():
            raise UsageError(
                f"box: expected lower < upper along each axis, got {box.lower.tolist()}, {box.upper.tolist()}"
            )
        x, y, z = (max(2, int(np.ceil(side / voxel - 1e-6)) + 1) for side in extent)
        return cls(origin=box.lower.copy(), voxel=voxel, shape=(x, y, z))

    @property
    def box(self) -> Box:
        """Box of the cell centres."""
        return Box(lower=self.origin, upper=self.origin + self.voxel * (np.array(self.shape) - 1))

    @property
    def num_cells(self) -> int:
        """X Y Z."""
        return self.shape[0] * self.shape[1] * self.shape[2]


def bounding_box(splats: SplatSet, padding: float) -> Box:
    """Box of the spheres, widened by `padding` [m] per side."""
    lower = (splats.centers - splats.radii[:, None]).min(axis=0).astype(np.float64)
    upper = (splats.centers + splats.radii[:, None]).max(axis=0).astype(np.float64)
    return Box(lower=lower - padding, upper=upper + padding)


def check_loss(voxel: float, max_loss: float) -> None:
    """Raise UsageError if cells of `voxel` [m] may lose more than max_loss [m] of distance.

    The certified distance is ``max_c (hard(c) - |x - c|)`` over eight centres c around x. One is within half a
    diagonal, and hard is 1-Lipschitz, ``hard(c) >= hard(x) - |x - c|``: the loss is at most a diagonal, ``sqrt(3)
    voxel``, as between eight balls around the centres. Interpolation errs by at most half of that.
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
    if needed > free:
        size = " x ".join(str(n) for n in layout.shape)
        raise UsageError(
            f"grid of {size} cells: needs {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB is free",
            remedy="give a larger --voxel or a smaller --box; the command sdf-bake keeps a grid on disk",
        )


def check_room(what: str, needed: int, remedy: str) -> None:
    """Raise UsageError if `what` needs more memory [bytes] than is free."""
    free = available_memory()
    if needed > free:
        raise UsageError(
            f"{what} needs {needed / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB is free", remedy=remedy
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

    Never seen outside the occupancy grid, or without one.
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

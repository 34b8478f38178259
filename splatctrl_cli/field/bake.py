"""A distance field sampled on a regular grid, with what was observed beside it."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import FieldConfig, OccupancyConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.distance import GpdfField, SphereField
from splatctrl_cli.field.health import field_health
from splatctrl_cli.field.selection import DEFAULT_LABELS, field_splats, label_counts
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import Box, DistanceGrid, Float64, Label, OccupancyGrid, SplatSet, UInt8, VoxelState

FORMAT_VERSION = 1
BYTES_PER_CELL = 25  # three distances and three gradient components of 4 bytes, one of observed
PROC, CGROUP = Path("/proc"), Path("/sys/fs/cgroup")

Shape = tuple[int, int, int]


def bake(
    splats: SplatSet,
    box: Box,
    config: FieldConfig,
    *,
    occupancy: OccupancyGrid | None = None,
    thresholds: OccupancyConfig | None = None,
    labels: Collection[Label] = DEFAULT_LABELS,
    threads: int = 0,
) -> DistanceGrid:
    """Distances to the splats with one of `labels` at cells of size ``config.voxel`` that cover `box`.

    Channels: hard (eq. 6), gpdf (eq. 7-12, 15), sdf = min of the two, gradient of sdf (not normalised), observed
    (0 never seen, 1 free, 2 occupied, 3 uncertain; all 0 without an occupancy grid). The distances come from the
    splats alone: unknown space is not an obstacle, it is marked.

    Culling is exact for hard; gpdf is too large by at most the header's ``truncation_bound``. The same input gives
    the same bytes at any thread count. Raises UsageError for a bad box or one that does not fit the memory,
    NotEvaluableError where no splat is left, InputError for splats that are not finite.
    """
    chosen = field_splats(splats, labels)
    shape = grid_shape(box, config.voxel)
    check_memory(shape)
    exact = SphereField(chosen.centers, chosen.radii, threads=threads)
    smooth = GpdfField(
        chosen.centers,
        chosen.radii,
        config.length_scale,
        noise=config.noise,
        truncation=config.truncation,
        kernel=config.kernel,
        threads=threads,
    )
    baked = native.bake(
        exact.spheres,
        smooth.spheres,
        smooth.common_offset,
        smooth.kernel.length,
        smooth.kernel.truncation,
        box.lower - exact.anchor,
        config.voxel,
        shape,
        threads=threads,
    )
    channels: dict[str, NDArray[np.generic]] = {
        "sdf": baked.sdf,
        "gpdf": baked.gpdf,
        "hard": baked.hard,
        "gradient": baked.gradient,
        "observed": observed_channel(occupancy, box.lower, config.voxel, shape, thresholds or OccupancyConfig()),
    }
    header = _header(splats, chosen, labels, config, smooth)
    header["observed"] = "from the occupancy grid" if occupancy is not None else "no occupancy grid: all never seen"
    return DistanceGrid(origin=box.lower.copy(), voxel=config.voxel, channels=channels, header=header)


def bounding_box(splats: SplatSet, padding: float) -> Box:
    """The box of the splats' spheres, widened by `padding` [m] on every side."""
    lower = (splats.centers - splats.radii[:, None]).min(axis=0).astype(np.float64)
    upper = (splats.centers + splats.radii[:, None]).max(axis=0).astype(np.float64)
    return Box(lower=lower - padding, upper=upper + padding)


def grid_shape(box: Box, voxel: float) -> Shape:
    """Cells whose centres run from the box's lower corner to its upper one or just beyond.

    Raises UsageError for a voxel or a box without size.
    """
    if not (np.isfinite(voxel) and voxel > 0):
        raise UsageError(f"voxel: expected a size above 0 m, got {voxel}")
    extent = box.upper - box.lower
    if not np.isfinite(extent).all() or not (extent > 0).all():
        raise UsageError(
            f"box: expected lower < upper along each axis, got {box.lower.tolist()}, {box.upper.tolist()}"
        )
    x, y, z = (max(2, int(np.ceil(side / voxel - 1e-6)) + 1) for side in extent)
    return (x, y, z)


def check_memory(shape: Shape) -> None:
    """Raise UsageError where a grid of `shape` needs more memory than is free."""
    needed, free = BYTES_PER_CELL * shape[0] * shape[1] * shape[2], available_memory()
    if needed > free:
        size = " x ".join(str(n) for n in shape)
        raise UsageError(
            f"grid of {size} cells: needs {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB is free",
            remedy="give a larger --voxel or a smaller --box",
        )


def available_memory() -> int:
    """Bytes that can be had without swapping, by the kernel's own estimate and the limit on this process's group."""
    for line in (PROC / "meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return min([int(line.split()[1]) * 1024, *_group_room()])
    raise UsageError("/proc/meminfo: no MemAvailable line", remedy="run on Linux 3.14 or newer")


def _group_room() -> list[int]:
    """What a container may still take, where its control group says so."""
    try:
        limit = (CGROUP / "memory.max").read_text(encoding="ascii").strip()
        used = int((CGROUP / "memory.current").read_text(encoding="ascii"))
    except OSError:
        return []
    return [] if limit == "max" else [max(int(limit) - used, 0)]


def observed_channel(
    occupancy: OccupancyGrid | None, origin: Float64, voxel: float, shape: Shape, thresholds: OccupancyConfig
) -> UInt8:
    """What the occupancy voxel that holds each cell centre says (X, Y, Z); never seen outside the occupancy grid."""
    observed = np.full(shape, VoxelState.NEVER_SEEN, dtype=np.uint8)
    if occupancy is None:
        return observed
    states = occupancy.states(thresholds.free_below, thresholds.occupied_above)
    nodes, inside = [], []
    for axis in range(3):
        centers = origin[axis] + voxel * np.arange(shape[axis])
        node = np.floor((centers - occupancy.origin[axis]) / occupancy.voxel + 0.5).astype(np.int64)
        is_inside = (node >= 0) & (node < states.shape[axis])
        nodes.append(node[is_inside])
        inside.append(np.flatnonzero(is_inside))
    observed[np.ix_(*inside)] = states[np.ix_(*nodes)]
    return observed


def _header(
    splats: SplatSet, chosen: SplatSet, labels: Collection[Label], config: FieldConfig, smooth: GpdfField
) -> dict[str, object]:
    radii: Mapping[str, float] = {
        "min": float(chosen.radii.min()),
        "median": float(np.median(chosen.radii)),
        "mean": float(chosen.radii.mean(dtype=np.float64)),
        "max": float(chosen.radii.max()),
    }
    return {
        "format": "splatctrl distance grid",
        "version": FORMAT_VERSION,
        "sign": "positive outside",
        "frame": "world",
        "units": "m",
        "origin": "centre of cell (0, 0, 0)",
        "sdf": "min(gpdf, hard)",
        "gradient": "of sdf, not normalised",
        "kernel": config.kernel,
        "length_scale": config.length_scale,
        "noise": config.noise,
        "weights": "rowsum",
        "truncation": config.truncation,
        "truncation_bound": smooth.kernel.truncation_bound(),
        "unknown": "distances come from the splats alone; unknown space is marked in observed, not an obstacle",
        "inside": "a shell: cells deep inside a closed object read positive; take the sign there from observed",
        "labels": sorted(label.name.lower() for label in labels),
        "splats_given": label_counts(splats),
        "splats_used": label_counts(chosen),
        "radius": radii,
        "health": field_health(chosen.centers, chosen.radii, config.length_scale).as_dict(),
    }

"""Bakes of a grid, whole or in slabs of x-planes, with headers, health and statistics."""

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from splatctrl_cli.config import FieldConfig, OccupancyConfig, fixed
from splatctrl_cli.config.fixed import NEAR_ONE
from splatctrl_cli.errors import InputError, NotEvaluableError, refuse_if
from splatctrl_cli.field.baker import DEFAULT_CHANNELS, Baker, Planes
from splatctrl_cli.field.clusters import DEFAULT_LABELS, field_splats, label_counts
from splatctrl_cli.field.distance import KERNELS
from splatctrl_cli.field.grid_cells import (
    BOUND,
    RESOLUTION,
    Cubes,
    GridLayout,
    blank,
    check_memory,
    check_room,
    exact_channel,
    observed_planes,
)
from splatctrl_cli.formats.grid.grid_format import CHANNELS
from splatctrl_cli.kernels.field import BLOCK
from splatctrl_cli.records import Bool, Box, DistanceGrid, Floats, Label, SplatSet, UInt8
from splatctrl_cli.voxels import OccupancyGrid, VoxelState


def field_health(centers: Floats, radii: Floats, length: float, *, kernels: Collection[str]) -> dict[str, Any]:
    """Ratios of splats (N, 3), (N,) [m] that decide a field's quality, and warnings.

    kernels: se, gpdf; length [m]: their scale. spacing [m]: `median_spacing`. radius [m]: median. planar_zero_level
    [m]: of the kernel field.
    """
    spacing, radius = median_spacing(centers), float(np.median(radii))
    zero_level = planar_zero_level(radius, length)
    return {
        "spacing": spacing,
        "radius": radius,
        "spacing_per_length": spacing / length,
        "radius_per_spacing": radius / spacing if spacing > 0 else None,
        "radius_per_length": radius / length,
        "planar_zero_level": zero_level,
        "warnings": (
            *_warnings(spacing, radius, length, zero_level, kernels),
            *_set_warnings(centers, radii, length, has_kernel=bool(kernels)),
        ),
    }


def _warnings(
    spacing: float, radius: float, length: float, zero_level: float, kernels: Collection[str]
) -> Iterable[str]:
    if radius < spacing / np.sqrt(2):
        yield (
            f"radius {radius * 1e3:.1f} mm is below spacing / sqrt 2 = {spacing / np.sqrt(2) * 1e3:.1f} mm: "
            "the exact field's surface has holes between splats; reconstruct with more splats (--max-splats)"
        )
    if kernels and spacing > length:
        yield (
            f"spacing {spacing * 1e3:.1f} mm exceeds the length scale {length * 1e3:.1f} mm: "
            "the kernel field does not join neighbouring splats; give a larger --length-scale, or more splats"
        )
    if "gpdf" in kernels and zero_level - radius > length:
        yield (
            f"the surface of gpdf lies {zero_level * 1e3:.1f} mm before a dense plane of splats, "
            f"{(zero_level - radius) * 1e3:.1f} mm beyond their radius; a smaller length scale brings it closer"
        )


def _set_warnings(centers: Floats, radii: Floats, length: float, *, has_kernel: bool) -> Iterable[str]:
    extent = float(np.ptp(centers.astype(np.float64), axis=0).max())
    if len(centers) > 1 and extent == 0.0:
        yield f"all {len(centers)} splats have one centre: the field is that of the largest; check the file"
    elif has_kernel and len(centers) > 1 and length > extent:
        yield (
            f"the length scale {length:g} m exceeds the extent of the splats, {extent:.3g} m: "
            "the kernel field cannot tell them apart; give a smaller --length-scale"
        )
    if has_kernel and length >= fixed.ROUGH_LENGTH:
        yield f"the length scale {length:g} m is so large that rounding shows in the fields; give a smaller one"
    thick = radii[radii > 0]
    if len(thick) and thick.max() > fixed.MAX_RADIUS_SPREAD * thick.min():
        yield (
            f"radii from {thick.min() * 1e3:.3g} to {thick.max() * 1e3:.3g} mm in one set: "
            "the median radius describes neither end; check the splats' unit, metres"
        )


def median_spacing(centers: Floats) -> float:
    """Median distance from a splat (N, 3) [m] to the nearest other; 0 for fewer than two."""
    if len(centers) < 2:
        return 0.0
    points = np.asarray(centers, dtype=np.float64)
    return float(np.median(np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]))


def planar_zero_level(radius: float, length: float) -> float:
    """Height z [m] over a dense plane where the Matern row-sum field is zero.

    The field is ``z - l log(1 + z / l) - r``: the integral of ``e^(-d/l)`` over a plane is
    ``2 pi l (z + l) e^(-z/l)``, the row sum ``2 pi l^2``.
    """
    z = radius + length * (1.0 + np.sqrt(2.0 * radius / length))
    for _ in range(50):
        z -= (z - length * float(np.log1p(z / length)) - radius) / max(z / (length + z), 1e-12)
    return float(max(z, 0.0))


MEANING = {
    "safe": "min(se, hard)",
    "safe_gpdf": "min(gpdf, hard)",
    "hard": "exact distance to the splats' spheres",
    "se": "squared-exponential field; hard where it has no value",
    "gpdf": "Matern-1/2 field of the paper; hard where it has no value",
}


def field_header(
    splats: SplatSet,
    chosen: SplatSet,
    labels: Collection[Label],
    baker: Baker,
    *,
    has_occupancy: bool,
    num_unrepresented: int = 0,
) -> dict[str, object]:
    """Header of a bake of `chosen`: splats with one of `labels`, then `num_unrepresented` balls."""
    config = baker.config
    header: dict[str, object] = {
        "format": "splatctrl distance grid",
        "version": 2,
        "sign": "positive outside",
        "frame": "world",
        "units": "m",
        "origin": "centre of cell (0, 0, 0)",
        "distance": config.distance,
        "sdf": MEANING[config.distance],
        "gradient": "of sdf, not normalised",
        "bound": "no point of the cell is nearer to a splat's sphere; bound + bound_margin is hard at its centre",
        "bound_margin": baker.bound_margin,
        "kernel": {None: "none", "se": "squared exponential", "gpdf": "matern 1/2"}[baker.kernel_name],
        "length_scale": config.length_scale,
        "noise": config.noise,
        "weights": config.weights,
        "truncation_bound": config.truncation,
        "kernel_counts": dict(baker.counts),
        "unknown": config.unknown,
        "observed": "from the occupancy grid" if has_occupancy else "no occupancy grid: all never seen",
        "inside": "a shell: cells deep inside a closed object read positive; take the sign there from observed",
        "labels": sorted(label.name.lower() for label in labels),
        "splats_given": label_counts(splats),
        "splats_used": label_counts(chosen.select(np.arange(len(chosen)) < len(chosen) - num_unrepresented)),
        "unrepresented_voxels": num_unrepresented,
        "radius": {
            "min": float(chosen.radii.min()),
            "median": float(np.median(chosen.radii)),
            "mean": float(chosen.radii.mean(dtype=np.float64)),
            "max": float(chosen.radii.max()),
        },
        "health": field_health(chosen.centers, chosen.radii, config.length_scale, kernels=baker.kernels),
    }
    if baker.probability is not None:
        header |= {"probability": config.probability, "probability_numbers": baker.probability.described()}
    solved = {
        name: {"num_iterations": field.weights.num_iterations, "residual": field.weights.residual}
        for name, field in baker.kernels.items()
        if field.weights.num_iterations is not None
    }
    return header | ({"weights_solved": solved} if solved else {})


SLAB_BYTES = 48 << 20  # of a slab's channels; more if one block's planes need more
_CUBES = 64  # bytes per cell of the whole grid, to find the nearest never-seen cell
_CELL_BYTES = 64  # bytes per cell in a bake besides its channels, in at most 64 MiB or a block's planes


@dataclass(frozen=True, kw_only=True)
class EarlierBake:
    """An earlier bake, valid in blocks with `mask` 0, with new observations."""

    grid: DistanceGrid
    mask: UInt8
    occupancy: OccupancyGrid | None
    thresholds: OccupancyConfig


def bytes_per_cell(channels: Collection[str]) -> int:
    kinds = [CHANNELS[name] for name in channels if name in CHANNELS]
    return sum(np.dtype(kind.dtype).itemsize * kind.components for kind in kinds)


def slabs(layout: GridLayout, channels: Collection[str], begin: int = 0) -> Iterator[tuple[int, int]]:
    """Yield the x-planes [first, last) of slabs of whole blocks, from `begin` on."""
    per_plane = bytes_per_cell(channels) * layout.shape[1] * layout.shape[2]
    step = BLOCK * max(1, SLAB_BYTES // (BLOCK * per_plane))
    for first in range(begin, layout.shape[0], step):
        yield first, min(first + step, layout.shape[0])


def check_slab_memory(layout: GridLayout, channels: Collection[str]) -> None:
    """Raise UsageError if one block's planes exceed the memory."""
    planes = min(BLOCK, layout.shape[0])
    check_room(
        f"slab of {' x '.join(map(str, (planes, *layout.shape[1:])))} cells:",
        planes * layout.shape[1] * layout.shape[2] * (bytes_per_cell(channels) + _CELL_BYTES),
        "give a larger --voxel, fewer --channels, or a --box that is shorter along y and z",
    )


class UnknownSpace:
    """Never-seen space in slabs, treated by the policy ``nan`` or ``obstacle``.

    ``nan``: no sdf, gradient or probability there. ``obstacle``: solid cubes of probability 1; sdf, gradient and
    bound are of the nearer of splats and cubes. Cells that only the robot swept are known
    (`VoxelState.SWEPT_BY_ROBOT`).

    num_never_seen, num_changed: cells so far.
    """

    def __init__(
        self, layout: GridLayout, config: FieldConfig, occupancy: OccupancyGrid | None, thresholds: OccupancyConfig
    ) -> None:
        """Raises NotEvaluableError if nothing was seen, UsageError without memory for obstacles."""
        self.policy = config.unknown
        self.num_never_seen = self.num_changed = 0
        self._is_unknown: Bool = np.concatenate(
            [
                observed_planes(occupancy, layout, thresholds, first, last) == VoxelState.NEVER_SEEN
                for first, last in slabs(layout, ["gradient"])
            ]
        )
        refuse_if(
            self._is_unknown.all(),
            f"field.unknown = {self.policy}: expected a cell that a camera saw, got none of {layout.num_cells}",
            remedy="bake a scene with an occupancy grid, check --box, or set field.unknown = free",
            error=NotEvaluableError,
        )
        self._cubes: Cubes | None = None
        if self.policy == "obstacle" and self._is_unknown.any():
            remedy = "give a larger --voxel, a smaller --box, or --unknown nan, which needs less"
            check_room("field.unknown = obstacle:", _CUBES * layout.num_cells, remedy)
            self._cubes = Cubes.of(self._is_unknown, layout.voxel)

    def apply(self, planes: Planes, first: int, last: int, bound_margin: float) -> Planes:
        """Treat channels of x-planes [first, last) by the policy."""
        is_unknown = self._is_unknown[first:last]
        num_unknown = int(np.count_nonzero(is_unknown))
        self.num_never_seen += num_unknown
        if self.policy == "nan":
            self.num_changed += num_unknown
            return blank(planes, is_unknown)
        if self._cubes is None:
            return planes
        treated, num_changed = self._cubes.select(slice(first, last)).join(planes, bound_margin)
        self.num_changed += num_changed
        return treated

    def header(self) -> dict[str, object]:
        """The changes of a header."""
        return {
            **({"bound": BOUND} if self.policy == "obstacle" else {}),
            "unknown": self.policy,
            "unknown_cells": {"never_seen": self.num_never_seen, "changed": self.num_changed},
        }


def bake_planes(baker: Baker, first: int, last: int, earlier: EarlierBake | None = None) -> Planes:
    """Channels of x-planes [first, last), before `UnknownSpace`; channels of `earlier` are copied."""
    planes = baker.allocate(last - first)
    if earlier is None:
        baker.bake(first, last, planes)
        return planes
    for name, values in planes.items():
        values[...] = earlier.grid.channels[name][first:last]
    if earlier.mask[first // BLOCK : -(-last // BLOCK)].any():
        baker.bake(first, last, planes, earlier.mask)
    if "observed" in planes:
        planes["observed"] = observed_planes(earlier.occupancy, baker.layout, earlier.thresholds, first, last)
    return planes


def bake(
    splats: SplatSet,
    box: Box,
    config: FieldConfig,
    *,
    channels: Collection[str] = DEFAULT_CHANNELS,
    occupancy: OccupancyGrid | None = None,
    thresholds: OccupancyConfig | None = None,
    labels: Collection[Label] = DEFAULT_LABELS,
    threads: int = 0,
) -> DistanceGrid:
    """Bake distances to splats with one of `labels` in cells of ``config.voxel`` over `box`.

    channels: of `CHANNELS`, with sdf. Culling is exact for hard; with row sums, a kernel field is too large by at
    most ``config.truncation``. Bytes do not depend on threads. Raises UsageError for a bad or too large box,
    NotEvaluableError without splats, InputError for non-finite splats.
    """
    chosen = field_splats(splats, labels)
    layout = GridLayout.over(box, config.voxel)
    check_memory(layout, bytes_per_cell(channels))
    baker = Baker(
        chosen, layout, config, channels=channels, occupancy=occupancy, thresholds=thresholds, threads=threads
    )
    planes = bake_planes(baker, 0, layout.shape[0])
    header = field_header(splats, chosen, labels, baker, has_occupancy=occupancy is not None)
    if config.unknown != "free":
        unknown = UnknownSpace(layout, config, occupancy, thresholds or OccupancyConfig())
        planes = unknown.apply(planes, 0, layout.shape[0], baker.bound_margin)
        header |= unknown.header()
    return DistanceGrid(origin=layout.origin, voxel=layout.voxel, channels=planes, header=header)


BIN = 0.05  # bin k of the histogram counts lengths about k times this
NUM_BINS = 41  # lengths of about 0 to 2; the last bin also counts longer ones


def grid_statistics(grid: DistanceGrid) -> dict[str, Any]:
    """Statistics of a grid, as in ``field.json``; None or empty without their channel.

    num_blank: cells with sdf NaN. num_inside: cells with sdf <= 0. lowest, highest [m]: of sdf. observed: cells by
    state. hard_share: of cells with exact sdf. never_seen_share: of cells neither seen nor swept. excess, by kernel
    field: count and share of cells over the exact distance, and largest excess [m].

    gradient: its lengths, 1 for a distance (Eikonal equation). histogram: bin k counts lengths within half a
    `bin_width` of k `bin_width`; the last bin also counts longer ones. share_near_one: within 0.05 of 1.
    """
    sums, most = dict[str, Any](), dict[str, float]()
    for part in _parts(grid):  # a few planes at a time: channels may be memory maps
        counted, largest = _measure(part)
        sums |= {name: value + sums.get(name, 0) for name, value in counted.items()}
        most |= {name: max(value, most.get(name, -np.inf)) for name, value in largest.items()}
    num, num_lengths = sums["cells"], 0 if "lengths" not in sums else int(sums["lengths"].sum())
    has_states = "states" in sums
    observed = {state.name.lower(): int(sums["states"][state]) for state in VoxelState} if has_states else None
    return {
        "num_cells": num,
        "num_blank": sums["blank"],
        "num_inside": sums["inside"],
        "lowest": -most["lowest"] if "lowest" in most else None,
        "highest": most.get("highest"),
        "observed": observed,
        "hard_share": sums["hard"] / num if "hard" in sums else None,
        "excess": {
            name: {"count": sums[name], "share": sums[name] / num, "largest": max(most[name], 0.0)}
            for name in KERNELS
            if name in sums
        },
        "gradient": None
        if not num_lengths
        else {
            "histogram": tuple(int(count) for count in sums["lengths"]),
            "bin_width": BIN,
            "largest": most["length"],
            "mean": sums["length"] / num_lengths,
            "share_near_one": sums["near_one"] / num_lengths,
        },
        "never_seen_share": None if observed is None else observed["never_seen"] / num,
    }


def _measure(part: DistanceGrid) -> tuple[dict[str, Any], dict[str, float]]:
    """Counts and sums of some planes, and their largest values; lowest is negated."""
    channels, sdf = part.channels, np.asarray(part.channels["sdf"], np.float32)
    known = sdf[np.isfinite(sdf)]
    inside = int(np.count_nonzero(known <= 0))
    sums: dict[str, Any] = {"cells": sdf.size, "blank": sdf.size - known.size, "inside": inside}
    most = {"lowest": -float(known.min()), "highest": float(known.max())} if known.size else {}
    if "observed" in channels:
        sums["states"] = np.bincount(channels["observed"].ravel(), minlength=len(VoxelState))
    if "gradient" in channels:
        gradient = np.asarray(channels["gradient"], np.float32)
        lengths = np.sqrt(np.einsum("...i,...i->...", gradient, gradient)).ravel()
        lengths = lengths[np.isfinite(lengths)]
        bins = np.minimum((lengths / BIN + 0.5).astype(np.int64), NUM_BINS - 1)
        sums |= {"lengths": np.bincount(bins, minlength=NUM_BINS), "length": float(lengths.sum(dtype=np.float64))}
        sums["near_one"] = int(np.count_nonzero(np.abs(lengths - 1.0) <= NEAR_ONE))
        most["length"] = float(lengths.max(initial=0.0))
    if part.header.get("unknown") == "obstacle" and "hard" not in channels:
        return sums, most  # bound is then of unknown space, too
    with suppress(InputError):  # the grid has no exact distance
        exact = exact_channel(part)
        sums["hard"] = int(np.count_nonzero(np.abs(sdf - exact) <= RESOLUTION))
        for name in (name for name in KERNELS if name in channels):
            over = np.asarray(channels[name], np.float32) - exact
            sums[name], most[name] = int(np.count_nonzero(over > RESOLUTION)), float(over.max())
    return sums, most


def _parts(grid: DistanceGrid) -> Iterator[DistanceGrid]:
    num_planes, *rest = grid.channels["sdf"].shape
    step = max(1, (1 << 20) // int(np.prod(rest)))
    for first in range(0, num_planes, step):
        yield DistanceGrid(
            origin=grid.origin,
            voxel=grid.voxel,
            channels={name: values[first : first + step] for name, values in grid.channels.items()},
            header=grid.header,
        )

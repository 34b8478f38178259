"""Statistics of a baked grid."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import NEAR_ONE
from splatctrl_cli.errors import InputError
from splatctrl_cli.field.distance import KERNELS
from splatctrl_cli.field.grid_cells import RESOLUTION, exact_channel
from splatctrl_cli.records import DistanceGrid, Float32
from splatctrl_cli.voxels import VoxelState

BIN = 0.05  # bin k of the histogram is about k times this length
NUM_BINS = 41  # about 0 to 2; the last one includes longer ones


@dataclass(frozen=True, kw_only=True)
class GradientLengths:
    """Gradient lengths: 1 for a distance (Eikonal equation), less where a kernel field is flat.

    histogram: bin k counts lengths within half a `bin_width` of k times that, the last also longer ones;
    share_near_one: within 0.05 of 1.
    """

    histogram: tuple[int, ...]
    bin_width: float
    largest: float
    mean: float
    share_near_one: float


@dataclass(frozen=True, kw_only=True)
class Excess:
    """Number and share of cells where a kernel field exceeds the exact distance; most [m]."""

    count: int
    share: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class GridStatistics:
    """Statistics of a grid; None or empty without channels for it.

    num_blank: sdf NaN; num_inside: sdf <= 0; lowest, highest: of sdf [m]; observed: cells by state; hard_share: of
    cells whose sdf is exact; excess: by kernel field.
    """

    num_cells: int
    num_blank: int
    num_inside: int
    lowest: float | None
    highest: float | None
    observed: Mapping[str, int] | None
    hard_share: float | None
    excess: Mapping[str, Excess]
    gradient: GradientLengths | None

    @property
    def never_seen_share(self) -> float | None:
        """Share of cells neither seen nor swept."""
        return None if self.observed is None else self.observed["never_seen"] / self.num_cells

    def as_dict(self) -> dict[str, object]:
        """Plain values, as in ``field.json``."""
        return {**asdict(self), "never_seen_share": self.never_seen_share}


def grid_statistics(grid: DistanceGrid) -> GridStatistics:
    """Statistics of a grid, a few planes at a time: channels may be memory maps."""
    sums, most = dict[str, Any](), dict[str, float]()
    for part in _parts(grid):
        counted, largest = _measure(part)
        sums |= {name: value + sums.get(name, 0) for name, value in counted.items()}
        most |= {name: max(value, most.get(name, -np.inf)) for name, value in largest.items()}
    num, num_lengths = sums["cells"], 0 if "lengths" not in sums else int(sums["lengths"].sum())
    return GridStatistics(
        num_cells=num,
        num_blank=sums["blank"],
        num_inside=sums["inside"],
        lowest=-most["lowest"] if "lowest" in most else None,
        highest=most.get("highest"),
        observed={state.name.lower(): int(sums["states"][state]) for state in VoxelState}
        if "states" in sums
        else None,
        hard_share=sums["hard"] / num if "hard" in sums else None,
        excess={
            name: Excess(count=sums[name], share=sums[name] / num, largest=max(most[name], 0.0))
            for name in KERNELS
            if name in sums
        },
        gradient=None
        if not num_lengths
        else GradientLengths(
            histogram=tuple(int(count) for count in sums["lengths"]),
            bin_width=BIN,
            largest=most["length"],
            mean=sums["length"] / num_lengths,
            share_near_one=sums["near_one"] / num_lengths,
        ),
    )


def _measure(part: DistanceGrid) -> tuple[dict[str, Any], dict[str, float]]:
    """Counts and sums of some planes, and their largest values; lowest: negative."""
    channels, sdf = part.channels, _floats(part, "sdf")
    known = sdf[np.isfinite(sdf)]
    inside = int(np.count_nonzero(known <= 0))
    sums: dict[str, Any] = {"cells": sdf.size, "blank": sdf.size - known.size, "inside": inside}
    most = {"lowest": -float(known.min()), "highest": float(known.max())} if known.size else {}
    if "observed" in channels:
        sums["states"] = np.bincount(channels["observed"].ravel(), minlength=len(VoxelState))
    if "gradient" in channels:
        gradient = _floats(part, "gradient")
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
            over = _floats(part, name) - exact
            sums[name], most[name] = int(np.count_nonzero(over > RESOLUTION)), float(over.max())
    return sums, most


def _floats(part: DistanceGrid, channel: str) -> Float32:
    return np.asarray(part.channels[channel], np.float32)


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

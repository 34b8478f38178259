"""Statistics of a baked grid."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import NEAR_ONE
from splatctrl_cli.errors import InputError
from splatctrl_cli.field.distance import KERNELS
from splatctrl_cli.field.grid_cells import RESOLUTION, exact_channel
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.voxels import VoxelState

BIN = 0.05  # bin k of the histogram is about k times this length
NUM_BINS = 41  # about 0 to 2; the last one includes longer ones


def grid_statistics(grid: DistanceGrid) -> dict[str, Any]:
    """Statistics of a grid, as in ``field.json``; None or empty without channels for it.

    A few planes at a time: channels may be memory maps. num_blank: sdf NaN; num_inside: sdf <= 0; lowest, highest: of
    sdf [m]; observed: cells by state; hard_share: of cells whose sdf is exact; never_seen_share: neither seen nor
    swept. excess, by kernel field: count and share of cells where it exceeds the exact distance, and the largest [m].

    gradient: its lengths, 1 for a distance (Eikonal equation). histogram: bin k counts lengths within half a
    `bin_width` of k times that, the last also longer ones; share_near_one: within 0.05 of 1.
    """
    sums, most = dict[str, Any](), dict[str, float]()
    for part in _parts(grid):
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
    """Counts and sums of some planes, and their largest values; lowest: negative."""
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

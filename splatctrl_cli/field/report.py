"""Statistics of a baked grid."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import NEAR_ONE
from splatctrl_cli.errors import InputError
from splatctrl_cli.field.grid_cells import RESOLUTION
from splatctrl_cli.field.grid_field import exact_channel
from splatctrl_cli.records import DistanceGrid, Float32
from splatctrl_cli.voxels import VoxelState

BIN = 0.05  # bin k of the histogram is about k times this length
NUM_BINS = 41  # about 0 to 2; the last one includes longer ones


@dataclass(frozen=True, kw_only=True)
class GradientLengths:
    """Gradient lengths: 1 for a distance (Eikonal equation), less where a kernel field is flat.

    histogram: bin k counts lengths within half a `bin_width` of k times that, the last bin also longer ones;
    share_near_one: within 0.05 of 1.
    """

    histogram: tuple[int, ...]
    bin_width: float
    largest: float
    mean: float
    share_near_one: float


@dataclass(frozen=True, kw_only=True)
class Excess:
    """Number and share of cells where a kernel field exceeds the exact distance, and by how much at most [m]."""

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
        """Return plain values, as in ``field.json``."""
        return {**asdict(self), "never_seen_share": self.never_seen_share}


def grid_statistics(grid: DistanceGrid) -> GridStatistics:
    """Statistics of a grid, by a few planes, as channels may be memory maps."""
    totals = _Totals()
    for part in _parts(grid):
        totals.add(part)
    return totals.statistics()


class _Totals:
    def __init__(self) -> None:
        self.num_cells = self.num_blank = self.num_inside = self.num_hard = 0
        self.lowest, self.highest = np.inf, -np.inf
        self.states: NDArray[np.int64] | None = None
        self.has_exact = False
        self.excess: dict[str, tuple[int, float]] = {}
        self.lengths: NDArray[np.int64] | None = None
        self.longest = self.length_sum = 0.0
        self.num_near_one = 0

    def add(self, part: DistanceGrid) -> None:
        sdf = part.channels["sdf"]
        known = sdf[np.isfinite(sdf)]
        self.num_cells += sdf.size
        self.num_blank += sdf.size - known.size
        self.num_inside += int(np.count_nonzero(known <= 0))
        if known.size:
            self.lowest, self.highest = min(self.lowest, float(known.min())), max(self.highest, float(known.max()))
        if "observed" in part.channels:
            counts = np.bincount(part.channels["observed"].ravel(), minlength=len(VoxelState))
            self.states = counts if self.states is None else self.states + counts
        self._add_exact(part)
        if "gradient" in part.channels:
            self._add_gradient(_floats(part, "gradient"))

    def _add_exact(self, part: DistanceGrid) -> None:
        if part.header.get("unknown") == "obstacle" and "hard" not in part.channels:
            return  # bound is then of unknown space, too
        try:
            exact = exact_channel(part)
        except InputError:  # the grid has no exact distance
            return
        self.has_exact = True
        self.num_hard += int(np.count_nonzero(np.abs(_floats(part, "sdf") - exact) <= RESOLUTION))
        for name in ("se", "gpdf"):
            if name in part.channels:
                over = _floats(part, name) - exact
                count, largest = self.excess.get(name, (0, 0.0))
                self.excess[name] = (
                    count + int(np.count_nonzero(over > RESOLUTION)),
                    max(largest, float(over.max())),
                )

    def _add_gradient(self, gradient: Float32) -> None:
        lengths = np.sqrt(np.einsum("...i,...i->...", gradient, gradient)).ravel()
        lengths = lengths[np.isfinite(lengths)]
        bins = np.minimum((lengths / BIN + 0.5).astype(np.int64), NUM_BINS - 1)
        counts = np.bincount(bins, minlength=NUM_BINS)
        self.lengths = counts if self.lengths is None else self.lengths + counts
        self.longest = max(self.longest, float(lengths.max(initial=0.0)))
        self.length_sum += float(lengths.sum(dtype=np.float64))
        self.num_near_one += int(np.count_nonzero(np.abs(lengths - 1.0) <= NEAR_ONE))

    def statistics(self) -> GridStatistics:
        is_known = self.num_blank < self.num_cells
        num_lengths = 0 if self.lengths is None else int(self.lengths.sum())
        return GridStatistics(
            num_cells=self.num_cells,
            num_blank=self.num_blank,
            num_inside=self.num_inside,
            lowest=self.lowest if is_known else None,
            highest=self.highest if is_known else None,
            observed=None
            if self.states is None
            else {state.name.lower(): int(self.states[state]) for state in VoxelState},
            hard_share=self.num_hard / self.num_cells if self.has_exact else None,
            excess={
                name: Excess(count=count, share=count / self.num_cells, largest=largest)
                for name, (count, largest) in self.excess.items()
            },
            gradient=None
            if self.lengths is None or not num_lengths
            else GradientLengths(
                histogram=tuple(int(count) for count in self.lengths),
                bin_width=BIN,
                largest=self.longest,
                mean=self.length_sum / num_lengths,
                share_near_one=self.num_near_one / num_lengths,
            ),
        )


def _floats(part: DistanceGrid, channel: str) -> Float32:
    return np.asarray(part.channels[channel], np.float32)


def _parts(grid: DistanceGrid) -> Iterator[DistanceGrid]:
    num_planes, *rest = grid.channels["sdf"].shape
    step = max(1, (1 << 20) // int(np.prod(rest)))
    for first in range(0, num_planes, step):
        channels = {name: values[first : first + step] for name, values in grid.channels.items()}
        yield DistanceGrid(origin=grid.origin, voxel=grid.voxel, channels=channels, header=grid.header)

"""Intervals in which cells of a link's grid are robot: always, or during a grasp.

K configurations in order of time, N cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from splatctrl_cli.records import Array, Bool, Float32, Float64, Index, Stamps
from splatctrl_cli.robot.self_model import ALWAYS

VOXEL = 0.004  # [m]
TRUNCATION = 3 * VOXEL  # [m] before and behind a measured surface
LEAST_CELLS = 24  # of a part, 1.5 cm^3
NUM_CONFIGURATIONS = 5  # in which a cell must be a surface
TOUCHING = np.ones((3, 3, 3))  # neighbours in one piece: thin structures lie aslant
FEWER_CONFIGURATIONS = 3  # in which a cell next to such cells must be a surface
FREE_BESIDE = 0.5  # `FREE_SHARE` of such a cell
SURE_SHARE = 0.25  # of a piece's cells, which enough configurations must show
FREE_SHARE = 0.3  # of the configurations that see a cell; above it, the cell is not robot
FREE_WEIGHT = (1 - FREE_SHARE) / FREE_SHARE  # votes against a cell of a configuration that sees through it
AROUND = 7  # cells across: their votes choose an interval
GONE = 0.5  # of a part's cells, free less surface, in some configuration before and some after its interval
MOST_INTERVALS = 6  # of a link


@dataclass(frozen=True, kw_only=True)
class Fused:
    """Depth at a link's cells in each configuration (K, N), in order of time.

    total, weight float32: sum [m] and weight of distances to the surface, positive outside; seen: a surface is there;
    free: a ray passes.
    """

    total: Float32
    weight: Float32
    seen: Bool
    free: Bool

    def within(self, run: slice) -> tuple[Float64, Bool, Bool]:
        """Mean distance (N,) [m] of a run, or NaN; `seen` without `free`, and `free`, both (R, N)."""
        total, weight = self.total[run].sum(axis=0), self.weight[run].sum(axis=0)
        mean = np.where(weight > 0.5, total / np.maximum(weight, 1e-9), np.nan).astype(np.float64)
        return mean, self.seen[run] & ~self.free[run], self.free[run]

    def is_robot(self, gap: Float64, run: slice, least: int, most_free: float) -> Bool:
        """True for cells (N,) inside a surface that is robot.

        At least `least` configurations show the cell, at most a share `most_free` see through it. gap (N,) [m]: from
        the link's surface.
        """
        mean, seen, free = self.within(run)
        num, num_free = seen.sum(axis=0), free.sum(axis=0)
        is_robot = (num >= least) & (num_free <= most_free * (num + num_free))
        return np.asarray(is_robot & (np.maximum(np.nan_to_num(mean, nan=TRUNCATION), VOXEL - gap) < 0))

    def votes(self, run: slice) -> Float32:
        """Votes (N,) of a run: surface configurations less `FREE_WEIGHT` per free configuration."""
        num, num_free = (self.seen[run] & ~self.free[run]).sum(axis=0), self.free[run].sum(axis=0)
        return np.asarray(num - FREE_WEIGHT * num_free, np.float32)


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Configurations `first` to `last` of a link's part, with bounds [ns]."""

    first: int
    last: int
    start_ns: int = ALWAYS[0]
    end_ns: int = ALWAYS[1]


def _runs(fused: Fused) -> tuple[Index, Index]:
    num, N = fused.seen.shape
    best, sums = np.zeros(N, np.float32), np.zeros(N, np.float32)
    begun, first, last = (np.zeros(N, np.int64) for _ in range(3))
    for k in range(num):
        is_new = sums <= 0
        begun[is_new], sums[is_new] = k, 0
        sums += fused.votes(slice(k, k + 1))
        is_best = sums > best
        best[is_best], first[is_best], last[is_best] = sums[is_best], begun[is_best], k
    return first, last


def find_intervals(fused: Fused, mask: Bool, gap: Float64, stamps: Stamps) -> list[Interval]:
    """Whole recording, and intervals shared by the runs of enough connected cells.

    Configurations that see through a cell bound its run. Before and after a part's interval, some configuration sees
    through a share `GONE` of the part. mask (X, Y, Z): of the cells; gap (N,) [m] from the link's surface; stamps
    (K,) [ns].
    """
    num, rows = len(stamps), np.arange(len(stamps))[:, None]
    first, last = _runs(fused)
    inside = (rows >= first) & (rows <= last)
    before = np.where(fused.free & (rows < first), rows, -1).max(axis=0)
    after = np.where(fused.free & (rows > last), rows, num).min(axis=0)
    own = Fused(
        total=fused.total * inside, weight=fused.weight * inside, seen=fused.seen & inside, free=fused.free & inside
    )
    left = own.is_robot(gap, slice(num), NUM_CONFIGURATIONS, FREE_SHARE) & ((before >= 0) | (after < num))
    first, last = np.where(before < 0, 0, first), np.where(after == num, num - 1, last)
    intervals = [Interval(first=0, last=num - 1)]
    while len(intervals) < MOST_INTERVALS and np.count_nonzero(left) >= LEAST_CELLS:
        fits = np.zeros((num + 1, num + 1))
        for start, sign in ((before + 1, 1), (first + 1, -1)):
            np.add.at(fits, (start[left], last[left]), sign)
            np.add.at(fits, (start[left], np.where(after < num, after, num)[left]), -sign)
        start, end = np.unravel_index(np.argmax(fits.cumsum(axis=0).cumsum(axis=1)), fits.shape)
        its = left & (before < start) & (start <= first) & (last <= end) & (end < after)
        left &= ~its
        if np.count_nonzero(its) < LEAST_CELLS:
            break
        pieces, _ = ndimage.label(spread_cells(mask, its, 0))
        run = int(first[its].min()), int(last[its].max())
        gone = (fused.free[:, its].astype(int) - fused.seen[:, its]).mean(axis=1)
        sides = [gone[: run[0]]] * bool(start > 0) + [gone[run[1] + 1 :]] * bool(end < num - 1)
        is_gone = min(side.max() for side in sides) >= GONE
        if is_gone and np.bincount(pieces[pieces > 0]).max(initial=0) >= LEAST_CELLS:
            free_before, free_after = int(before[its].max()), int(after[its].min())
            intervals.append(
                Interval(
                    first=run[0],
                    last=run[1],
                    start_ns=ALWAYS[0] if free_before < 0 else int(stamps[free_before] + stamps[run[0]]) // 2,
                    end_ns=ALWAYS[1] if free_after == num else int(stamps[run[1]] + stamps[free_after]) // 2,
                )
            )
    return intervals


def choose_intervals(fused: Fused, mask: Bool, gap: Float64, intervals: Sequence[Interval]) -> Index:
    """Number (N,) of the interval in which each cell is robot, -1 for none.

    Votes of robot cells around the cell decide. In the first interval, the whole recording, cells next to robot cells
    need fewer configurations.
    """
    runs = [slice(interval.first, interval.last + 1) for interval in intervals]
    is_robot = np.array([fused.is_robot(gap, run, NUM_CONFIGURATIONS, FREE_SHARE) for run in runs])
    perhaps = fused.is_robot(gap, runs[0], FEWER_CONFIGURATIONS, FREE_BESIDE)
    pieces = ndimage.label(spread_cells(mask, perhaps, 0), TOUCHING)[0][mask]
    num, num_sure = np.bincount(pieces), np.bincount(pieces, is_robot[0])
    is_robot[0] |= perhaps & (num_sure >= SURE_SHARE * num)[pieces]
    votes = [np.where(is_robot.any(axis=0), fused.votes(run), 0) for run in runs]
    around = [ndimage.uniform_filter(spread_cells(mask, each, 0), AROUND)[mask].round(3) for each in votes]
    chosen = np.argmax(around, axis=0)
    return np.where(is_robot[chosen, np.arange(len(chosen))], chosen, -1)


def spread_cells(mask: Bool, values: Array, rest: float) -> Float32:
    """A grid (X, Y, Z) of values (N,) in the mask and `rest` elsewhere."""
    grid = np.full(mask.shape, np.float32(rest))
    grid[mask] = values
    return grid

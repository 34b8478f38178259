"""Images by their stamps: colour and depth paired, those that came twice or not at all, clocks that went back."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import IMAGES_BACK_NS, IMAGES_FEWEST, IMAGES_FEWEST_BACK, IMAGES_GAP, IMAGES_STEADY

Stamps = Sequence[int] | NDArray[np.int64]
_BLOCK = 1 << 14  # pairs that are Python's numbers at once


def pair_by_stamp(color_ns: Stamps, depth_ns: Stamps, tolerance_ns: int) -> list[tuple[int, int]]:
    """`paired` as a list of (colour, depth)."""
    return [(i, j) for i, j in paired(color_ns, depth_ns, tolerance_ns).tolist()]


def paired(color_ns: Stamps, depth_ns: Stamps, tolerance_ns: int) -> NDArray[np.int64]:
    """Index pairs (K, 2) of colour and depth at most `tolerance_ns` apart, each index once, the closest pairs first.

    Returned by colour stamp. Of equally close pairs the earlier one wins.
    """
    color, depth = np.asarray(color_ns, dtype=np.int64), np.asarray(depth_ns, dtype=np.int64)
    order = np.argsort(depth, kind="stable")
    first = np.searchsorted(depth[order], color - tolerance_ns, side="left")
    count = np.searchsorted(depth[order], color + tolerance_ns, side="right") - first
    i = np.repeat(np.arange(len(color)), count)  # every pair that is close enough
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)]
    closest = np.lexsort((j, i, depth[j], color[i], np.abs(color[i] - depth[j])))
    partner = np.full(len(color), -1, dtype=np.int64)
    is_free = np.ones(len(depth), dtype=np.bool_)
    for start in range(0, len(closest), _BLOCK):
        block = closest[start : start + _BLOCK]
        for a, b in zip(i[block].tolist(), j[block].tolist(), strict=True):
            if is_free[b] and partner[a] < 0:
                is_free[b], partner[a] = False, b
    found = np.flatnonzero(partner >= 0)
    found = found[np.argsort(color[found], kind="stable")]
    return np.stack([found, partner[found]], axis=1)


@dataclass(kw_only=True)
class StampClock:
    """Whether the clock of a topic's headers went back while the recording went on: a bag in a loop, a reset.

    num_back: stamps more than a second behind one that was logged before them; back_ns: the first one's distance,
    seen at log time back_log_ns.
    """

    num_back: int = 0
    back_ns: int = 0
    back_log_ns: int = 0
    _latest_ns: int | None = None
    _latest_log_ns: int = 0

    def see(self, stamp_ns: int, log_time_ns: int) -> None:
        """The next message in the order of the file."""
        if self._latest_ns is None or stamp_ns > self._latest_ns:
            self._latest_ns, self._latest_log_ns = stamp_ns, log_time_ns
        elif self._latest_ns - stamp_ns > IMAGES_BACK_NS and log_time_ns > self._latest_log_ns:
            if not self.num_back:
                self.back_ns, self.back_log_ns = self._latest_ns - stamp_ns, log_time_ns
            self.num_back += 1

    @property
    def went_back(self) -> bool:
        """Whether it did: a stamp or two may be wrong by themselves."""
        return self.num_back >= IMAGES_FEWEST_BACK


@dataclass(frozen=True, kw_only=True)
class Drops:
    """Gaps of a topic of steady rate: how many, the images missing in them, and the period [ns]."""

    num_gaps: int
    num_images: int
    period_ns: float


def first_of_each(stamps_ns: Stamps) -> NDArray[np.int64]:
    """Numbers (K,) of the images whose stamp none before them has."""
    return np.sort(np.unique(stamps_ns, return_index=True)[1]).astype(np.int64)


def dropped(stamps_ns: Stamps) -> Drops:
    """What is missing between different stamps; nothing where there are few, or most intervals differ.

    The period is the median interval, and steady within a quarter of it must be three intervals of four.
    """
    intervals = np.diff(np.unique(stamps_ns)).astype(np.float64)
    if len(intervals) < IMAGES_FEWEST:
        return Drops(num_gaps=0, num_images=0, period_ns=0.0)
    period = float(np.median(intervals))
    is_steady = np.abs(intervals - period) <= IMAGES_STEADY * period
    gaps = intervals[intervals > IMAGES_GAP * period]
    if is_steady.mean() < 0.75:
        gaps = gaps[:0]
    return Drops(num_gaps=len(gaps), num_images=int((np.rint(gaps / period) - 1).sum()), period_ns=period)

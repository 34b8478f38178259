"""Which colour image belongs to which depth image."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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

"""Which colour image belongs to which depth image."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Stamps = Sequence[int] | NDArray[np.int64]


def pair_by_stamp(color_ns: Stamps, depth_ns: Stamps, tolerance_ns: int) -> list[tuple[int, int]]:
    """Index pairs (colour, depth) at most `tolerance_ns` apart, each index once, the closest pairs first.

    Returned by colour stamp. Of equally close pairs the earlier one wins.
    """
    color, depth = np.asarray(color_ns, dtype=np.int64), np.asarray(depth_ns, dtype=np.int64)
    order = np.argsort(depth, kind="stable")
    first = np.searchsorted(depth[order], color - tolerance_ns, side="left")
    count = np.searchsorted(depth[order], color + tolerance_ns, side="right") - first
    i = np.repeat(np.arange(len(color)), count)  # every pair that is close enough
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)]
    closest = np.lexsort((j, i, depth[j], color[i], np.abs(color[i] - depth[j])))
    is_free_color, is_free_depth = np.ones(len(color), dtype=np.bool_), np.ones(len(depth), dtype=np.bool_)
    pairs: list[tuple[int, int]] = []
    for a, b in zip(i[closest].tolist(), j[closest].tolist(), strict=True):
        if is_free_color[a] and is_free_depth[b]:
            is_free_color[a] = is_free_depth[b] = False
            pairs.append((a, b))
    return sorted(pairs, key=lambda pair: (color[pair[0]], pair[0]))

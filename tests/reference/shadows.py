"""Stereo shadows in NumPy, pixel by pixel of each row; `scene.depth_holes.find_shadows` gives the same bytes."""

from itertools import pairwise

import numpy as np

from splatctrl_cli.config import fixed
from splatctrl_cli.records import Bool, Float32, Floats


def find_shadows(depth: Float32, focal: float, behind: Float32) -> Bool:
    """Pixels (H, W) without depth in the shadow of something nearer in their row; behind (H, W) [m]."""
    is_shadow, fattened = np.zeros(depth.shape, bool), max(depth.shape[1] / fixed.MASK_EDGE, 1.0)
    for turn in (1, -1):
        image = depth[:, ::turn]
        baseline = _baseline(image, np.float32(focal))
        for v, row in enumerate(image):
            for u in np.flatnonzero(row <= 0) if baseline else ():
                beyond = np.flatnonzero(row[u:] > 0)
                if len(beyond):
                    inverse = np.float32(1) / row[u + beyond[0]] - np.float32(1) / behind[:, ::turn][v, u]
                    reach = np.float32(baseline * focal) * inverse + np.float32(fattened)
                    is_shadow[:, ::turn][v, u] |= beyond[0] <= reach
    return is_shadow


def _baseline(depth: Float32, focal: np.float32) -> float:
    heights, baselines = [], []
    for row in depth:
        seen = np.flatnonzero(row > 0)
        for u, following in pairwise(seen):
            before, after = row[u], row[following]
            if np.float32(fixed.SHADOW_STEP) * before * after <= focal * (before - after):
                heights.append(focal * (np.float32(1) / after - np.float32(1) / before))
                baselines.append((following - 1 - u) / float(heights[-1]))
    height = np.array(heights, np.float32)
    if not len(height):
        return 0.0
    higher = height >= _median(height, height)
    return min(_median(np.array(baselines)[higher], height[higher]), fixed.SHADOW_BASELINE)


def _median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])

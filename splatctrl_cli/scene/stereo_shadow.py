"""Stereo shadows: places without depth that only one imager sees."""

import cv2
import numpy as np

from splatctrl_cli.config.fixed import MASK_EDGE, SHADOW_BASELINE, SHADOW_STEP
from splatctrl_cli.records import Bool, Float32, Float64, Index


def shadowed(depth: Float32, focal: float) -> Bool:
    """Pixels (H, W) without depth in the shadow of something nearer in their row.

    depth (H, W) [m], 0 = none; focal [px]. With baseline B, an object at z hides B focal (1/z - 1/z_behind) pixels
    behind it, always on the same side. Side and baseline are measured from the image (`_baseline`); z_behind is the
    largest depth around connected pixels without depth.
    """
    is_shadow, fattened = np.zeros(depth.shape, bool), max(depth.shape[1] / MASK_EDGE, 1.0)
    for turn in (1, -1):  # the nearer object is right of its shadow, then left
        image = np.ascontiguousarray(depth[:, ::turn])
        column = np.arange(image.shape[1], dtype=np.int32)
        following = np.where(image > 0, column, np.int32(len(column)))  # column of the next pixel with depth
        following = np.minimum.accumulate(following[:, ::-1], axis=1)[:, ::-1]
        baseline = _baseline(image, following, focal)
        if baseline:
            rows, columns = np.nonzero((image <= 0) & (following < len(column)))
            nearer = following[rows, columns]
            inverse = 1.0 / image[rows, nearer] - 1.0 / _behind(image)[rows, columns]
            is_beside = nearer - columns <= baseline * focal * inverse + fattened
            is_shadow[:, ::turn][rows[is_beside], columns[is_beside]] = True
    return is_shadow


def _baseline(depth: Float32, following: Index, focal: float) -> float:
    """Baseline [m] of shadows left of nearer objects; 0 without any.

    following (H, W): column of the next depth, W = none. Each step nearer by `SHADOW_STEP` gives a baseline by its
    lost pixels. The median is over the higher half of the steps, weighted by height: fattened outlines cover low
    steps' shadows.
    """
    following = following[:, 1:]
    before = depth[:, :-1]
    after = np.take_along_axis(depth, np.minimum(following, depth.shape[1] - 1), axis=1)
    is_step = (before > 0) & (after > 0) & (SHADOW_STEP * before * after <= focal * (before - after))
    columns = np.nonzero(is_step)[1]
    if not len(columns):
        return 0.0
    height = focal * (1.0 / after[is_step] - 1.0 / before[is_step])
    baselines = (following[is_step] - 1 - columns) / height
    higher = height >= _median(height, height)
    return min(_median(baselines[higher], height[higher]), SHADOW_BASELINE)


def _median(values: Float64, weights: Float64) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


def _behind(depth: Float32) -> Float32:
    """Largest depth (H, W) [m] around connected pixels without depth; 0 elsewhere."""
    is_blank = depth <= 0
    num, group = cv2.connectedComponents(is_blank.view(np.uint8), connectivity=8)
    around = np.where(is_blank, cv2.dilate(depth, np.ones((3, 3), np.uint8)), np.float32(0.0))
    is_rim = around > 0
    of_group = np.zeros(num, np.float32)
    np.maximum.at(of_group, group[is_rim], around[is_rim])
    return np.asarray(of_group[group])

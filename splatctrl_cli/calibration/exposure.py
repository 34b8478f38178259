"""How much brighter or more coloured one view of a still scene is than another, by the surfaces that both see."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from splatctrl_cli.calibration.gray_views import gray_view, on_surface, overlapping, scaled
from splatctrl_cli.calibration.views import depth_sigma
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, project
from splatctrl_cli.records import Bool, Float64, RgbdFrame


def exposure_gains(frames: Sequence[RgbdFrame], scale: float = 1.0, free: Bool | None = None) -> Float64:
    """Gains (N, 3) of red, green and blue, so that an image divided by its gain shows what the others show.

    Least squares of the logarithms over all pairs of views that see the same surfaces, whose own ratio is a median;
    a wide prior keeps them about 1. Levels that are nearly black or white do not count. scale: of the recording's
    lengths; views that are not `free` (N,) keep gain 1.
    """
    is_free = np.ones(len(frames), np.bool_) if free is None else free
    views = [gray_view(frame, scale) for frame in frames]
    poses = [scaled(frame.T_world_camera, 1 / scale) for frame in frames]
    colors = [_small(frame, view.gray.shape[0]) for frame, view in zip(frames, views, strict=True)]
    A = np.tile(np.eye(len(frames)) / fixed.EXPOSURE_PRIOR**2, (3, 1, 1))
    A[:, ~is_free, ~is_free] += 1e12
    b = np.zeros((3, len(frames)))
    for i, j in overlapping(views, poses, np.ones(len(frames), np.bool_), is_free):
        there, lands, _, _, distance = on_surface(views[i], views[j], invert_transform(poses[j]) @ poses[i])
        lands &= np.abs(distance) < fixed.EXPOSURE_NEAR * depth_sigma(there[:, 2])
        u, v = np.round(project(views[j].depth.lens, there[lands])).astype(np.int64).T
        own_u, own_v = np.round(project(views[i].depth.lens, views[i].depth.points[lands])).astype(np.int64).T
        own, other = colors[i][own_v, own_u], colors[j][v, u]
        low, high = fixed.EXPOSURE_LEVELS
        is_known = (np.minimum(own, other) > low) & (np.maximum(own, other) < high)
        for channel in range(3):
            known = is_known[:, channel]
            if known.sum() < fixed.REFINE_FEWEST:
                continue
            ratios = np.log(own[known, channel] / other[known, channel])
            ratio = float(np.median(ratios))
            spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
            weight = 1 / (fixed.EXPOSURE_ERROR**2 + spread**2 / len(ratios))
            A[channel][np.ix_([i, j], [i, j])] += weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
            b[channel, [i, j]] += weight * ratio * np.array([1.0, -1.0])
    return np.asarray(np.exp(np.linalg.solve(A, b[..., None])[..., 0].T))


def exposed(frame: RgbdFrame, gain: Float64) -> RgbdFrame:
    """The frame with its colours divided by a gain (3,)."""
    levels = np.rint(np.arange(256)[:, None] / gain)
    table = np.clip(levels, 0, 255).astype(np.uint8)
    return replace(frame, color=np.stack([table[frame.color[..., k], k] for k in range(3)], axis=-1))


def _small(frame: RgbdFrame, rows: int) -> Float64:
    """Smoothed levels (h, w, 3) at the pixels of a `GrayView` of so many rows."""
    stride = -(-frame.color.shape[0] // rows)
    smooth = cv2.GaussianBlur(frame.color, (0, 0), fixed.EXPOSURE_BLUR * stride)
    return np.asarray(smooth[::stride, ::stride], np.float64)

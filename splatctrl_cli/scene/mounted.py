"""Pixels of parts on a moving camera, such as a gripper: never seeded or compared."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, gaussian_filter, label, uniform_filter

from splatctrl_cli.config import fixed
from splatctrl_cli.records import Bool, Float64, RgbdFrame


def spread_views(frames: Sequence[RgbdFrame]) -> list[RgbdFrame]:
    """The first frames over `MOUNTED_APART` [m] apart, at most `MOUNTED_MAX_VIEWS`."""
    chosen: list[RgbdFrame] = []
    for frame in frames:
        away = [np.linalg.norm(frame.T_world_camera[:3, 3] - other.T_world_camera[:3, 3]) for other in chosen]
        if min(away, default=np.inf) > fixed.MOUNTED_APART:
            chosen.append(frame)
    return chosen[: fixed.MOUNTED_MAX_VIEWS]


def mounted_pixels(frames: Sequence[RgbdFrame], min_range: float) -> Bool | None:
    """Pixels (H, W) of parts that move with one camera; None for fewer than six frames.

    frames: from `spread_views`. The pixels keep their colour, have texture, and rarely have depth over `min_range`
    [m].
    """
    if len(frames) < fixed.MOUNTED_MIN_VIEWS:
        return None
    sigmas = (fixed.MOUNTED_BLUR, fixed.MOUNTED_BLUR, 0)
    colors = np.stack([gaussian_filter(frame.color.astype(np.float32) / 255.0, sigmas) for frame in frames])
    deviation = np.median(np.abs(colors - np.median(colors, axis=0)), axis=0).max(axis=-1)
    has_depth = np.mean([frame.depth >= min_range for frame in frames], axis=0, dtype=np.float64)
    depth_share = uniform_filter(has_depth, fixed.MOUNTED_WINDOW)
    is_mounted = (deviation < fixed.MOUNTED_DEVIATION) & (depth_share < fixed.MOUNTED_DEPTH)
    is_mounted &= _texture(frames[0]) > fixed.MOUNTED_TEXTURE
    entering = _entering(binary_opening(is_mounted, np.ones((5, 5), bool)))
    return np.asarray(binary_dilation(entering, np.ones(2 * (2 * fixed.MOUNTED_MARGIN + 1,), bool)))


def background_color(frames: Sequence[RgbdFrame], counted: Sequence[Bool]) -> tuple[float, float, float]:
    """Median colour in [0, 1] of counted pixels (H, W) away from depth; black if these are few."""
    depth_near = [uniform_filter((f.depth > 0).astype(np.float32), fixed.MOUNTED_WINDOW) > 1e-4 for f in frames]
    away = [mask & ~is_near for mask, is_near in zip(counted, depth_near, strict=True)]
    colors = np.concatenate([frame.color[mask] for frame, mask in zip(frames, away, strict=True)])
    if len(colors) < fixed.MOUNTED_BACKGROUND * sum(frame.depth.size for frame in frames):
        return (0.0, 0.0, 0.0)
    red, green, blue = (float(value) / 255.0 for value in np.median(colors, axis=0))
    return (red, green, blue)


def _entering(mask: Bool) -> Bool:
    parts, _ = label(mask)
    border = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    area = np.bincount(parts.ravel())
    return np.isin(parts, [part for part in border if part and area[part] >= fixed.MOUNTED_AREA * mask.size])


def _texture(frame: RgbdFrame) -> Float64:
    grey = frame.color.mean(axis=-1) / 255.0
    mean = uniform_filter(grey, fixed.MOUNTED_WINDOW)
    return np.asarray(np.sqrt(np.maximum(uniform_filter(grey * grey, fixed.MOUNTED_WINDOW) - mean**2, 0.0)))

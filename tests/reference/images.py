"""Plain float64 forms of the image metrics, window by window, and of the mask of new seeds."""

import numpy as np

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.records import Bool, Float64


def gaussian_window(size: int = 11, sigma: float = 1.5) -> Float64:
    """Weights (size, size) that sum to 1."""
    offsets = np.arange(size) - size // 2
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * sigma**2))
    return np.asarray(weights / weights.sum())


def ssim_at(x: Float64, y: Float64, row: int, column: int) -> float:
    """SSIM of grey images x, y (H, W) in [0, 1] at one pixel; beyond the border the image is mirrored."""
    window = gaussian_window()
    rows = [mirrored(i, x.shape[0]) for i in range(row - 5, row + 6)]
    columns = [mirrored(j, x.shape[1]) for j in range(column - 5, column + 6)]
    a, b = x[np.ix_(rows, columns)], y[np.ix_(rows, columns)]
    mean_a, mean_b = (window * a).sum(), (window * b).sum()
    variance_a, variance_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
    covariance = (window * (a - mean_a) * (b - mean_b)).sum()
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float(numerator / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)))


def mirrored(index: int, length: int) -> int:
    """Index of a half-sample mirrored signal: … 1 0 | 0 1 2 … length-1 | length-1 …"""
    index = index % (2 * length)
    return index if index < length else 2 * length - 1 - index


def add_mask(
    depth: Float64, opacity: Float64, measured: Float64, mappable: Bool, config: SceneConfig, opaque: float
) -> Bool:
    """Pixels (H, W) to seed: holes, and those nearer than the map by a multiple of the median error (eq. 5)."""
    is_hole, is_opaque = opacity < config.hole_opacity, opacity >= opaque
    error = np.where(is_opaque, depth / np.where(is_opaque, opacity, 1.0), 0.0) - measured
    explained = mappable & ~is_hole
    median = float(np.median(np.abs(error[explained]))) if explained.any() else 0.0
    threshold = min(max(config.lambda_mde * median, config.min_depth_error), config.max_depth_error)
    return np.asarray(mappable & (is_hole | (error > threshold)))

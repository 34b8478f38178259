"""How far a rendered image is from a photo, over the pixels that a mask selects: PSNR, SSIM, depth errors."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter

from splatctrl_cli.config.fixed import SSIM_BOX, SSIM_BOX_RANGE, SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from splatctrl_cli.records import Bool, Float64


@dataclass(frozen=True, kw_only=True)
class DepthErrors:
    """Absolute depth errors over `num_pixels` pixels where both images have a depth; nan where there are none.

    median, mean, p90 [m]; within_1cm and within_2cm are shares of those pixels.
    """

    num_pixels: int
    median: float
    mean: float
    p90: float
    within_1cm: float
    within_2cm: float


def psnr(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool | None = None) -> float:
    """Peak signal-to-noise ratio [dB] for a peak of 1: ``-10 log10(mean squared error)`` of the masked pixels.

    image, reference (H, W, 3) in [0, 1]; mask (H, W), None = all. Pixels outside the mask count in neither sum nor
    share. Identical images give inf, an empty mask nan.
    """
    squared = np.square(image.astype(np.float64) - reference)
    selected = squared if mask is None else squared[mask]
    if not selected.size:
        return math.nan
    error = float(selected.mean())
    return math.inf if error == 0 else -10.0 * math.log10(error)


def ssim_map(
    image: NDArray[np.floating], reference: NDArray[np.floating], *, is_zero_padded: bool = False
) -> Float64:
    """Structural similarity (H, W, 3) per pixel and channel of images (H, W, 3) in [0, 1] (Wang et al. 2004).

    Gaussian window 11×11, sigma 1.5, C1 = 0.01², C2 = 0.03², population moments; at the border the image is mirrored
    with its edge pixel repeated, or continued with zeros, as 3D Gaussian splatting has it
    (graphdeco-inria/gaussian-splatting, utils/loss_utils.py), which hides errors there.
    """
    x, y = image.astype(np.float64), np.asarray(reference, dtype=np.float64)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (
        _window_mean(picture, "constant" if is_zero_padded else "reflect") for picture in (x, y, x * x, y * y, x * y)
    )
    variance_x, variance_y = mean_xx - mean_x**2, mean_yy - mean_y**2
    covariance = mean_xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)
    return np.asarray(luminance * structure)


def published_ssim(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool, fill: float) -> float:
    """SSIM of images (H, W, 3) in [0, 1] that are `fill` outside the mask (H, W), as NeRF's papers print it.

    They call scikit-image with its defaults (skimage/metrics/_structural_similarity.py before 0.20): box window of
    7 pixels, sample moments, the data range of floats taken as 2, and a border of 3 pixels left out of the mean.
    That range lifts the figure: compare it only with figures of the same kind. nan for images below 7 pixels and for
    an empty mask.
    """
    if min(mask.shape) < SSIM_BOX or not mask.any():
        return math.nan
    x, y = (np.where(mask[:, :, None], picture, fill).astype(np.float64) for picture in (image, reference))
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (
        uniform_filter(picture, size=(SSIM_BOX, SSIM_BOX, 1)) for picture in (x, y, x * x, y * y, x * y)
    )
    sample = SSIM_BOX**2 / (SSIM_BOX**2 - 1)
    variance_x, variance_y = sample * (mean_xx - mean_x**2), sample * (mean_yy - mean_y**2)
    covariance = sample * (mean_xy - mean_x * mean_y)
    c1, c2 = (0.01 * SSIM_BOX_RANGE) ** 2, (0.03 * SSIM_BOX_RANGE) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    border = SSIM_BOX // 2
    return float(similarity[border:-border, border:-border].mean())


def depth_errors(
    depth: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool | None = None
) -> DepthErrors:
    """Errors of `depth` (H, W) [m] against `reference` (H, W) [m] where both are above 0 and the mask holds."""
    both = (depth > 0) & (reference > 0)
    if mask is not None:
        both &= mask
    errors = np.abs(depth[both].astype(np.float64) - reference[both])
    if not errors.size:
        return DepthErrors(num_pixels=0, **dict.fromkeys(_DEPTH_FIGURES, math.nan))
    return DepthErrors(
        num_pixels=int(errors.size),
        median=float(np.median(errors)),
        mean=float(errors.mean()),
        p90=float(np.percentile(errors, 90)),
        within_1cm=float(np.mean(errors <= 0.01)),
        within_2cm=float(np.mean(errors <= 0.02)),
    )


_DEPTH_FIGURES = ("median", "mean", "p90", "within_1cm", "within_2cm")


def _window_mean(image: Float64, border: Literal["reflect", "constant"]) -> Float64:
    """The Gaussian-weighted mean of each pixel's window, rows then columns."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    rows = correlate1d(image, weights, axis=0, mode=border)
    return np.asarray(correlate1d(rows, weights, axis=1, mode=border))

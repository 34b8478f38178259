"""Anisotropic Gaussians as parameters, and their rendering."""

import numpy as np

from splatctrl_cli.kernels import num_threads
from splatctrl_cli.kernels.raster import (
    CENTER,
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    NUM_PARAMETERS,
    QUAT,
    GaussianRasteriser,
)
from splatctrl_cli.records import Float32, Float64, GaussianSet, Intrinsics
from splatctrl_cli.scene.render import Rendering, camera_array

LARGEST_LOGIT = 16.0  # opacity 1 to float32
PER_CHANNEL = 16  # harmonics


def parameters_of(gaussians: GaussianSet) -> Float32:
    """Parameters (N, 59); opacities 0 and 1 become the nearest finite logit."""
    rows = np.zeros((len(gaussians), NUM_PARAMETERS), np.float32)
    rows[:, CENTER] = gaussians.centers
    rows[:, LOG_SCALE] = np.log(gaussians.scales)
    rows[:, QUAT] = gaussians.quats_wxyz
    opacity = gaussians.opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        logit = np.log(opacity) - np.log1p(-opacity)
    rows[:, LOGIT] = np.clip(logit, -LARGEST_LOGIT, LARGEST_LOGIT)
    coefficients = np.moveaxis(gaussians.harmonics, 2, 1)
    rows[:, HARMONICS].reshape(-1, 3, PER_CHANNEL)[:, :, : coefficients.shape[2]] = coefficients
    return rows


def render_gaussians(
    gaussians: GaussianSet, intrinsics: Intrinsics, T_world_camera: Float64, *, threads: int = 0
) -> Rendering:
    """Render from a pinhole camera at T_world_camera (4, 4); black where empty."""
    raster = GaussianRasteriser(num_threads(threads))
    raster.prepare(camera_array(intrinsics, T_world_camera), parameters_of(gaussians))
    planes = raster.forward()
    color = np.ascontiguousarray(np.moveaxis(planes[:3], 0, 2))
    return Rendering(color=color, depth=planes[3].copy(), opacity=planes[4].copy())

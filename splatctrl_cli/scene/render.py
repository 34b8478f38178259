"""Rendering of splats (eq. 1 to 3 of the paper) and Gaussians; weights of the loss (eq. 4)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config import SceneConfig, fixed
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.kernels import num_threads
from splatctrl_cli.kernels.raster import (
    CENTER,
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    NUM_PARAMETERS,
    QUAT,
    GaussianRasteriser,
    LossTerms,
    LossWeights,
    Rasteriser,
    pack_camera,
)
from splatctrl_cli.records import Float32, Float64, GaussianSet, Intrinsics, SplatSet

Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """One view: color (H, W, 3), depth (H, W) [m] as eq. 3 blends it, opacity (H, W)."""

    color: Float32
    depth: Float32
    opacity: Float32

    def normalised_depth(self) -> Float32:
        """Depth / opacity (H, W) [m] where opacity is at least 0.5, else 0."""
        is_opaque = self.opacity >= fixed.OPAQUE_ENOUGH
        return np.where(is_opaque, self.depth / np.where(is_opaque, self.opacity, 1.0), 0.0).astype(np.float32)

    def before(self, background: Color) -> "Rendering":
        """View before one colour: color + (1 - opacity) background."""
        behind = (1.0 - self.opacity)[..., None] * np.array(background, np.float32)
        return replace(self, color=self.color + behind)


def camera_array(intrinsics: Intrinsics, T_world_camera: Float64) -> Float64:
    """Camera (18,) that the kernels take."""
    k = intrinsics
    return pack_camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height, invert_transform(T_world_camera))


def render(splats: SplatSet, intrinsics: Intrinsics, T_world_camera: Float64, *, threads: int = 0) -> Rendering:
    """Render from a pinhole camera at T_world_camera (4, 4); black where empty."""
    raster = Rasteriser(num_threads(threads))
    raster.prepare(
        camera_array(intrinsics, T_world_camera),
        np.ascontiguousarray(splats.centers, np.float32),
        np.ascontiguousarray(splats.radii, np.float32),
        np.ascontiguousarray(splats.opacities, np.float32),
        np.ascontiguousarray(splats.colors, np.float32),
    )
    planes = raster.forward()
    return Rendering(
        color=np.ascontiguousarray(np.moveaxis(planes[:3], 0, 2)), depth=planes[3].copy(), opacity=planes[4].copy()
    )


def loss_weights(config: SceneConfig, background: Color = BLACK) -> LossWeights:
    """Weights of the image loss, and the colour behind the splats."""
    return LossWeights(
        dssim=config.lambda_dssim,
        color=config.lambda_color,
        depth=config.lambda_depth,
        opacity=config.lambda_opacity,
        normalised=config.depth_loss == "normalised",
        background=background,
    )


def mean_loss(terms: Sequence[LossTerms], config: SceneConfig) -> float | None:
    """Mean image part of eq. 4; None without images."""
    c = config
    values = [
        c.lambda_color * ((1 - c.lambda_dssim) * t.l1 + c.lambda_dssim * t.dssim)
        + c.lambda_depth * t.depth
        + c.lambda_opacity * t.transmittance
        for t in terms
    ]
    return sum(values) / len(values) if values else None


def psnr_of(terms: Sequence[LossTerms]) -> float | None:
    """PSNR [dB] of the mean squared colour error over images; None without images."""
    if not terms:
        return None
    return -10.0 * math.log10(max(sum(t.squared for t in terms) / len(terms), 1e-12))


LARGEST_LOGIT = 16.0  # opacity 1 to float32
PER_CHANNEL = 16  # harmonics


def parameters_of(gaussians: GaussianSet) -> Float32:
    """Parameters (N, 59); logits of opacity are limited to `LARGEST_LOGIT` in size."""
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
    raster = GaussianRasteriser(num_threads(threads))
    raster.prepare(camera_array(intrinsics, T_world_camera), parameters_of(gaussians))
    planes = raster.forward()
    return Rendering(
        color=np.ascontiguousarray(np.moveaxis(planes[:3], 0, 2)), depth=planes[3].copy(), opacity=planes[4].copy()
    )

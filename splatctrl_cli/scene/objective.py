"""The loss of eq. 4 with the weights of the configuration: the same for every method of reconstruction."""

import math
from collections.abc import Sequence

from splatctrl_cli.config import SceneConfig
from splatctrl_cli.kernels.raster import LossTerms, LossWeights

Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)


def loss_weights(config: SceneConfig, background: Color = BLACK) -> LossWeights:
    """The weights that the image loss takes, and the colour behind the splats."""
    return LossWeights(
        dssim=config.lambda_dssim,
        color=config.lambda_color,
        depth=config.lambda_depth,
        opacity=config.lambda_opacity,
        normalised=config.depth_loss == "normalised",
        background=background,
    )


def mean_loss(terms: Sequence[LossTerms], config: SceneConfig) -> float | None:
    """Mean over images of the image part of eq. 4; None where there is no image."""
    c = config
    values = [
        c.lambda_color * ((1 - c.lambda_dssim) * t.l1 + c.lambda_dssim * t.dssim)
        + c.lambda_depth * t.depth
        + c.lambda_opacity * t.transmittance
        for t in terms
    ]
    return sum(values) / len(values) if values else None


def psnr_of(terms: Sequence[LossTerms]) -> float | None:
    """PSNR [dB] of the mean squared colour error over images; None where there is no image."""
    if not terms:
        return None
    return -10.0 * math.log10(max(sum(t.squared for t in terms) / len(terms), 1e-12))

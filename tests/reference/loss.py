"""Eq. 4 of the paper on one image, in float64 torch, so that autograd is the reference of the gradient."""

import torch


def window() -> torch.Tensor:
    """The 11 x 11 Gaussian window of sigma 1.5, summing to one."""
    x = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-(x**2) / (2 * 1.5**2))
    line = line / line.sum()
    return line[:, None] * line[None, :]


def ssim_map(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """SSIM (3, H, W) of two images (3, H, W), zero beyond the border."""
    kernel = window()[None, None].repeat(3, 1, 1, 1)

    def mean(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image[None], kernel, padding=5, groups=3)[0]

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mx * my + c1) * (2 * cov + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))


def loss(
    planes: torch.Tensor,
    color: torch.Tensor,
    depth: torch.Tensor,
    counted: torch.Tensor,
    *,
    dssim: float,
    color_weight: float,
    depth_weight: float,
    opacity_weight: float,
    normalised: bool,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> torch.Tensor:
    """lambda_color ((1 - l) L1 + l D-SSIM) + lambda_depth L1(depth); means over counted and over valid pixels.

    The background shows through what the planes leave transparent.
    """
    behind = torch.tensor(background, dtype=torch.float64)[:, None, None]
    x = torch.where(counted[None], planes[:3] + (1 - planes[4]) * behind, color)
    num_values = 3 * counted.sum()
    l1 = (x - color).abs().sum() / num_values
    d_ssim = (1 - ssim_map(x, color)).sum() / num_values
    rendered = torch.where(planes[4] > 0.1, planes[3] / planes[4], planes[3]) if normalised else planes[3]
    is_valid = (depth > 0) & counted
    l_depth = (rendered - depth).abs()[is_valid].mean() if is_valid.any() else torch.zeros(())
    empty = (1 - planes[4])[is_valid].mean() if is_valid.any() else torch.zeros(())
    return color_weight * ((1 - dssim) * l1 + dssim * d_ssim) + depth_weight * l_depth + opacity_weight * empty

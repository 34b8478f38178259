"""Eq. 1 to 3 of the paper, pixel by pixel in float64 torch: autograd is the reference of the backward pass."""

import torch

DILATION, MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, NEAR, MARGIN = 0.3, 1 / 255, 0.99, 1e-4, 0.05, 1.3


def projected(camera: torch.Tensor, points_camera: torch.Tensor, Sigma: torch.Tensor) -> torch.Tensor:
    """Sigma' = J W Sigma W^T J^T, plus the dilation, (N, 2, 2), of Sigma (N, 3, 3)."""
    fx, fy, cx, cy, width, height = camera[:6]
    x, y, z = points_camera.unbind(1)
    tx = torch.clamp(x / z, -MARGIN * (cx + 0.5) / fx, MARGIN * (width - 0.5 - cx) / fx)
    ty = torch.clamp(y / z, -MARGIN * (cy + 0.5) / fy, MARGIN * (height - 0.5 - cy) / fy)
    zero = torch.zeros_like(z)
    J = torch.stack([torch.stack([fx / z, zero, -fx * tx / z], 1), torch.stack([zero, fy / z, -fy * ty / z], 1)], 1)
    W = camera[6:15].reshape(3, 3)
    return J @ W @ Sigma @ W.T @ J.mT + DILATION * torch.eye(2, dtype=torch.float64)


def covariance_2d(camera: torch.Tensor, points_camera: torch.Tensor, radii: torch.Tensor) -> torch.Tensor:
    """Sigma' (N, 2, 2) of balls, whose Sigma = r^2 I."""
    return projected(camera, points_camera, radii[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64))


def render(
    camera: torch.Tensor, centers: torch.Tensor, radii: torch.Tensor, opacities: torch.Tensor, colors: torch.Tensor
) -> torch.Tensor:
    """Planes (5, H, W): sum_i (c_i, d_i, 1) alpha_i G_i prod_{j<i} (1 - alpha_j G_j), front to back."""
    points = centers @ camera[6:15].reshape(3, 3).T + camera[15:18]
    return composed(camera, points, covariance_2d(camera, points, radii), opacities, colors)


def composed(
    camera: torch.Tensor,
    points_camera: torch.Tensor,
    covariances: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
) -> torch.Tensor:
    """The planes of `render`, (5, H, W), of what has these covariances (N, 2, 2) on the image."""
    width, height = int(camera[4]), int(camera[5])
    conics = torch.linalg.inv(covariances)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    T = torch.ones(height, width, dtype=torch.float64)
    is_live = torch.ones(height, width, dtype=torch.bool)
    planes = torch.zeros(5, height, width, dtype=torch.float64)
    for i in [i for i in torch.argsort(points_camera[:, 2]).tolist() if points_camera[i, 2] > NEAR]:
        x, y, z = points_camera[i]
        du, dv = u - (camera[0] * x / z + camera[2]), v - (camera[1] * y / z + camera[3])
        a, b, c = conics[i, 0, 0], conics[i, 0, 1], conics[i, 1, 1]
        G = torch.exp(-0.5 * (a * du * du + 2 * b * du * dv + c * dv * dv))
        alpha = torch.clamp(opacities[i] * G, max=MAX_ALPHA)
        is_seen = is_live & (alpha >= MIN_ALPHA)
        is_last = is_seen & (T * (1 - alpha) < MIN_TRANSMITTANCE)
        is_live = is_live & ~is_last
        weight = torch.where(is_seen & ~is_last, alpha * T, torch.zeros_like(T))
        planes = planes + torch.stack([*colors[i], z, torch.ones_like(z)])[:, None, None] * weight
        T = T - weight
    return planes

"""3D Gaussian splatting pixel by pixel in float64 torch: autograd is the reference of the backward pass."""

import torch

from tests.reference.raster import composed, projected


def rotations(quats_wxyz: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) of any length."""
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def covariances(
    camera: torch.Tensor, points_camera: torch.Tensor, scales: torch.Tensor, quats: torch.Tensor
) -> torch.Tensor:
    """Sigma' = J W R S S R^T W^T J^T plus the dilation; (N, 2, 2)."""
    M = rotations(quats) * scales[:, None, :]
    return projected(camera, points_camera, M @ M.mT)


def basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Real spherical harmonics (N, 16) of unit directions by their general formula, zero above `degree`.

    Y_lm = (-1)^m sqrt(2) K_lm P_l|m|(cos theta) cos or sin(|m| phi), written with (x + i y)^|m| so that it is smooth.
    3D-GS files order them by l, then m = -l ... l, with the Condon-Shortley sign in the odd |m| of P.
    """
    x, y, z = directions.unbind(1)
    one = torch.ones_like(x)
    legendre = {  # P_lm / sin(theta)^m, Condon-Shortley sign included
        (0, 0): one, (1, 0): z, (1, 1): -one, (2, 0): (3 * z**2 - 1) / 2, (2, 1): -3 * z, (2, 2): 3 * one,
        (3, 0): (5 * z**3 - 3 * z) / 2, (3, 1): -1.5 * (5 * z**2 - 1), (3, 2): 15 * z, (3, 3): -15 * one,
    }  # fmt: skip
    power = torch.complex(x, y)
    columns = []
    for l in range(4):
        for m in range(-l, l + 1):
            k = abs(m)
            ratio = torch.exp(torch.lgamma(torch.tensor(l - k + 1.0)) - torch.lgamma(torch.tensor(l + k + 1.0)))
            norm = torch.sqrt((2 * l + 1) / (4 * torch.pi) * ratio.double()) * (2**0.5 if m else 1.0)
            wave = (power**k).imag if m < 0 else (power**k).real
            value = norm * legendre[l, k] * (wave if m else one)
            columns.append(value if l <= degree else torch.zeros_like(value))
    return torch.stack(columns, 1)


def colors(camera: torch.Tensor, centers: torch.Tensor, harmonics: torch.Tensor, degree: int) -> torch.Tensor:
    """max(0, 0.5 + sum_k Y_k(direction) h_k), (N, 3), of harmonics (N, 3, 16)."""
    eye = -camera[6:15].reshape(3, 3).T @ camera[15:18]
    direction = (centers - eye) / (centers - eye).norm(dim=1, keepdim=True)
    return torch.clamp(0.5 + torch.einsum("nk,nck->nc", basis(direction, degree), harmonics), min=0.0)


def render(camera: torch.Tensor, parameters: torch.Tensor, degree: int = 3) -> torch.Tensor:
    """Planes (5, H, W) of parameters (N, 59): sum_i (c_i, d_i, 1) alpha_i G_i prod_{j<i} (1 - alpha_j G_j)."""
    centers, opacities = parameters[:, :3], torch.sigmoid(parameters[:, 10])
    points = centers @ camera[6:15].reshape(3, 3).T + camera[15:18]
    on_image = covariances(camera, points, torch.exp(parameters[:, 3:6]), parameters[:, 6:10])
    shades = colors(camera, centers, parameters[:, 11:].reshape(-1, 3, 16), degree)
    return composed(camera, points, on_image, opacities, shades)

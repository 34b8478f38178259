"""The rasteriser as a torch function, for custom losses and as the fused optimiser's oracle."""

from typing import Any

import numpy as np
import torch

from splatctrl_cli.kernels import num_threads
from splatctrl_cli.kernels.raster import Rasteriser
from splatctrl_cli.records import Float32, Float64


def rasterise(
    camera: Float64,
    centers: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    *,
    threads: int = 0,
) -> torch.Tensor:
    """Differentiable planes (5, H, W): colour, depth and opacity (eq. 1 to 3).

    camera (18,): `scene.render.camera_array`; centers (N, 3) [m], world; radii (N,) [m]; opacities (N,); colors (N,
    3); all float32 on the CPU.
    """
    planes: torch.Tensor = _Rasterise.apply(  # type: ignore[no-untyped-call]
        camera, centers, radii, opacities, colors, threads
    )
    return planes


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Float64, *inputs: Any) -> torch.Tensor:
        *tensors, threads = inputs
        centers, radii, opacities, colors = (_array(tensor) for tensor in tensors)
        ctx.raster = Rasteriser(num_threads(threads))
        ctx.raster.prepare(camera, centers, radii, opacities, colors)
        ctx.planes = ctx.raster.forward()
        return torch.from_numpy(ctx.planes.copy())

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        gradients = ctx.raster.backward(ctx.planes, _array(upstream[0]))
        centers, radii = ctx.raster.project_backward(gradients)
        parts = (centers, radii, gradients[:, 6].copy(), gradients[:, 7:].copy())
        return (None, *(torch.from_numpy(part) for part in parts), None)


def _array(tensor: torch.Tensor) -> Float32:
    return np.ascontiguousarray(tensor.detach().numpy())

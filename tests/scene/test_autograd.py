"""The rasteriser as a torch function."""

import numpy as np
import torch

from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Intrinsics
from splatctrl_cli.scene.autograd import rasterise
from splatctrl_cli.scene.render import camera_array
from tests.reference import raster as reference

CAMERA = camera_array(
    Intrinsics(fx=50.0, fy=50.0, cx=19.6, cy=14.3, width=40, height=30), look_at((0.7, 0.1, 0.5), (0.0, 0.0, 0.0))
)


def leaves(dtype: torch.dtype) -> list[torch.Tensor]:
    rng = np.random.default_rng(4)
    ranges = ((-0.2, 0.2, (25, 3)), (0.01, 0.05, 25), (0.1, 0.9, 25), (0, 1, (25, 3)))
    return [torch.tensor(np.float32(rng.uniform(*each)), dtype=dtype, requires_grad=True) for each in ranges]


def test_a_loss_differentiates_through_it_as_through_the_reference() -> None:
    """Also where colours alone are asked for."""
    ours, theirs, (*shape, colors) = leaves(torch.float32), leaves(torch.float64), leaves(torch.float32)
    weights = torch.tensor(np.random.default_rng(0).normal(size=(5, 30, 40)))
    (rasterise(CAMERA, *ours) * weights.float()).square().sum().backward()
    (rasterise(CAMERA, *(each.detach() for each in shape), colors) * weights.float()).square().sum().backward()
    (reference.render(torch.tensor(CAMERA), *theirs) * weights).square().sum().backward()
    for a, b in zip((*ours, colors), (*theirs, theirs[-1]), strict=True):
        assert (a.grad - b.grad).abs().max() < 2e-3 * b.grad.abs().max()

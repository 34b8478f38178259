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
    values = [
        rng.uniform(-0.2, 0.2, (25, 3)),
        rng.uniform(0.01, 0.05, 25),
        rng.uniform(0.1, 0.9, 25),
        rng.uniform(0, 1, (25, 3)),
    ]
    return [torch.tensor(value.astype(np.float32), dtype=dtype, requires_grad=True) for value in values]


def test_a_loss_differentiates_through_it_as_through_the_reference() -> None:
    ours, theirs = leaves(torch.float32), leaves(torch.float64)
    weights = torch.tensor(np.random.default_rng(0).normal(size=(5, 30, 40)))
    (rasterise(CAMERA, *ours) * weights.float()).square().sum().backward()
    (reference.render(torch.tensor(CAMERA), *theirs) * weights).square().sum().backward()
    for a, b in zip(ours, theirs, strict=True):
        assert a.grad is not None and b.grad is not None
        assert (a.grad - b.grad).abs().max() < 2e-3 * b.grad.abs().max()


def test_gradient_descent_recovers_a_colour() -> None:
    centers, radii, opacities, colors = leaves(torch.float32)
    with torch.no_grad():
        target = rasterise(CAMERA, centers, radii, opacities, colors)
    guess = torch.full_like(colors, 0.5, requires_grad=True)
    adam = torch.optim.Adam([guess], lr=0.05)
    first = last = 0.0
    for step in range(60):
        loss = (
            (rasterise(CAMERA, centers.detach(), radii.detach(), opacities.detach(), guess) - target).square().mean()
        )
        adam.zero_grad()
        loss.backward()
        adam.step()
        first, last = (loss.item() if step == 0 else first), loss.item()
    assert last < 0.01 * first

"""The optimiser step: Adam as written in its paper, chain rule to the parameters, noise gate."""

import numpy as np
import torch

from splatctrl_cli.kernels.raster import (
    Float32,
    Moments,
    OptimiserSettings,
    Rasteriser,
    optimiser_step,
    pack_camera,
    unpack_parameters,
)
from tests.kernels.scenes import moments
from tests.reference import raster as reference

RATES = [2e-4] * 3 + [5e-3] + [3e-3] * 3 + [2e-2]


def settings(noise: float = 0.0, regulariser: float = 0.0) -> OptimiserSettings:
    return OptimiserSettings(
        lr_center=2e-4,
        lr_log_radius=5e-3,
        lr_color=3e-3,
        lr_logit_opacity=2e-2,
        regulariser=regulariser,
        noise=noise,
        min_opacity=0.1,
        min_radius=1e-4,
        max_radius=1.0,
        radius_depth=0.0,
    )


def splats(count: int = 30) -> Float32:
    rng = np.random.default_rng(2)
    p = np.zeros((count, 8), np.float32)
    p[:, :3] = rng.uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.2], (count, 3))
    p[:, 3] = np.log(rng.uniform(0.02, 0.06, count))
    p[:, 4:7] = rng.uniform(0.2, 0.8, (count, 3))
    p[:, 7] = rng.uniform(-1.5, 1.5, count)
    return p


def stepped(p: Float32, state: Moments, chosen: OptimiserSettings, upstream: Float32, seed: int = 1) -> Rasteriser:
    raster = Rasteriser(1)
    centers, radii, colors, opacities = unpack_parameters(p, 1)
    raster.prepare(CAMERA, centers, radii, opacities, colors)
    optimiser_step(raster, raster.backward(raster.forward(), upstream), p, state, chosen, seed)
    return raster


CAMERA = pack_camera(60.0, 60.0, 24.0, 16.0, 48, 32, np.eye(4))


def test_three_steps_equal_torch_adam_on_the_reference_renderer() -> None:
    p = splats()
    leaf = torch.tensor(p.astype(np.float64), requires_grad=True)
    state = moments(len(p))
    parts = [leaf[:, k : k + 1].detach().clone().requires_grad_() for k in range(8)]
    adam = torch.optim.Adam([{"params": [part], "lr": lr} for part, lr in zip(parts, RATES, strict=True)], eps=1e-15)
    for step in range(3):
        upstream = np.random.default_rng(step).normal(size=(5, 32, 48)).astype(np.float32)
        stepped(p, state, settings(), upstream)
        joined = torch.cat(parts, 1)
        planes = reference.render(
            torch.tensor(CAMERA), joined[:, :3], joined[:, 3].exp(), joined[:, 7].sigmoid(), joined[:, 4:7]
        )
        adam.zero_grad()
        planes.backward(torch.tensor(upstream.astype(np.float64)))
        adam.step()
    want = torch.cat(parts, 1).detach().numpy()
    assert np.median(np.abs(want - splats()) / RATES) > 1.0 and np.median(np.abs(p - want) / RATES) < 2e-3
    assert np.quantile(np.abs(p - want) / RATES, 0.98) < 0.05


def test_splats_out_of_view_keep_parameters_and_moments() -> None:
    p = splats()
    p[:10, 2] = -1.0
    before, state = p.copy(), moments(len(p))
    stepped(p, state, settings(noise=5e5), np.ones((5, 32, 48), np.float32))
    assert np.array_equal(p[:10], before[:10])
    assert not state.num_steps[:10].any() and (state.num_steps[10:] == 1).all()


def test_noise_moves_transparent_splats_and_leaves_opaque_ones() -> None:
    p = splats()
    p[:, 7] = np.where(np.arange(len(p)) < 15, -2.6, 2.0)  # opacity 0.07 and 0.88
    before = p.copy()
    stepped(p, moments(len(p)), settings(noise=5e5), np.zeros((5, 32, 48), np.float32))
    moved = np.linalg.norm(p[:, :3] - before[:, :3], axis=1)
    assert (moved[:15] > 1e-5).all() and (moved[:15] <= 0.5 * np.sqrt(3) * np.exp(before[:15, 3]) + 1e-6).all()
    assert (moved[15:] < 1e-7).all()


def test_noise_depends_on_the_seed_alone() -> None:
    results = []
    for seed in (7, 7, 8):
        results.append(splats())
        results[-1][:, 7] = -2.6
        stepped(results[-1], moments(30), settings(noise=5e5), np.zeros((5, 32, 48), np.float32), seed)
    assert np.array_equal(results[0], results[1]) and not np.array_equal(results[0], results[2])


def test_the_regulariser_lowers_opacity() -> None:
    p = splats()
    before = p.copy()
    stepped(p, moments(len(p)), settings(regulariser=0.01), np.zeros((5, 32, 48), np.float32))
    assert (p[:, 7] < before[:, 7]).all()


def test_colours_stay_in_their_range() -> None:
    for sign, end in ((-1.0, 1.0), (1.0, 0.0)):
        p = splats()
        p[:15, 4:7], p[15:, 4:7] = end, 0.5
        for _ in range(3):
            stepped(p, moments(len(p)), settings(), np.full((5, 32, 48), sign, np.float32))
        assert (p[:15, 4:7] == end).all() and (sign * (p[15:, 4:7] - 0.5) < 0.0).all()

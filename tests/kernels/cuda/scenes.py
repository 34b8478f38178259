"""Splats and views for the kernels of the device: made in code, some splats out of sight, equal in depth, faint."""

import numpy as np

from splatctrl_cli.geometry import invert_transform, look_at
from splatctrl_cli.kernels.raster import (
    Float32,
    Float64,
    ImageLoss,
    LossTerms,
    LossWeights,
    Moments,
    OptimiserSettings,
    Rasteriser,
    TargetView,
    optimiser_step,
    pack_camera,
    unpack_parameters,
)
from tests.kernels.scenes import visible

WEIGHTS = LossWeights(dssim=0.2, color=1.0, depth=0.7, opacity=0.1, normalised=True, background=(0.9, 0.2, 0.5))
SETTINGS = OptimiserSettings(
    lr_center=2e-4, lr_log_radius=5e-3, lr_color=3e-3, lr_logit_opacity=2e-2, regulariser=1e-5, noise=5e5,
    min_opacity=0.1, min_radius=1e-4, max_radius=0.3, radius_depth=1.0,
)  # fmt: skip


def camera(width: int = 83, height: int = 61, from_: tuple[float, float, float] = (0.9, 0.2, 0.6)) -> Float64:
    """Off-centre principal point, sizes that are no multiple of a tile or a patch."""
    T_world_camera = look_at(from_, (0.0, 0.0, 0.05))
    fx = 1.1 * width
    return pack_camera(fx, 0.98 * fx, 0.54 * width, 0.46 * height, width, height, invert_transform(T_world_camera))


def parameters(count: int, radius: float = 0.03, seed: int = 0) -> Float32:
    rng = np.random.default_rng(seed)
    p = np.zeros((count, 8), np.float32)
    p[:, :3] = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.3], (count, 3))
    p[:, 3] = np.log(rng.uniform(0.4 * radius, 2.0 * radius, count))
    p[:, 4:7] = rng.uniform(0.0, 1.0, (count, 3))
    p[:, 7] = rng.uniform(-3.0, 3.0, count)
    p[: count // 10] = p[count // 10 : 2 * (count // 10)]  # clones: equal in depth
    p[count // 2 : count // 2 + count // 20, :3] += [3.0, 0.0, 0.0]  # behind the camera
    p[count // 2 + count // 20 : count // 2 + count // 10, 7] = -30.0  # dead slots
    return p


class OnProcessor:
    """One iteration of the package's own kernels, with what stands between them."""

    def __init__(self, p: Float32, view: Float64) -> None:
        self.parameters = p.copy()
        centers, radii, colors, opacities = unpack_parameters(self.parameters, 1)
        self.raster = Rasteriser(1)
        self.raster.prepare(view, centers, radii, opacities, colors)
        self.planes = self.raster.forward()

    def loss(
        self, seen: TargetView, weights: LossWeights, planes: Float32 | None = None
    ) -> tuple[Float32, LossTerms]:
        out = np.empty_like(self.planes)
        return out, ImageLoss(1).evaluate(self.planes if planes is None else planes, seen, weights, out)

    def gradients(self, plane_gradients: Float32, regulariser: float) -> Float32:
        """By the parameters (N, 8), regulariser included, of the splats that are seen."""
        by_footprint = self.raster.backward(self.planes, plane_gradients)
        centers, radii = self.raster.project_backward(by_footprint)
        _, radius, _, opacity = unpack_parameters(self.parameters, 1)
        slope = opacity * (1.0 - opacity)
        out = np.concatenate(
            [centers, (radii * radius)[:, None], by_footprint[:, 7:10],
             ((by_footprint[:, 6] + np.float32(regulariser)) * slope)[:, None]], axis=1,
        )  # fmt: skip
        out[~visible(self.raster)] = 0.0
        return out

    def step(self, plane_gradients: Float32, state: Moments, settings: OptimiserSettings, seed: int) -> None:
        optimiser_step(
            self.raster, self.raster.backward(self.planes, plane_gradients), self.parameters, state, settings, seed
        )

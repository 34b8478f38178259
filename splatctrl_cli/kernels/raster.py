"""Splat rasteriser, image loss and optimiser; anisotropic Gaussians: typed wrappers.

N splats or Gaussians, (H, W) pixels. `planes` (5, H, W): red, green, blue, depth [m], accumulated opacity.
`parameters` of Gaussians (N, 59): centre (3) [m], log scales (3), wxyz quaternion (4, nonzero), logit opacity, 16
spherical-harmonic coefficients each of red, green, blue.
"""

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import Float32, Float64, native


def pack_camera(
    fx: float, fy: float, cx: float, cy: float, width: int, height: int, T_camera_world: Float64
) -> Float64:
    """Camera (18,) as the kernels take it."""
    return np.concatenate(
        [[fx, fy, cx, cy, width, height], T_camera_world[:3, :3].ravel(), T_camera_world[:3, 3]]
    ).astype(np.float64)


def empty_planes(height: int, width: int) -> Float32:
    """Planes (5, H, W) aligned so that a tile's row is one cache line."""
    size = 5 * height * width
    memory = np.empty(size + 16, np.float32)
    first = -(memory.ctypes.data // 4) % 16
    return memory[first : first + size].reshape(5, height, width)


class PreparedView:
    """Renders a prepared view; keeps its buffers."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self.native: Any = native.Rasteriser()
        self._inputs: tuple[Float32, ...] = ()  # the kernel keeps pointers to them until the next `prepare`
        self._shape = (0, 0)

    def forward(self, out: Float32 | None = None) -> Float32:
        """Planes (5, H, W) (eq. 2 and 3)."""
        planes = empty_planes(*self._shape) if out is None else out
        self.native.forward(planes, self.num_threads)
        return planes


class Rasteriser(PreparedView):
    """Renders and differentiates a view of splats."""

    def prepare(self, camera: Float64, centers: Float32, radii: Float32, opacities: Float32, colors: Float32) -> None:
        """Project (eq. 1), sort and bin splats for a `pack_camera` camera."""
        self._inputs = (centers, radii, opacities, colors)
        self._shape = (int(camera[5]), int(camera[4]))
        self.native.prepare(camera, centers, radii, opacities, colors, self.num_threads)

    def backward(self, planes: Float32, plane_gradients: Float32, out: Float32 | None = None) -> Float32:
        """Gradients (N, 10): u, v, conic a, b, c, depth, opacity, red, green, blue."""
        gradients = np.empty((len(self._inputs[1]), 10), np.float32) if out is None else out
        self.native.backward(planes, plane_gradients, gradients, self.num_threads)
        return gradients

    def project_backward(self, gradients: Float32) -> tuple[Float32, Float32]:
        """Gradients of centres (N, 3), world, and radii (N,) from `backward`'s."""
        centers, radii = self._inputs[:2]
        out = np.empty((len(radii), 4), np.float32)
        self.native.project_backward(centers, radii, gradients, out)
        return out[:, :3].copy(), out[:, 3].copy()


@dataclass(frozen=True, kw_only=True)
class LossTerms:
    """Means over one image: |colour error|, 1 - SSIM, |depth error| [m], 1 - opacity, squared colour error."""

    l1: float
    dssim: float
    depth: float
    transmittance: float
    squared: float


@dataclass(frozen=True, kw_only=True)
class LossWeights:
    """Weights of eq. 4; `normalised` compares depth divided by accumulated opacity.

    opacity: of mean transmittance where there is depth, 0 in the paper; background: colour + (1 - opacity) background
    is compared.
    """

    dssim: float
    color: float
    depth: float
    opacity: float
    normalised: bool
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class TargetView:
    """An image: color (3, H, W); depth (H, W) [m], 0 = none; counted (H, W), 0 = ignored."""

    color: NDArray[np.uint8]
    depth: Float32
    counted: NDArray[np.uint8]


class ImageLoss:
    """Value and gradient of the image part of eq. 4."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self._native: Any = native.ImageLoss()

    def evaluate(self, planes: Float32, view: TargetView, weights: LossWeights, out: Float32) -> LossTerms:
        """Loss of planes (5, H, W); write its derivative to out (5, H, W)."""
        height, width = view.depth.shape
        w = weights
        l1, dssim, error, transmittance, squared = self._native.evaluate(
            planes, view.color, view.depth, view.counted, width, height,
            np.array([w.dssim, w.color, w.depth, w.opacity, *w.background]), w.normalised, out, self.num_threads,
        )  # fmt: skip
        return LossTerms(l1=l1, dssim=dssim, depth=error, transmittance=transmittance, squared=squared)


@dataclass(frozen=True, kw_only=True)
class OptimiserSettings:
    """Learning rates and limits, in kernel order (`SceneConfig`)."""

    lr_center: float
    lr_log_radius: float
    lr_color: float
    lr_logit_opacity: float
    regulariser: float
    noise: float
    min_opacity: float
    min_radius: float
    max_radius: float
    radius_depth: float


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Adam's state: first, second (N, 8), num_steps (N,) since a slot was filled."""

    first: Float32
    second: Float32
    num_steps: NDArray[np.uint32]


def optimiser_step(
    raster: Rasteriser,
    gradients: Float32,
    parameters: Float32,
    moments: Moments,
    settings: OptimiserSettings,
    seed: int,
) -> None:
    """Make one Adam step on parameters (N, 8) of the prepared view, in place.

    Parameters: centre (3) [m], log radius, colour (3), logit opacity.
    """
    native.optimiser_step(
        raster.native, gradients, parameters, moments.first, moments.second, moments.num_steps,
        np.array(astuple(settings)), seed, raster.num_threads,
    )  # fmt: skip


def unpack_parameters(parameters: Float32, num_threads: int) -> tuple[Float32, Float32, Float32, Float32]:
    """Centers (N, 3), radii (N,), colors (N, 3), opacities (N,) of parameters (N, 8)."""
    count = len(parameters)
    centers, colors = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    radii, opacities = np.empty(count, np.float32), np.empty(count, np.float32)
    native.unpack_parameters(parameters, centers, radii, colors, opacities, num_threads)
    return centers, radii, colors, opacities


NUM_PARAMETERS = 59
CENTER, LOG_SCALE, QUAT, LOGIT, HARMONICS = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 59)


class GaussianRasteriser(PreparedView):
    def prepare(self, camera: Float64, parameters: Float32, degree: int = 3) -> None:
        """Project, colour (harmonics to `degree`), sort and bin for a `pack_camera` camera."""
        colors = np.empty((len(parameters), 3), np.float32)
        self._inputs, self._shape = (colors,), (int(camera[5]), int(camera[4]))
        native.prepare_gaussians(self.native, camera, parameters, degree, colors, self.num_threads)

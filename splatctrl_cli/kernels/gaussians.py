"""Anisotropic Gaussians on the rasteriser of the compiled module, with shapes checked and outputs allocated.

Shapes: N Gaussians, (H, W) pixels. A row of `parameters` (N, 59) float32 is centre (3) [m], log scales (3), wxyz
quaternion (4, of any length but zero), logit opacity, then 16 spherical-harmonic coefficients each of red, green and
blue.
"""

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels import Float32, Float64, native
from splatctrl_cli.kernels.raster import empty_planes

NUM_PARAMETERS = 59
CENTER, LOG_SCALE, QUAT, LOGIT, HARMONICS = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 59)
RED_0, GREEN_0, BLUE_0 = 11, 27, 43  # the constant coefficient of each colour
GRADIENT_SUM, NUM_VIEWS, SCREEN_RADIUS = 0, 1, 2  # columns of `GaussianArrays.growth`


class GaussianRasteriser:
    """Renders one view of Gaussians at a time and differentiates it; keeps its buffers between calls."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self.native: Any = native.Rasteriser()
        self.degree = 0
        self._colors: Float32 = np.empty((0, 3), np.float32)
        self._gradients: Float32 = np.empty((0, 10), np.float32)
        self._shape = (0, 0)

    def prepare(self, camera: Float64, parameters: Float32, degree: int = 3) -> None:
        """Project, colour (harmonics up to `degree`), sort and bin the Gaussians for a `pack_camera` camera."""
        if len(self._colors) != len(parameters):
            self._colors = np.empty((len(parameters), 3), np.float32)  # the kernel keeps a pointer to it
            self._gradients = np.empty((len(parameters), 10), np.float32)
        self._shape = (int(camera[5]), int(camera[4]))
        self.degree = degree
        native.prepare_gaussians(self.native, camera, parameters, degree, self._colors, self.num_threads)

    def forward(self, out: Float32 | None = None) -> Float32:
        """Planes (5, H, W) of the prepared view: red, green, blue, depth [m], accumulated opacity."""
        planes = empty_planes(*self._shape) if out is None else out
        self.native.forward(planes, self.num_threads)
        return planes

    def backward(self, planes: Float32, plane_gradients: Float32) -> Float32:
        """Gradients (N, 10) of the footprints: u, v, conic a, b, c, depth, opacity, red, green, blue.

        The next call writes to the same array.
        """
        self.native.backward(planes, plane_gradients, self._gradients, self.num_threads)
        return self._gradients

    def parameter_gradients(self, parameters: Float32, gradients: Float32) -> Float32:
        """Gradients (N, 59) of the prepared parameters from those of their footprints (N, 10)."""
        out = np.empty((len(self._colors), NUM_PARAMETERS), np.float32)
        native.gaussian_gradients(self.native, parameters, self.degree, gradients, out, self.num_threads)
        return out

    def visible(self) -> NDArray[np.bool_]:
        """(N,) True for Gaussians on some tile's list."""
        out = np.empty(len(self._colors), np.uint8)
        self.native.visible(out)
        return out.astype(bool)


@dataclass(frozen=True, kw_only=True)
class GaussianArrays:
    """Parameters (N, 59), Adam's moments (N, 59), num_steps (N,) uint32, and what densification looks at.

    growth (N, 3): sum of screen gradients |dL/d(u, v)| in units of half an image, the number of views summed, and the
    largest radius on a screen [px] (three sigmas).
    """

    parameters: Float32
    first: Float32
    second: Float32
    num_steps: NDArray[np.uint32]
    growth: Float32

    def __len__(self) -> int:
        return len(self.num_steps)


@dataclass(frozen=True, kw_only=True)
class GaussianRates:
    """Learning rates of one step, in the order of the kernels; color is the constant harmonic's, harmonics that of
    the others.

    regulariser: derivative of lambda_reg times the mean opacity with respect to one opacity.
    """

    center: float
    log_scale: float
    quat: float
    logit_opacity: float
    color: float
    harmonics: float
    regulariser: float


def gaussian_step(
    raster: GaussianRasteriser, gradients: Float32, arrays: GaussianArrays, rates: GaussianRates
) -> None:
    """One Adam step on `arrays`, in place, for the Gaussians of the prepared view."""
    native.gaussian_step(
        raster.native, raster.degree, gradients, arrays.parameters, arrays.first, arrays.second, arrays.num_steps,
        arrays.growth, np.array(astuple(rates)), raster.num_threads,
    )  # fmt: skip

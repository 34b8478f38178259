"""A training step of anisotropic Gaussians on the compiled module: the gradients of a rendered view, and Adam.

Shapes: N Gaussians, (H, W) pixels. A row of `parameters` (N, 59) is as `gaussian_kernels` renders it.
"""

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.blocks import Float32, Float64, gaussian_kernels, native

NUM_PARAMETERS = gaussian_kernels.NUM_PARAMETERS
CENTER, LOG_SCALE, QUAT = gaussian_kernels.CENTER, gaussian_kernels.LOG_SCALE, gaussian_kernels.QUAT
LOGIT, HARMONICS = gaussian_kernels.LOGIT, gaussian_kernels.HARMONICS
GRADIENT_SUM, NUM_VIEWS, SCREEN_RADIUS = 0, 1, 2  # columns of `GaussianArrays.growth`


class TrainingRasteriser(gaussian_kernels.GaussianRasteriser):
    """Renders one view of Gaussians at a time and differentiates it."""

    def __init__(self, num_threads: int) -> None:
        super().__init__(num_threads)
        self.degree = 0
        self._gradients: Float32 = np.empty((0, 10), np.float32)

    def prepare(self, camera: Float64, parameters: Float32, degree: int = 3) -> None:
        """Prepare a view, as to be rendered."""
        super().prepare(camera, parameters, degree)
        self.degree = degree
        if len(self._gradients) != len(parameters):
            self._gradients = np.empty((len(parameters), 10), np.float32)

    def backward(self, planes: Float32, plane_gradients: Float32) -> Float32:
        """Gradients (N, 10) of the footprints: u, v, conic a, b, c, depth, opacity, red, green, blue.

        The next call writes to the same array.
        """
        self.native.backward(planes, plane_gradients, self._gradients, self.num_threads)
        return self._gradients


@dataclass(frozen=True, kw_only=True)
class GaussianArrays:
    """Parameters (N, 59), Adam's moments (N, 59), num_steps (N,) uint32, and densification's statistics.

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
    """Learning rates of one step, in the order of the kernels; color: of the constant harmonic; harmonics: of the
    other harmonics.

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
    raster: TrainingRasteriser, gradients: Float32, arrays: GaussianArrays, rates: GaussianRates
) -> None:
    """One Adam step on `arrays`, in place, for the Gaussians of the prepared view."""
    native.gaussian_step(
        raster.native, raster.degree, gradients, arrays.parameters, arrays.first, arrays.second, arrays.num_steps,
        arrays.growth, np.array(astuple(rates)), raster.num_threads,
    )  # fmt: skip

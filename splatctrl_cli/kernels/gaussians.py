"""Anisotropic Gaussians on the rasteriser.

Shapes: N Gaussians, (H, W) pixels. `parameters` (N, 59): centre (3) [m], log scales (3), wxyz quaternion (4, any
length but zero), logit opacity, 16 spherical-harmonic coefficients each of red, green, blue.
"""

from typing import Any

import numpy as np

from splatctrl_cli.kernels import Float32, Float64, native
from splatctrl_cli.kernels.raster import empty_planes

NUM_PARAMETERS = 59
CENTER, LOG_SCALE, QUAT, LOGIT, HARMONICS = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 59)


class GaussianRasteriser:
    """Renders a view of Gaussians; keeps its buffers."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self.native: Any = native.Rasteriser()
        self._colors: Float32 = np.empty((0, 3), np.float32)
        self._shape = (0, 0)

    def prepare(self, camera: Float64, parameters: Float32, degree: int = 3) -> None:
        """Project, colour (harmonics to `degree`), sort and bin for a `pack_camera` camera."""
        if len(self._colors) != len(parameters):
            self._colors = np.empty((len(parameters), 3), np.float32)  # the kernel keeps a pointer to it
        self._shape = (int(camera[5]), int(camera[4]))
        native.prepare_gaussians(self.native, camera, parameters, degree, self._colors, self.num_threads)

    def forward(self) -> Float32:
        """Planes (5, H, W), as in `kernels.raster`."""
        planes = empty_planes(*self._shape)
        self.native.forward(planes, self.num_threads)
        return planes

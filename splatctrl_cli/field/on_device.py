"""Distance fields on a card."""

from collections.abc import Mapping
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres, checked_points
from splatctrl_cli.field.distance import KERNEL_OF, KERNELS, LogSumExpField
from splatctrl_cli.field.grid_cells import RESOLUTION
from splatctrl_cli.kernels.cuda.field import Answers, Choice, DeviceField
from splatctrl_cli.kernels.cuda.memory import Memory
from splatctrl_cli.records import Float64


class OnDevice:
    """The field that ``config.distance`` names, on a device."""

    def __init__(self, spheres: Spheres, config: FieldConfig, device: Memory, *, threads: int = 1) -> None:
        """The processor makes the weights. Raises OutOfMemory."""
        self.spheres, kernel = spheres, KERNEL_OF[config.distance]
        kernels = {} if kernel is None else {kernel: KERNELS[kernel](spheres, config, threads=threads)}
        self.field = device_field(spheres, kernels, config, device)

    @classmethod
    def of(cls, centers: ArrayLike, radii: ArrayLike, config: FieldConfig, device: Memory) -> Self:
        """Make the field over (N, 3), (N,) [m]. Raises as `Spheres.of`."""
        return cls(Spheres.of(centers, radii), config, device)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and gradient, as in `DistanceField.query`."""
        if not len(points):
            return np.zeros(0), np.zeros((0, 3))
        found = self._asked(points, "gradient")
        assert found.gradient is not None
        return found.distance.astype(np.float64), found.gradient.astype(np.float64)

    def distance(self, points: Float64) -> Float64:
        """points (Q, 3) [m] -> distance (Q,) [m]."""
        return self._asked(points).distance.astype(np.float64) if len(points) else np.zeros(0)

    def nearest(self, points: Float64) -> NDArray[np.int64]:
        """points (Q, 3) [m] -> index (Q,) of the sphere that gives the exact distance."""
        if not len(points):
            return np.zeros(0, np.int64)
        found = self._asked(points, "entry")
        assert found.entry is not None
        return self.spheres.points.source[found.entry]

    def _asked(self, points: Float64, *wanted: str) -> Answers:
        return self.field.query(checked_points(points), self.spheres.points.anchor, wanted)

    def close(self) -> None:
        """Free the device's memory."""
        self.field.close()


def device_field(
    spheres: Spheres, kernels: Mapping[str, LogSumExpField], config: FieldConfig, device: Memory
) -> DeviceField:
    """Put the exact distance and `kernels` on a device, for ``config.distance``."""
    chosen = KERNEL_OF[config.distance]
    choice = Choice(kernel=chosen, is_single=config.distance == chosen, resolution=RESOLUTION)
    terms = {name: field.terms() for name, field in kernels.items()}
    radii = spheres.points.offsets(spheres.radii)
    return DeviceField(device, spheres.points.clusters, radii, terms, choice)

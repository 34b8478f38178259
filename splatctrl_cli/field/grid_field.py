"""A baked grid as a distance field."""

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.field.clusters import checked_points
from splatctrl_cli.field.grid_cells import HALF_DIAGONAL
from splatctrl_cli.kernels import field as native
from splatctrl_cli.records import Box, DistanceGrid, Float32, Float64


class GridField:
    """Trilinear interpolation between cell centres.

    Outside their box it reads the value at the box's nearest point minus the distance to it. This lower bound shows
    a robot outside less clearance, never more. Next to a NaN cell (policy ``nan``), this and the certified distance
    are NaN.
    """

    def __init__(self, grid: DistanceGrid, channel: str = "sdf") -> None:
        """Raises InputError without the channel or for one cell along an axis."""
        if channel not in grid.channels:
            raise InputError(f"distance grid: no channel {channel!r}", remedy=f"it has: {', '.join(grid.channels)}")
        self._values = np.ascontiguousarray(grid.channels[channel], dtype=np.float32)
        if self._values.ndim != 3 or min(self._values.shape) < 2:
            raise InputError(
                f"distance grid: expected at least 2 cells along each axis, got {self._values.shape}",
                remedy="bake a larger box or a smaller voxel",
            )
        self._has_blank = bool(np.isnan(self._values).any())
        bound = grid.channels.get("bound")
        self._bound = None if bound is None else np.ascontiguousarray(bound, dtype=np.float32)
        self._origin = np.ascontiguousarray(grid.origin, dtype=np.float64)
        self._voxel = grid.voxel
        upper = self._origin + grid.voxel * (np.array(self._values.shape) - 1)
        self.box = Box(lower=self._origin, upper=upper)

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance and the interpolant's gradient, as in `DistanceField.query`."""
        return native.interpolate(self._values, self._origin, self._voxel, checked_points(points))

    def certified(self, points: Float64) -> Float64:
        """Lower bound (Q,) [m] of the exact distance to splats, not to objects.

        ``max over the corners of (hard(corner) - |x - corner|)``, less rounding: hard is 1-Lipschitz. It holds for
        obstacle cells, too. NaN where `query` is. Raises InputError without the channel bound.
        """
        if self._bound is None:
            raise InputError("distance grid: no channel 'bound'", remedy="bake it with --channels sdf,bound")
        # The channel bounds a whole cell: at its centre the exact distance is half a diagonal more.
        lowest = native.lipschitz_bound(self._bound, self._origin, self._voxel, checked_points(points))
        certified = np.asarray(lowest + HALF_DIAGONAL * self._voxel)
        if self._has_blank:
            certified[np.isnan(self.query(points)[0])] = np.nan
        return certified


def exact_channel(grid: DistanceGrid) -> Float32:
    """Exact distance (X, Y, Z) [m]: the channel hard, or bound plus its margin.

    Raises InputError without either.
    """
    if "hard" in grid.channels:
        return np.asarray(grid.channels["hard"], dtype=np.float32)
    margin = grid.header.get("bound_margin")
    if "bound" not in grid.channels or not isinstance(margin, float):
        raise InputError("distance grid: no channel 'hard' or 'bound'", remedy="bake it with --channels sdf,bound")
    return np.asarray(grid.channels["bound"], dtype=np.float32) + np.float32(margin)

"""Points sorted along a space-filling curve into groups of 16 with a box around each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels.field import LANES, Clusters, Float32
from splatctrl_cli.records import Float64

_SPARE_OFFSET = -1e30  # an entry so far away that nothing ever takes it
_BITS = 10  # of each coordinate in a Morton code


@dataclass(frozen=True, kw_only=True)
class ClusteredPoints:
    """N points as C clusters, relative to an anchor near them (float32 keeps 0.1 um within a metre or two).

    anchor (3,) float64 [m], world; source (16 C,) int64, the point behind each entry; is_spare (16 C,).
    """

    anchor: Float64
    source: NDArray[np.int64]
    is_spare: NDArray[np.bool_]
    centers: Float32
    bounds: Float32

    @property
    def num_points(self) -> int:
        """N."""
        return int(np.count_nonzero(~self.is_spare))

    def relative(self, points_world: NDArray[np.floating]) -> Float32:
        """Points (Q, 3), world -> (Q, 3) float32 relative to the anchor."""
        return np.ascontiguousarray(points_world - self.anchor, dtype=np.float32)

    def with_offsets(self, offsets: NDArray[np.floating]) -> Clusters:
        """The clusters with the offset o of each of the N points (N,) [m]."""
        laid_out = offsets.astype(np.float32)[self.source]
        laid_out[self.is_spare] = _SPARE_OFFSET
        return Clusters(
            centers=self.centers,
            bounds=self.bounds,
            offsets=laid_out,
            max_offsets=laid_out.reshape(-1, LANES).max(axis=1),
        )


def cluster_points(points_world: NDArray[np.floating]) -> ClusteredPoints:
    """Cluster points (N, 3) [m], N > 0; the same points in the same order give the same clusters."""
    points = np.asarray(points_world, dtype=np.float64)
    lower, upper = points.min(axis=0), points.max(axis=0)
    anchor = 0.5 * (lower + upper)
    order = np.argsort(_morton_codes(points, lower, float((upper - lower).max())), kind="stable")
    num_clusters = -(-len(points) // LANES)
    source = np.concatenate([order, np.repeat(order[-1:], num_clusters * LANES - len(order))])
    relative = (points - anchor).astype(np.float32)[source]
    grouped = relative.reshape(num_clusters, LANES, 3)
    return ClusteredPoints(
        anchor=anchor,
        source=source,
        is_spare=np.arange(len(source)) >= len(order),
        centers=np.ascontiguousarray(relative.T),
        bounds=np.ascontiguousarray(np.concatenate([grouped.min(axis=1), grouped.max(axis=1)], axis=1).T),
    )


def _morton_codes(points: Float64, lower: Float64, extent: float) -> NDArray[np.int64]:
    """Interleaved bits (N,) of the coordinates: neighbours along the curve are neighbours in space."""
    cells = ((points - lower) / max(extent, 1e-30) * (2**_BITS - 1)).astype(np.int64)
    codes = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes

"""Which voxels no splat stands for: every voxel against every sphere."""

import numpy as np

from splatctrl_cli.records import Bool, Float64


def unrepresented(voxel_centers: Float64, centers: Float64, radii: Float64, reach: float) -> Bool:
    """Voxels (K,) whose centres (K, 3) [m] are further than `reach` [m] from every sphere (N, 3), (N,) [m]."""
    missing = np.ones(len(voxel_centers), bool)
    for center, radius in zip(centers, radii, strict=True):
        missing &= np.sqrt(((voxel_centers - center) ** 2).sum(axis=1)) - radius > reach
    return missing

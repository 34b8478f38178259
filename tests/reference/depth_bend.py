"""A depth freed of its camera's bend, in plain float64: one pixel after the other."""

import numpy as np

from splatctrl_cli.records import Float64


def unbent_depth(depth: Float64, grid: Float64, most: float) -> Float64:
    """Depths (H, W) [m] after an offset of disparity, ``1 / z' = 1 / z - b``, b bilinear in a grid (rows, columns)
    [1/m] of which the first and the last nodes stand at the image's edges; b at most `most` of the disparity.
    """
    height, width = depth.shape
    free = np.zeros_like(depth)
    for v in range(height):
        for u in range(width):
            if not depth[v, u]:
                continue
            y, x = v * (grid.shape[0] - 1) / height, u * (grid.shape[1] - 1) / width
            i, j = int(y), int(x)
            above = (1 - (x - j)) * grid[i, j] + (x - j) * grid[i, j + 1]
            below = (1 - (x - j)) * grid[i + 1, j] + (x - j) * grid[i + 1, j + 1]
            offset = (1 - (y - i)) * above + (y - i) * below
            disparity = 1 / depth[v, u]
            free[v, u] = 1 / (disparity - min(max(offset, -most * disparity), most * disparity))
    return free

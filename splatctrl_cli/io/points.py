"""Coloured point clouds, as structure from motion leaves them."""

from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.ply import read_table
from splatctrl_cli.records import PointCloud


def read_points(path: Path) -> PointCloud:
    """The points of a PLY file with x, y, z [m] and red, green, blue (0 to 255).

    Raises InputError for a file that is not whole, lacks one of these, or has no point.
    """
    ply = read_table(path, "vertex", ())
    missing = [name for name in ("x", "y", "z", "red", "green", "blue") if name not in ply]
    if missing:
        raise InputError(f"{path}: no coloured point cloud: missing properties {' '.join(missing)}")
    if not len(ply):
        raise InputError(f"{path}: has no points", remedy="give a point cloud of the scene")
    colors = np.column_stack([ply.column(name) for name in ("red", "green", "blue")]) / 255.0
    if colors.min() < 0.0 or colors.max() > 1.0:
        raise InputError(f"{path}: red, green, blue: expected 0 to 255, got up to {255.0 * colors.max():g}")
    points = np.column_stack([ply.column(name) for name in "xyz"])
    return PointCloud(points=points.astype(np.float32), colors=colors.astype(np.float32))

"""Coloured point clouds, as structure from motion leaves them."""

from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.ply import read_table
from splatctrl_cli.records import Float64, PointCloud


def read_points(path: Path) -> PointCloud:
    """The points of a PLY file with x, y, z [m] and red, green, blue (0 to 255).

    Raises InputError for a file that is not whole, lacks one of these, or has no point.
    """
    table = _columns(path, ("x", "y", "z", "red", "green", "blue"), "coloured point cloud")
    points, colors = table[:, :3], table[:, 3:] / 255.0
    if colors.min() < 0.0 or colors.max() > 1.0:
        raise InputError(f"{path}: red, green, blue: expected 0 to 255, got up to {255.0 * colors.max():g}")
    return PointCloud(points=points.astype(np.float32), colors=colors.astype(np.float32))


def read_positions(path: Path) -> Float64:
    """The points (N, 3) of a PLY file, in the file's own unit, whatever else it says of them.

    Raises InputError for a file that is not whole, lacks x, y or z, or has no point.
    """
    return _columns(path, ("x", "y", "z"), "point cloud")


def _columns(path: Path, names: tuple[str, ...], what: str) -> Float64:
    """Properties (N, K) of the points, at least one."""
    ply = read_table(path, "vertex", ())
    missing = [name for name in names if name not in ply]
    if missing:
        raise InputError(f"{path}: no {what}: missing properties {' '.join(missing)}")
    if not len(ply):
        raise InputError(f"{path}: has no points", remedy="give a point cloud of the scene")
    return np.column_stack([ply.column(name) for name in names])


def is_mesh(path: Path) -> bool:
    """Whether a file holds faces: any that is not a PLY, and a PLY whose header counts some."""
    if path.suffix.lower() != ".ply":
        return True
    try:
        with path.open("rb") as stream:
            header = stream.read(65536).partition(b"end_header")[0]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    counts = [line.split() for line in header.splitlines() if line.startswith(b"element face")]
    return bool(counts) and counts[0][-1] != b"0"

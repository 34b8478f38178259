"""Where DTU's own evaluation looks: ObsMaskN_10.mat and PlaneN.mat of its ObsMask folder, lengths in millimetres.

ObsMask (X, Y, Z) says which cells of BB (2, 3), Res [mm] wide, the reference scanner observed; points of the
reference count where P (4) . (x, y, z, 1) > 0, above the ground plane (DTU's PointCompareMain.m;
jzhangbs/DTUeval-python, eval.py).
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from splatctrl_cli.datasets.dtu import MILLIMETRES
from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Bool, Float64

MARGIN = 10  # [mm] of the masks that are used, the number in their names
BEFORE, BEYOND = 0.060, 0.120  # [m] outside the box within which points are kept (eval.py: patch_size, twice that)


@dataclass(frozen=True, kw_only=True)
class ObservedSpace:
    """is_observed (X, Y, Z): cells from `low` (3,) [m] on, `resolution` [m] wide, of a box up to `high` (3,) [m].

    plane (4,): a point (x, y, z) [m] is above the ground where plane . (x, y, z, 1) > 0.
    """

    is_observed: Bool
    low: Float64
    high: Float64
    resolution: float
    plane: Float64

    def near(self, points: Float64) -> Bool:
        """(Q,) True for points (Q, 3) [m] in the box or near it: others are compared with nothing."""
        return np.asarray(((points >= self.low - BEFORE) & (points < self.high + BEYOND)).all(axis=1))

    def observed(self, points: Float64) -> Bool:
        """(Q,) True for points (Q, 3) [m] in observed cells: these count in the accuracy."""
        cells = np.rint((points - self.low) / self.resolution).astype(np.int64)
        inside = np.flatnonzero(((cells >= 0) & (cells < self.is_observed.shape)).all(axis=1))
        observed = np.zeros(len(points), np.bool_)
        observed[inside] = self.is_observed[tuple(cells[inside].T)]
        return observed

    def above(self, points: Float64) -> Bool:
        """(Q,) True for points (Q, 3) [m] above the ground: these count in the completeness."""
        return np.asarray(points @ self.plane[:3] + self.plane[3] > 0)


def scan_number(scan: str) -> int:
    """24 of ``scan24``. Raises InputError for a name without a number."""
    match = re.search(r"(\d+)$", scan)
    if match is None:
        raise InputError(f"scan '{scan}': expected a name with DTU's number, such as scan24")
    return int(match[1])


def cloud_of_scan(folder: Path, scan: str) -> Path:
    """DTU's points of a scan (``stl024_total.ply``), or ``scan24.ply``. Raises InputError where there is neither."""
    names = [f"{scan}.ply"] + ([f"stl{scan_number(scan):03d}_total.ply"] if scan[-1:].isdigit() else [])
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{folder}: expected the points of {scan}, {' or '.join(names)}, got neither")


def read_observed(folder: Path, scan: str) -> ObservedSpace:
    """What of the space around a scan counts. Raises InputError naming the file."""
    number = scan_number(scan)
    path, plane_path = folder / f"ObsMask{number}_{MARGIN}.mat", folder / f"Plane{number}.mat"
    box, resolution = _array(path, "BB", 6).reshape(2, 3), float(_array(path, "Res", 1)[0])
    mask = np.asarray(_variable(path, "ObsMask")) != 0
    if mask.ndim != 3 or not resolution > 0 or not (box[1] > box[0]).all():
        raise InputError(
            f"{path}: expected ObsMask (X, Y, Z), a box BB and a width Res above 0, got {mask.shape}, {box.tolist()}"
            f" and {resolution:g}"
        )
    return ObservedSpace(
        is_observed=mask,
        low=box[0] / MILLIMETRES,
        high=box[1] / MILLIMETRES,
        resolution=resolution / MILLIMETRES,
        plane=_array(plane_path, "P", 4) * [1.0, 1.0, 1.0, 1.0 / MILLIMETRES],
    )


def _array(path: Path, name: str, size: int) -> Float64:
    values = np.asarray(_variable(path, name), np.float64).ravel()
    if values.size != size or not np.isfinite(values).all():
        raise InputError(f"{path}: {name}: expected {size} numbers, got {values.size}")
    return values


def _variable(path: Path, name: str) -> Any:
    if not path.is_file():
        raise InputError(f"{path}: no such file", remedy="give the folder ObsMask of DTU's SampleSet")
    try:
        return loadmat(path, variable_names=[name])[name]
    except KeyError:
        raise InputError(f"{path}: expected a variable {name}, got none") from None
    except Exception as error:  # scipy raises many kinds for a file that is no .mat
        raise InputError(f"{path}: not a MATLAB file that can be read: {error}") from None

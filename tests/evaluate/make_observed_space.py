"""Writes the masks and planes of DTU's own evaluation."""

from pathlib import Path

import numpy as np
from scipy.io import savemat

from splatctrl_cli.records import Bool, Float64

RESOLUTION = 5.0  # [mm]


def write_observed(folder: Path, number: int, low: Float64, high: Float64, is_observed: Bool | None = None) -> None:
    """The files of a scan: a box [mm], observed everywhere unless said otherwise, the ground half way up in z."""
    shape = tuple(int(n) for n in np.ceil((high - low) / RESOLUTION))
    mask = np.ones(shape, np.uint8) if is_observed is None else is_observed.astype(np.uint8)
    variables = {"ObsMask": mask, "BB": np.vstack([low, high]), "Res": RESOLUTION}
    savemat(folder / f"ObsMask{number}_10.mat", variables, do_compression=True)
    plane = np.array([[0.0], [0.0], [1.0], [-0.5 * (low[2] + high[2])]])
    savemat(folder / f"Plane{number}.mat", {"P": plane})

"""The views of the sample's scan, and the same with poses that are off and depths that are bent."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatctrl_cli.calibration.depth_bend import bends_alone, unbent
from splatctrl_cli.calibration.unknowns import transform_of
from splatctrl_cli.config import fixed
from splatctrl_cli.jobs.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.records import Float64, RgbdFrame


def views_of(sample_data: Path) -> list[RgbdFrame]:
    """Of a still scene, at their true poses."""
    source = open_to_train(RecordingRequest(path=sample_data / "dtu", is_dtu=True))
    return [record for record in source.records() if isinstance(record, RgbdFrame)]


def disturbed(views: Sequence[RgbdFrame], millimetres: float, degrees: float) -> list[RgbdFrame]:
    """Each view moved and turned by so much, in a random direction."""
    rng = np.random.default_rng(3)
    found = []
    for view in views:
        turn, move = rng.normal(size=(2, 3))
        turn, move = (axis / np.linalg.norm(axis) for axis in (turn, move))
        twist = np.concatenate([np.radians(degrees) * turn, 1e-3 * millimetres * move])
        found.append(replace(view, T_world_camera=view.T_world_camera @ transform_of(twist)))
    return found


def gains_of(num: int) -> Float64:
    """Gains (N, 3) of as many views: brighter or darker by up to a quarter, each colour by its own."""
    rng = np.random.default_rng(5)
    gains = np.exp(rng.uniform(-0.2, 0.2, (num, 1)) + rng.uniform(-0.05, 0.05, (num, 3)))
    return np.asarray(gains / np.exp(np.log(gains).mean(axis=0)))


def a_bend(largest: float) -> Float64:
    """A bend (rows, columns), a saddle, of so much [1/m] at most."""
    rows, columns = fixed.BEND_GRID
    v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    alone = bends_alone()
    shape = alone @ (alone.T @ (u * u - 0.5 * v * v + 0.5 * u * v).ravel())
    return (largest * shape / np.abs(shape).max()).reshape(rows, columns)


def bent(views: Sequence[RgbdFrame], bend: Float64) -> list[RgbdFrame]:
    """The views as a camera with that bend would have recorded them."""
    return [unbent(view, -bend) for view in views]

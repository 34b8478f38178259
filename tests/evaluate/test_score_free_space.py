"""Mass in free space and surfaces before the measured one, with known answers."""

import math

import numpy as np
import pytest

from splatctrl_cli.evaluate.score import free_mass, in_front
from splatctrl_cli.records import Label, SplatSet
from splatctrl_cli.voxels import OccupancyGrid
from tests.plain import plain_grid, plain_splats

FREE, FULL = -2.0, 2.0


def grid() -> OccupancyGrid:
    """Three voxels of 10 cm along x, from 0 on: free, full, never seen."""
    odds, updates = np.reshape([FREE, FULL, 0.0], (3, 1, 1)), np.reshape([4, 4, 0], (3, 1, 1))
    return plain_grid((3, 1, 1), 0.1, 0.05, log_odds=odds, num_updates=updates)


def splats(x: list[float], opacities: list[float], radii: list[float], labels: list[int] | None = None) -> SplatSet:
    return plain_splats([[value, 0.05, 0.05] for value in x], radii, opacities=opacities, labels=labels or 0)


def test_mass_is_opacity_times_radius_squared_of_what_stands_in_free_voxels() -> None:
    scene = splats([0.02, 0.18, 0.25, 7.0], [0.5, 0.5, 1.0, 1.0], [0.02, 0.01, 0.01, 0.01])
    assert free_mass(scene, grid(), 0.3) == pytest.approx(2.0 / (2.0 + 0.5 + 1.0 + 1.0))


def test_what_was_never_seen_or_is_full_is_not_free() -> None:
    assert free_mass(splats([0.15, 0.25], [0.9, 0.9], [0.01, 0.01]), grid(), 0.3) == 0.0


def test_the_threshold_is_that_of_the_occupancy() -> None:
    scene = splats([0.05], [0.9], [0.01])
    assert free_mass(scene, grid(), 0.3) == 1.0
    assert free_mass(scene, grid(), 0.1) == 0.0  # 1 / (1 + e^2) = 0.12


def test_the_robot_has_no_mass_and_no_mass_has_no_share() -> None:
    robot = splats([0.05, 0.15], [0.9, 0.9], [0.01, 0.01], [Label.ROBOT, Label.HUMAN])
    assert free_mass(robot, grid(), 0.3) == 0.0
    assert math.isnan(free_mass(splats([0.05], [0.9], [0.01], [Label.ROBOT]), grid(), 0.3))


def test_in_front_counts_pixels_that_have_both_depths() -> None:
    reference = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    depth = np.array([0.9, 0.98, 1.2, 0.0, 0.5, 0.5])
    mask = np.array([True, True, True, True, True, False])
    assert in_front(depth, reference, mask) == pytest.approx(1 / 3)
    assert math.isnan(in_front(depth, reference, np.zeros(6, bool)))

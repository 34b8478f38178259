"""Lengths of a path in joint space, and a least clearance that is proved between its waypoints."""

import numpy as np
import pytest

from experiments.paths import effector_length, joint_length, least_clearance
from splatctrl_cli.planner.planned import resampled
from tests.control.fakes import PlanarArm
from tests.planner.walls import clearance, one_wall, thin_post

PATH = np.array([[0.7, 0.2], [0.9, 2.0], [-0.4, 1.5], [-0.42, 1.5]])
ARM = PlanarArm()


def test_lengths_are_those_of_an_arc() -> None:
    turn = resampled(np.array([[-0.5, 0.0], [0.5, 0.0]]), 0.01)
    assert joint_length(turn) == pytest.approx(1.0)
    moved, turned = effector_length(ARM, turn, "tip")
    assert moved == pytest.approx(0.9, rel=1e-4)
    assert turned == pytest.approx(np.degrees(1.0))


@pytest.mark.parametrize("room", [one_wall(), thin_post()], ids=["wall", "needle"])
def test_the_least_clearance_lies_between_its_bounds(room: object) -> None:
    free = clearance(room)  # type: ignore[arg-type]
    proved = least_clearance(free, PATH, tolerance=1e-4)
    dense = float(np.min(free.at(resampled(PATH, 1e-4))))
    assert proved.lower <= dense <= proved.upper + 1e-6 and proved.upper - proved.lower <= 1e-4
    assert proved.num_checks < 2000

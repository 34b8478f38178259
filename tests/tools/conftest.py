"""Runs of the hunt and the campaigns look at no picture."""

import pytest

from splatctrl_cli.robot.model import RobotModel
from tests.quick import parsed_once, unpainted
from tools.hunt.trial import true_robot

__all__ = ["parsed_once", "unpainted"]


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    """The arm of the hunt."""
    return true_robot(tmp_path_factory.mktemp("robot"))

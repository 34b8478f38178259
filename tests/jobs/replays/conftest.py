"""What tests of replays share."""

import pytest

from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import Desk
from tests.jobs.stage import Stage


@pytest.fixture
def stage(desk: Desk, arm: RobotModel) -> Stage:
    return Stage(desk=desk, arm=arm)

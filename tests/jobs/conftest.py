"""What tests of replays share with those of the command, and with those of what reads replays."""

import pytest

from splatctrl_cli.robot.model import RobotModel
from tests.cli.conftest import (
    arm,
    desk,
    few_points,
    recording,
    short_sample,
    small_recording,
    splats,
    unchecked,
)
from tests.cli.replay_desk import Desk
from tests.jobs.stage import Stage, run
from tests.quick import painted, parsed_once, unpainted

__all__ = [
    "arm",
    "desk",
    "few_points",
    "painted",
    "parsed_once",
    "recording",
    "run",
    "short_sample",
    "small_recording",
    "splats",
    "unchecked",
    "unpainted",
]


@pytest.fixture
def stage(desk: Desk, arm: RobotModel) -> Stage:
    return Stage(desk=desk, arm=arm)

"""What replays share."""

from pathlib import Path

import pytest

from splatctrl_cli.io import state_source
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import Desk, FakeSource, logged


@pytest.fixture
def arm(sample_data: Path) -> RobotModel:
    return RobotModel.from_urdf(
        sample_data / "tabletop" / "robot.urdf", sample_data / "tabletop" / "robot_spheres.yaml"
    )


@pytest.fixture
def desk(tmp_path: Path, sample_data: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    tabletop = sample_data / "tabletop"
    robot = ["--urdf", str(tabletop / "robot.urdf"), "--spheres", str(tabletop / "robot_spheres.yaml")]
    desk = Desk(folder=tmp_path, source=FakeSource(states=logged()), robot=robot)
    opened = state_source.open_states
    monkeypatch.setattr(
        state_source,
        "open_states",
        lambda path, *rest: desk.source if path.name == desk.source.name else opened(path, *rest),
    )
    return desk

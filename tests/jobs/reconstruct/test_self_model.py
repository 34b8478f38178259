"""Learning a robot from a log, and what takes the file."""

from pathlib import Path

import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.jobs.reconstruct.self_model import LearnRequest, learn_robot
from splatctrl_cli.jobs.robot.logged_robot import with_self_model
from splatctrl_cli.robot.model import RobotModel


def test_a_log_whose_arm_is_as_its_urdf_draws_it_gives_a_self_model_without_parts(
    sample_data: Path, tmp_path: Path
) -> None:
    folder, out = sample_data / "tabletop", tmp_path / "self.npz"
    found = learn_robot(LearnRequest(log=folder / "log.mcap", urdf=folder / "robot.urdf", out=out))
    assert found.pieces() == [] and len(found.learned) > 3
    assert "panda_link0" in found.unknown
    model = RobotModel.from_urdf(folder / "robot.urdf", folder / "robot_spheres.yaml")
    assert len(with_self_model(model, out).surface.triangles) == len(model.surface.triangles)
    out.write_bytes(out.read_bytes()[:400])
    with pytest.raises(InputError, match="not a self-model"):
        with_self_model(model, out)

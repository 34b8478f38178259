"""The examples of other libraries' controllers; each is skipped where its library is not installed."""

import importlib
import re
from pathlib import Path

import numpy as np
import pinocchio
import pytest

from splatctrl_cli import ControllerInput, ControllerStart
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel

EXAMPLES = Path(__file__).parents[2] / "docs" / "controllers"
FRAME, PERIOD = "panda_hand", 0.01
COMPILER = (
    '<mujoco><compiler fusestatic="false" balanceinertia="true" boundmass="0.01" boundinertia="1e-4"/></mujoco>'
)
BENT = np.array([0.0, -0.4, 0.0, -2.2, 0.0, 1.9, 0.78])
LIBRARIES = {"pink": "pink_ik:PinkIk", "mink": "mink_ik:MinkIk", "crocoddyl": "crocoddyl_mpc:Mpc"}


def controller_input(arm: RobotModel, q: Float64, dq: Float64, goal: Float64) -> ControllerInput:
    return ControllerInput(
        stamp_ns=0,
        q=q,
        dq=dq,
        goal=goal,
        goal_twist=None,
        goal_posture=None,
        goal_velocity=None,
        pose=arm.frame_pose(q, FRAME),
        error=np.zeros(6),
        jacobian=arm.frame_jacobian(q, FRAME),
        rows=lambda: (),
    )


@pytest.mark.parametrize("library", LIBRARIES)
def test_an_example_drives_the_hand_to_its_goal(
    library: str, sample_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(library, reason=f"{library} is not installed: docs/controllers is not tried with it")
    if library == "crocoddyl" and pinocchio.__version__ == "4.1.0":
        pytest.skip("crocoddyl 3.2.1 crashes with pin 4.1.0")
    urdf = sample_data / "tabletop" / "robot.urdf"
    bare = re.sub(r"<(visual|collision)>.*?</\1>", "", urdf.read_text(), flags=re.DOTALL)
    (tmp_path / "robot.xml").write_text(bare.replace("</robot>", f"{COMPILER}</robot>"))
    for name, path in {"URDF": urdf, "MJCF": tmp_path / "robot.xml"}.items():
        monkeypatch.setenv(name, str(path))
    monkeypatch.syspath_prepend(EXAMPLES)
    whole = RobotModel.from_urdf(urdf, urdf.with_name("robot_spheres.yaml"))
    arm = whole.moved_by([name for name in whole.joint_names if "finger" not in name])
    goal = arm.frame_pose(BENT + np.array([0.3, 0.2, 0.1, 0.2, -0.1, 0.1, 0.2]), FRAME)
    start = ControllerStart(
        joints=arm.joint_names,
        lower=arm.lower,
        upper=arm.upper,
        velocity_limit=arm.velocity_limit,
        acceleration_limit=None,
        frame=FRAME,
        home=arm.middle,
        period=PERIOD,
        margin=0.02,
    )
    module, _, name = LIBRARIES[library].partition(":")
    controller = getattr(importlib.import_module(module), name)(start)
    q, dq = BENT.copy(), np.zeros(7)
    away = np.linalg.norm(goal[:3, 3] - arm.frame_pose(q, FRAME)[:3, 3])
    for _ in range(200):
        dq = np.clip(
            np.asarray(controller.step(controller_input(arm, q, dq, goal))), -arm.velocity_limit, arm.velocity_limit
        )
        q = q + PERIOD * dq
    assert np.linalg.norm(goal[:3, 3] - arm.frame_pose(q, FRAME)[:3, 3]) < 0.1 * away


@pytest.mark.parametrize("target", LIBRARIES.values())
def test_an_example_is_at_most_twenty_lines(target: str) -> None:
    body = (EXAMPLES / f"{target.partition(':')[0]}.py").read_text().split("\nclass ")[1]
    assert len([line for line in body.splitlines() if line.strip()]) <= 20

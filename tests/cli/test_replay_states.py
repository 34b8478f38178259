"""What replay says of the states of a log: their kinds, losses, fit to the robot and to the cameras."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, START, Desk, splats_of, write_scene
from tests.logs.make_states import START_NS, STEP_NS, states_of, write_mcap

pytestmark = pytest.mark.usefixtures("without_plots")
JOINTS = tuple(f"joint{i}" for i in range(1, 8))


def moving(num: int = 30) -> Float64:
    """Postures (T, 7) near START."""
    return np.asarray(START + 0.3 * np.sin(np.linspace(0, 2, num)[:, None] * np.arange(1, 8)))


@pytest.fixture
def scene(desk: Desk) -> str:
    return str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))


def replayed(desk: Desk, scene: str, log: Path, *more: str) -> int:
    arguments = ["replay", str(log), *desk.robot, "--scene", scene, "-o", str(desk.folder / "out"), *more]
    return main([*arguments, "--max-unknown", "1", "--report-only"])


def states_of_run(desk: Desk) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((desk.folder / "out" / "states.json").read_text())
    return found


def test_a_log_of_the_robot_alone_is_audited(desk: Desk, scene: str, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_mcap(desk.folder / "x.mcap", states_of(moving(), JOINTS))
    assert replayed(desk, scene, log) == 0
    said = capsys.readouterr().out
    assert "log: no camera is used" in said
    assert "log: /joint_states: no velocities recorded" in said
    found = states_of_run(desk)
    assert found["num_states"] == 30
    assert found["loss"]["differentiated_velocities"] == 30
    assert (found["end_effector_poses"], found["clock_offset"]) == (None, None)


def test_joints_of_two_topics_and_a_state_alone_are_replayed(desk: Desk, scene: str) -> None:
    q = moving()
    halves = states_of(q[:, 3:], JOINTS[3:], topic="/b") + states_of(q[:, :3], JOINTS[:3], topic="/a")
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", halves), "-q") == 0
    assert len(desk.rows()) == 30
    assert [float(desk.rows()[9][f"q_joint{j}"]) for j in range(1, 8)] == pytest.approx(q[9])
    alone = write_mcap(desk.folder / "y.mcap", states_of(q[:1], JOINTS))
    assert replayed(desk, scene, alone, "-q", "--force") == 0
    assert len(desk.rows()) == 1


def test_logged_end_effector_poses_are_compared_with_the_robot(
    desk: Desk, scene: str, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    q, link = moving(), arm.frame_names[-1]
    poses = [arm.frame_pose(row, link) for row in q]
    rows = [
        ",".join(repr(float(v)) for v in (i * 0.01, *row, *T[:3, 3], *quat_from_rotation(T[:3, :3])))
        for i, (row, T) in enumerate(zip(q, poses, strict=True))
    ]
    names = [f"q{i}" for i in range(7)]
    pose = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    (desk.folder / "run.csv").write_text("\n".join([",".join(["t", *names, *pose]), *rows]))
    described = desk.folder / "run.toml"
    table = {"file": "run.csv", "joints": list(JOINTS), "time": "t", "position": names, "pose": pose}
    described.write_text("[states]\n" + "\n".join(f"{key} = {value!r}" for key, value in table.items()))
    assert replayed(desk, scene, described) == 0
    assert f"log: 30 logged end-effector poses agree with {link}: median 0.00 mm" in capsys.readouterr().out
    found = states_of_run(desk)["end_effector_poses"]
    assert found["verdict"] == "agree"
    assert found["difference"]["max_position"] < 1e-9
    table["joints"] = list(JOINTS[::-1])
    described.write_text("[states]\n" + "\n".join(f"{key} = {value!r}" for key, value in table.items()))
    assert replayed(desk, scene, described, "--force") == 0
    assert "wrong URDF, joint order, or units?" in capsys.readouterr().out


def test_a_log_with_frames_says_how_the_clocks_agree(
    desk: Desk, scene: str, sample_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = sample_data / "tabletop" / "log.mcap"
    assert replayed(desk, scene, log, "--cameras", "cam0") == 0
    assert "log: clocks of cameras and robot: frames are stamped" in capsys.readouterr().out
    assert abs(states_of_run(desk)["clock_offset"]["offset_s"]) < 0.06


def jumping() -> list[int]:
    stamps = [START_NS + i * STEP_NS for i in range(30)]
    return [s - START_NS if i < 15 else s for i, s in enumerate(stamps)]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("degrees", "would fit as degrees; convert them"),
        ("names", "joints not in the log: joint1, joint2, joint3, joint4, joint5, joint6, joint7; the log has: a, b"),
        ("clocks", "/joint_states: mixed clocks: stamps jump by"),
        ("nan", "expected joint states, got none"),
        ("empty", "the log holds no messages"),
    ],
)
def test_states_that_cannot_be_used_are_refused_in_one_line(
    desk: Desk, scene: str, capsys: pytest.CaptureFixture[str], fault: str, said: str
) -> None:
    q = moving()
    messages = {
        "degrees": states_of(np.degrees(q), JOINTS),
        "names": states_of(q[:, :2], ("a", "b")),
        "clocks": [
            type(m)(log_ns=START_NS + i * STEP_NS, topic=m.topic, type_name=m.type_name, content=m.content)
            for i, m in enumerate(states_of(q, JOINTS, stamps=jumping()))
        ],
        "nan": states_of(q * np.nan, JOINTS),
        "empty": [],
    }[fault]
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", messages)) == 4
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error.splitlines()) == 1


def test_a_state_with_nan_is_damage(desk: Desk, scene: str) -> None:
    q = moving()
    q[7, 2] = np.nan
    assert replayed(desk, scene, write_mcap(desk.folder / "x.mcap", states_of(q, JOINTS)), "-q") == 3
    assert states_of_run(desk)["loss"]["damaged"] == 1

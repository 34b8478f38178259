"""``splatctrl replay --twist-topic`` on a log made in code."""

import json
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, START, Desk, splats_of, write_scene
from tests.logs.make_states import START_NS, states_of, write_mcap
from tests.states.test_twists import stamped

pytestmark = pytest.mark.usefixtures("unpainted")

NUM = 41  # states, every 10 ms
TWIST = [0.0, -0.1, 0.05, 0.0, 0.0, 0.0]


def replayed(desk: Desk, *options: str, frame: str = "link0", out: str = "out") -> int:
    """A replay of an arm that stands still in the log, while somebody asked it to move for 0.2 s."""
    names = desk.source.joint_names
    twists = [stamped(TWIST, START_NS + i * 50_000_000, frame) for i in range(5)]
    log = write_mcap(desk.folder / f"{out}.mcap", [*states_of(np.tile(START, (NUM, 1)), names), *twists])
    scene = desk.folder / "scene"
    if not scene.exists():
        write_scene(scene, (START_NS, splats_of(BALL)))
    known = ["--scene", str(scene), "-o", str(desk.folder / out), "-q"]
    return main(
        ["replay", str(log), *desk.robot, *known, "--set", "control.twist_timeout=0.1", "--report-only", *options]
    )


def test_a_driven_arm_does_what_the_log_asked_for(desk: Desk, arm: RobotModel) -> None:
    assert replayed(desk, "--twist-topic", "/cmd", "--mode", "closed-loop") == 0
    q = np.array([[float(row[f"q_{name}"]) for name in arm.joint_names] for row in desk.rows()])
    frame = arm.frame_names[-1]
    moved = arm.frame_pose(q[-1], frame)[:3, 3] - arm.frame_pose(q[0], frame)[:3, 3]
    np.testing.assert_allclose(moved, 0.31 * np.array(TWIST[:3]), atol=2e-3)  # 0.2 s, the time-out, one step
    metrics = desk.metrics()
    assert metrics["num_steps"] == NUM and metrics["goal_reached"] == 0
    assert metrics["twist_share"] == pytest.approx(31 / NUM) and metrics["twist_share_capped"] == 0
    assert metrics["max_twist_error_linear"] < 5e-3
    about = json.loads((desk.folder / "out" / "summary.json").read_text())["about"]
    assert about["outcome"] == "log-ended"


@pytest.mark.painted
def test_open_loop_says_how_the_command_misses_a_twist(desk: Desk) -> None:
    assert replayed(desk, "--twist-topic", "/cmd", "--mode", "open-loop", "--require", "twist_share>=0.7") == 0
    assert desk.metrics()["mean_velocity_difference"] > 0.05 > desk.metrics()["mean_twist_error_linear"]
    fast = ["--set", "control.max_linear_speed=0.05"]
    assert replayed(desk, "--twist-topic", "/cmd", "--mode", "open-loop", *fast, out="fast") == 0
    assert desk.metrics("fast")["twist_share_capped"] == 1


@pytest.mark.parametrize(
    ("options", "frame", "code", "said"),
    [
        (["--twist-topic", "/cmd"], "link0", 2, "an audit asks nobody"),
        (["--twist-frame", "link0"], "link0", 2, "expected --twist-topic"),
        (["--twist-topic", "/cmd", "--mode", "open-loop"], "odom", 4, "got frame 'odom'; give --twist-frame"),
        (["--twist-topic", "/no", "--mode", "open-loop"], "link0", 4, "topics with twists: /cmd"),
        (["--twist-topic", "/cmd", "--follow", "--mode", "open-loop"], "link0", 2, "not allowed with"),
    ],
)
def test_twists_that_cannot_be_used_are_said(
    desk: Desk, options: list[str], frame: str, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replayed(desk, *options, frame=frame) == code
    assert said in capsys.readouterr().err


def test_a_frame_of_ones_own_stands_for_one_that_is_not_known(desk: Desk) -> None:
    options = ["--twist-topic", "/cmd", "--mode", "open-loop", "--twist-frame", "world"]
    assert replayed(desk, *options, frame="odom") == 0
    assert Path(desk.folder / "out" / "steps.csv").is_file()

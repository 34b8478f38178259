"""``splatctrl replay`` against scenes whose distances are known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.bake import bake
from splatctrl_cli.grid_files.grid import write_npz
from splatctrl_cli.records import Box, LossReport
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import (
    BALL,
    SECOND,
    START,
    Desk,
    FakeSource,
    clearance,
    grid_seen,
    logged,
    splats_of,
    write_scene,
)

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.mark.painted
def test_an_audit_measures_every_logged_state(desk: Desk, arm: RobotModel) -> None:
    desk.source.states = logged(START + 0.3)
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q") == 0
    found = [float(row["clearance_exact"]) for row in desk.rows()]
    np.testing.assert_allclose(found, [clearance(arm, s.position) for s in desk.source.states], atol=1e-6)
    assert desk.metrics()["min_clearance"] == pytest.approx(min(found), abs=1e-8)
    names = {"steps.csv", "events.json", "summary.json", "clearance.png", "run.json", "states.json"}
    assert {path.name for path in (desk.folder / "out").iterdir()} == names


def test_each_state_is_measured_in_the_newest_snapshot_not_later(desk: Desk, arm: RobotModel) -> None:
    small, large = (BALL[0], 0.02), (BALL[0], 0.08)
    scene = write_scene(
        desk.folder / "scene",
        (SECOND // 4, splats_of(small)),
        (SECOND // 2, splats_of(large)),
        (SECOND, splats_of(BALL)),
    )
    assert desk.replay("--scene", str(scene), "-q") == 0
    rows = desk.rows()
    assert desk.metrics()["num_before_scene"] == 3 and len(rows) == 8
    expected = [clearance(arm, START, ball) for ball in [small] * 2 + [large] * 5 + [BALL]]
    np.testing.assert_allclose([float(row["clearance_exact"]) for row in rows], expected, atol=1e-6)


def test_a_log_that_ends_before_the_scene_is_known_cannot_be_evaluated(
    desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(desk.folder / "scene", (5 * SECOND, splats_of(BALL)), (6 * SECOND, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q") == 5
    assert "all 11 joint states are earlier than the first known scene" in capsys.readouterr().err
    assert not (desk.folder / "out").exists() and not (desk.folder / "out.partial").exists()


def test_a_baked_field_says_nearly_the_same_and_certifies_less(desk: Desk, arm: RobotModel) -> None:
    box = Box(lower=np.array([-0.4, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.2]))
    (desk.folder / "field").mkdir()
    grid = bake(splats_of(BALL), box, replace(FieldConfig(), voxel=0.04), occupancy=grid_seen(), threads=1)
    write_npz(desk.folder / "field" / "field.npz", grid)
    assert desk.replay("--field", str(desk.folder / "field"), "-q") == 0
    row = desk.rows()[0]
    assert float(row["clearance_exact"]) == pytest.approx(clearance(arm, START), abs=2e-3)
    assert float(row["clearance_certified"]) <= clearance(arm, START) + 1e-6


def test_a_path_that_leaves_known_space_is_not_evaluated(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    box = Box(lower=np.array([-0.4, -1.0, 0.0]), upper=np.array([1.0, 1.0, 1.2]))
    seen = grid_seen()
    seen.num_updates[:, :, 15:] = 0  # above half a metre
    config = FieldConfig(voxel=0.04, unknown="nan")
    (desk.folder / "field").mkdir()
    write_npz(desk.folder / "field" / "field.npz", bake(splats_of(BALL), box, config, occupancy=seen, threads=1))
    assert desk.replay("--field", str(desk.folder / "field"), "-q", "--max-unknown", "1", is_judged=True) == 5
    assert "the path leaves known space: at 11 of 11 states a sphere is" in capsys.readouterr().err
    assert desk.metrics()["num_without_distance"] == 11
    assert {row["clearance_barrier"] for row in desk.rows()} == {""}
    driven = ("--field", str(desk.folder / "field"), "-q", "--max-unknown", "1", "--mode", "closed-loop")
    assert desk.replay(*driven, out="driven") == 5
    assert "the field has no distance there" in capsys.readouterr().err


def test_unknown_space_is_said_after_the_outputs_are_written(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)), is_seen=False)
    assert desk.replay("--scene", str(scene), "-q", is_judged=True) == 5
    assert "100.0 % of the sphere centres lie in space no camera ever saw" in capsys.readouterr().err
    assert desk.metrics()["unknown_share"] == 1.0
    assert desk.replay("--scene", str(scene), "-q", "--max-unknown", "1", out="again") == 0


@pytest.mark.painted
def test_a_closed_loop_reaches_the_logged_end_and_gates_on_it(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    end = START + np.array([0.5, 0.1, 0, 0, 0, 0, 0])
    desk.source.states = logged(end)
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    gates = ["--require", "goal_reached>=1", "--require", "num_hold<=0", "--require", "min_barrier_clearance>=0.019"]
    assert desk.replay("--scene", str(scene), "-q", "--json", "--mode", "closed-loop", *gates) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["goal_reached"] == 1 and printed["position_error"] <= 0.01
    rows = desk.rows()
    assert printed["num_steps"] == len(rows) == printed["num_solved"] + printed["num_relaxed"]
    assert all(float(row["residual"]) <= 1e-5 for row in rows)
    gate = ["--require", "min_clearance>=5"]
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop", *gate, out="gated") == 1
    assert (desk.folder / "gated" / "steps.csv").read_bytes() == (desk.folder / "out" / "steps.csv").read_bytes()


def test_a_posture_can_be_the_goal(desk: Desk) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    goal = "--goal-joints=" + ",".join(str(v) for v in START + 0.1)
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop", goal) == 0
    assert desk.metrics()["goal_reached"] == 1


@pytest.mark.painted
def test_the_truth_is_reported_beside_the_scene(
    desk: Desk, sample_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    tabletop = sample_data / "tabletop"
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    out = desk.folder / "out"
    truth = ["--truth", str(tabletop / "truth.json")]
    log = str(tabletop / "log.mcap")
    assert main(["replay", log, *desk.robot, "--scene", str(scene), "-o", str(out), "-q", *truth]) == 5
    metrics = desk.metrics()
    recorded = json.loads((tabletop / "truth.json").read_text())["clearance"]["min"]
    assert metrics["min_clearance_true"] == pytest.approx(recorded, abs=1e-5)
    assert metrics["truth_num_compared_exact"] > 0
    assert metrics["truth_largest_over_exact"] > 0.05  # the scene of this test lacks the table


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--mode", "closed-loop", "--goal", "9,0,0,0,0,0,1"], 4, "goal: expected within"),
        (["--mode", "closed-loop", "--goal-joints", "0,0"], 4, "--goal-joints: expected 7 joints"),
        (["--mode", "closed-loop", "--start-time", "60"], 4, "give an earlier --start-time"),
        (["--mode", "closed-loop", "--set", "control.period=0"], 2, "control.period"),
        (["--mode", "closed-loop", "--frame", "nose"], 4, "no frame 'nose'"),
        (["--set", "control.perod=1"], 2, "did you mean control.period"),
        (["--lock", "joint7"], 2, "--lock joint7: expected JOINT=VALUE"),
        (["--lock", "nose=0"], 4, "no joint 'nose' to lock"),
        (["--truth", "nowhere.json"], 4, "nowhere.json"),
        (["--require", "clearence>=1"], 2, "unknown metric"),
        (["--start-time", "nan"], 2, "expected 0 to 100000000 s or first-map"),
        (["--start-time", "60"], 4, "give an earlier --start-time"),
        (["--mode", "open-loop", "--re-anchor", "1"], 2, "--re-anchor: expected --mode closed-loop, got open-loop"),
        (["--goal", "0,0,1,0,0,0,1"], 2, "--goal: expected --mode open-loop or closed-loop, got audit"),
        (["--follow"], 2, "--follow: expected --mode open-loop or closed-loop, got audit"),
    ],
)
def test_bad_input_is_one_line_with_its_code(
    desk: Desk, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q", *arguments) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (desk.folder / "out.partial").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "one of the arguments --field --scene --lockstep is required"),
        (["--scene", "x", "--goal", "1,2,3"], "expected 7 numbers"),
        (["--scene", "x", "--goal", "0,0,1,0,0,0,2"], "unit quaternion"),
        (["--scene", "x", "--goal-joints", "a,b"], "expected finite numbers"),
        (["--scene", "x", "--base", "nan,0,0,0,0,0,1"], "finite"),
    ],
)
def test_usage_is_refused_before_anything_is_read(
    desk: Desk, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert desk.replay(*arguments) == 2
    assert words in capsys.readouterr().err


def test_a_start_in_collision_names_the_sphere(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    center = arm.sphere_centers(START)[-1]
    scene = write_scene(desk.folder / "scene", (0, splats_of((tuple(center), 0.01))))
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop") == 5
    assert "got sphere hand[" in capsys.readouterr().err


def test_logs_that_do_not_fit_are_refused(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))
    desk.source = FakeSource(states=[], joint_names=())
    assert desk.replay("--scene", scene) == 4
    assert "expected joint states, got none" in capsys.readouterr().err
    desk.source = FakeSource(states=logged(), joint_names=tuple("abcdefg"))
    assert desk.replay("--scene", scene) == 4
    assert "joints not in the log: joint1" in capsys.readouterr().err
    desk.source = FakeSource(states=logged()[::-1])
    assert desk.replay("--scene", scene) == 4
    assert "expected a stamp not before" in capsys.readouterr().err
    desk.source = FakeSource(states=logged(), loss=LossReport(damaged=2))
    assert desk.replay("--scene", scene, "-q") == 3


def test_an_existing_output_is_kept_without_force(desk: Desk) -> None:
    scene = str(write_scene(desk.folder / "scene", (0, splats_of(BALL))))
    assert desk.replay("--scene", scene, "-q") == 0
    assert desk.replay("--scene", scene, "-q") == 2
    assert desk.replay("--scene", scene, "-q", "--force") == 0

"""Logs whose states are not as they should be: what is said, in one line each, and what goes on."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.bake import bake
from splatctrl_cli.grid_files.grid import write_npz
from splatctrl_cli.records import Box
from tests.cli.replay_desk import BALL, START, Desk, grid_seen, splats_of, write_scene
from tests.logs.make_states import START_NS, STEP_NS, states_of, write_mcap

pytestmark = pytest.mark.usefixtures("without_plots")
JOINTS = tuple(f"joint{i}" for i in range(1, 8))


def replayed(desk: Desk, q: np.ndarray, stamps: list[int], *more: str) -> int:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    log = write_mcap(desk.folder / "x.mcap", states_of(q, JOINTS, stamps=stamps))
    desk.source.name = "none"
    arguments = ["replay", str(log), *desk.robot, "--scene", str(scene), "-o", str(desk.folder / "out"), *more]
    return main([*arguments, "--max-unknown", "1"])


def test_stamps_that_go_back_repeat_and_pause_are_said(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    q = START + 0.01 * np.arange(30)[:, None]
    stamps = [START_NS + i * STEP_NS + (i > 20) * 10**9 for i in range(30)]
    stamps[5], stamps[6], stamps[12] = stamps[6], stamps[5], stamps[11]
    assert replayed(desk, q, stamps) == 5
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("log: /joint_states:")]
    assert any("stamps go back at 1 of 30 states: sorted" in line for line in said)
    assert any(
        "1 states repeat a stamp, 1 of them with other positions: the first of each is kept" in line for line in said
    )
    assert any("1 gaps between states, the longest 1.010 s" in line for line in said)
    found = [int(row["stamp_ns"]) for row in desk.rows()]
    assert found == sorted(set(stamps))


def test_a_posture_outside_the_limits_is_an_event_with_its_joint(desk: Desk) -> None:
    q = np.repeat(START[None], 10, axis=0)
    q[4:7, 3] = 0.5  # its limit is below 0
    assert replayed(desk, q, [START_NS + i * STEP_NS for i in range(10)], "-q") == 1
    events = json.loads((desk.folder / "out" / "events.json").read_text())["events"]
    (outside,) = [event for event in events if event["kind"] == "outside-limits"]
    assert (outside["worst_name"], outside["num_states"]) == ("joint4", 3) and outside["worst"] < -0.5


@pytest.mark.parametrize("mode", ["audit", "closed-loop"])
def test_a_grid_without_the_robot_is_refused_by_where_both_are(
    desk: Desk, capsys: pytest.CaptureFixture[str], tmp_path: Path, mode: str
) -> None:
    box = Box(lower=np.array([3.0, 3.0, 0.0]), upper=np.array([3.4, 3.4, 0.4]))
    (tmp_path / "field").mkdir()
    grid = bake(splats_of(BALL), box, replace(FieldConfig(), voxel=0.1), occupancy=grid_seen(), threads=1)
    write_npz(tmp_path / "field" / "field.npz", grid)
    assert desk.replay("--field", str(tmp_path / "field"), "-q", "--mode", mode, "--max-unknown", "1") == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert "--field: expected the robot in the grid from (3.00, 3.00, 0.00) to (" in line
    assert "moving spheres outside it, the nearest by 2." in line and "check --base" in line


@pytest.mark.parametrize("fault", ["other-clock", "empty"])
def test_a_table_that_no_robot_wrote_is_refused_in_one_line(
    desk: Desk, capsys: pytest.CaptureFixture[str], fault: str
) -> None:
    q, t = np.repeat(START[None], 10, axis=0), 0.001 * np.arange(10)
    t[6:] += 1.7e9
    num = 10 if fault == "other-clock" else 0
    np.savez(desk.folder / "x.npz", t=t[:num], q=q[:num])
    log = desk.folder / "x.toml"
    log.write_text(f'[states]\nfile = "x.npz"\njoints = {list(JOINTS)}\ntime = "t"\nposition = ["q"]\n')
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    assert main(["replay", str(log), *desk.robot, "--scene", str(scene), "-o", str(desk.folder / "out")]) == 4
    *_, line = capsys.readouterr().err.splitlines()
    said = {
        "other-clock": "joint states: mixed clocks: stamps jump by 1700000000 s at state 6 of 10; cut the log there",
        "empty": "x.npz: q: expected rows, got none; record it again",
    }[fault]
    assert said in line


def test_a_goal_outside_the_limits_names_the_joint(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)))
    goal = "--goal-joints=0,0,0,-2,0,2,9"
    assert desk.replay("--scene", str(scene), "-q", "--mode", "closed-loop", goal) == 4
    (line,) = capsys.readouterr().err.splitlines()
    assert "goal: joint joint7: expected within [" in line and "got 9.0000; choose another goal" in line

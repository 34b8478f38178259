"""``control.max_detours``: a closed loop that stalls before a wall goes over it by a planned way."""

import json

import numpy as np
import pytest

from tests.cli.replay_desk import Desk, logged, splats_of, write_scene

pytestmark = pytest.mark.usefixtures("unpainted")

GOAL = np.array([0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 1.6])
WALL = tuple(((x, 0.0, z), 0.04) for x in np.arange(0.3, 0.85, 0.05) for z in np.arange(0.05, 0.5, 0.05))


def test_a_way_is_planned_where_the_controller_stalls(desk: Desk) -> None:
    desk.source.states = logged(GOAL)
    scene = write_scene(desk.folder / "scene", (0, splats_of(*WALL)))
    options = ("--scene", str(scene), "--mode", "closed-loop", "--set", "control.solver=daqp")
    assert desk.replay(*options, out="alone") == 0
    assert desk.metrics("alone")["stalled"] == 1 and desk.metrics("alone")["num_detours"] == 0
    assert desk.replay(*options, "--set", "control.max_detours=2", "--require", "goal_reached>=1") == 0
    metrics = desk.metrics()
    assert metrics["num_detours"] >= 1 and metrics["stalled"] == 0
    assert metrics["min_clearance_barrier"] >= 0.0199
    events = json.loads((desk.folder / "out" / "events.json").read_text())
    assert len(events["detours"]) == metrics["num_detours"]
    assert events["detours"][0] == desk.metrics("alone")["num_steps"] - 1


def test_a_negative_number_of_ways_is_refused(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(*WALL)))
    assert desk.replay("--scene", str(scene), "--set", "control.max_detours=-1") == 2
    assert "control.max_detours: expected 0 to 1000, got -1" in capsys.readouterr().err


def test_a_gate_of_another_mode_is_told_the_mode(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(*WALL)))
    assert desk.replay("--scene", str(scene), "--require", "num_detours<=0") == 2
    assert "--require num_detours<=0: a figure of --mode closed-loop" in capsys.readouterr().err
    assert desk.replay("--scene", str(scene), "--require", "num_detour<=0") == 2
    assert "unknown metric" in capsys.readouterr().err

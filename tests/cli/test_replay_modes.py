"""Open loop, explanations, gates, and what a closed loop may be asked for."""

import json
import re
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.jobs.replay.metrics import metric_scales
from splatctrl_cli.records import Float64, JointState
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, SECOND, START, Desk, clearance, logged, scene_of, splats_of, write_scene

MOVE = np.array([0.5, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])


def log_motion(desk: Desk, move: Float64 = MOVE) -> None:
    """A log of one second from START, with its velocity."""
    desk.source.states = [
        JointState(stamp_ns=s.stamp_ns, position=s.position, velocity=move) for s in logged(START + move)
    ]


@pytest.fixture
def moving(desk: Desk) -> None:
    log_motion(desk)


def ball_ahead(arm: RobotModel, gap: float) -> tuple[tuple[float, float, float], float]:
    """A ball ahead of the hand at the log's end, `gap` from the nearest sphere to the millimetre."""
    end, tip = START + MOVE, arm.sphere_centers(START + MOVE)[-1]
    out = tip - arm.sphere_centers(START)[-1]
    out /= np.linalg.norm(out)
    for way in np.arange(0.4, 0.0, -0.001):
        ball = (tuple(tip + way * out), 0.05)
        if clearance(arm, end, ball) < gap:  # type: ignore[arg-type]
            return ball  # type: ignore[return-value]
    raise AssertionError


def events(desk: Desk) -> Any:
    return desk.json("events.json")["events"]


@pytest.mark.usefixtures("painted", "moving")
def test_open_loop_commands_what_was_logged_where_nothing_is_near(desk: Desk) -> None:
    assert desk.replay(*scene_of(desk, ((-1.0, 0.0, 1.5), 0.05)), "-q", "--mode", "open-loop") == 0
    metrics = desk.metrics()
    assert (metrics["intervention_share"], metrics["first_intervention_s"]) == (0, None)
    assert metrics["max_velocity_difference"] < 1e-5 and metrics["min_barrier_margin_logged"] > 0
    assert [float(row["v_joint1"]) for row in desk.rows()] == pytest.approx([0.5] * 11, abs=1e-5)
    assert (desk.folder / "out" / "open_loop.png").is_file()


@pytest.mark.usefixtures("moving")
def test_open_loop_says_when_and_why_the_logged_velocity_was_changed(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(((-1.0, 0.0, 1.5), 0.05), ball_ahead(arm, 0.01))))
    assert desk.replay("--scene", str(scene), "-q", "--mode", "open-loop") == 0
    metrics, rows = desk.metrics(), desk.rows()
    assert 0 < metrics["intervention_share"] < 1
    broken = [row for row in rows if float(row["barrier_margin_logged"]) < 0]
    assert len(broken) == metrics["num_barrier_broken_logged"] > 0 and all(row["intervening"] for row in broken)
    last = rows[-1]
    difference = [float(last[f"dv_joint{j}"]) for j in range(1, 8)]
    assert float(last["velocity_difference"]) == pytest.approx(np.linalg.norm(difference))
    assert [float(last[f"v_joint{j}"]) for j in range(1, 8)] == pytest.approx(MOVE + difference, abs=1e-7)
    (scene_event,) = [event for event in events(desk) if event["kind"] == "scene"]
    assert (scene_event["obstacle"]["splat"], scene_event["obstacle"]["label"]) == (1, "object")
    assert scene_event["start_s"] == pytest.approx(metrics["first_intervention_s"])
    assert str(scene_event["worst_name"]).startswith("hand[")
    words = f"first intervention: {scene_event['start_s']:.2f} to 1.00 s, scene row hand["
    (first,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(words)]
    assert "near object splat 1 at (" in first
    assert desk.json("summary.json")["when_and_why"][0] == first


@pytest.mark.usefixtures("moving")
def test_open_loop_may_ask_for_a_goal_instead_of_the_log(desk: Desk) -> None:
    goal = "--goal-joints=" + ",".join(str(v) for v in START)
    assert desk.replay(*scene_of(desk, BALL), "-q", "--mode", "open-loop", goal) == 0
    assert float(desk.rows()[-1]["v_joint1"]) < 0
    assert desk.metrics()["max_velocity_difference"] > 0.5


@pytest.mark.usefixtures("moving")
def test_a_clearance_below_the_margin_is_one_interval_with_its_obstacle(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    assert desk.replay(*scene_of(desk, ((-1.0, 0.0, 1.5), 0.05), ball_ahead(arm, -0.01)), "-q") == 0
    found = {(event["kind"], event["source"]): event for event in events(desk)}
    below, hit = found["below-margin", "exact"], found["in-collision", "exact"]
    assert below["end_s"] == hit["end_s"] == 1.0
    assert below["start_s"] < hit["start_s"]
    assert (below["worst"], below["unit"]) == (pytest.approx(desk.metrics()["min_clearance"]), "m")
    assert below["obstacle"]["splat"] == 1  # type: ignore[index]
    words = f"below-margin: {below['start_s']:.2f} to 1.00 s, {below['worst_name']}"
    assert any(line.startswith(words) for line in capsys.readouterr().out.splitlines())


def test_an_old_scene_is_stale(desk: Desk) -> None:
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)), (SECOND // 2, splats_of(BALL)))
    assert desk.replay("--scene", str(scene), "-q", "--max-map-age", "0.25") == 0
    stale = [event for event in events(desk) if event["kind"] == "stale-map"]
    assert [(event["start_s"], event["end_s"]) for event in stale] == [
        (pytest.approx(0.3), pytest.approx(0.4)),
        (pytest.approx(0.8), 1.0),
    ]
    assert desk.metrics()["max_map_age_s"] == pytest.approx(0.5)


def test_the_names_of_gates_are_those_of_the_metrics(desk: Desk) -> None:
    """This is the audit. test_the_recorded_commands_of_ours_make_the_same_steps does the other modes."""
    assert desk.replay(*scene_of(desk, BALL), "-q") == 0
    names = metric_scales("audit", ("exact", "barrier"), has_truth=False)
    assert set(desk.metrics()) == set(names)
    assert len(set(names)) == len(names)


@pytest.mark.usefixtures("moving")
def test_a_gate_that_fails_names_the_first_time_that_breaks_it(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    gates = ("--require", "min_clearance>=0.03", "--require", "num_below_margin<=0", "--require", "unknown_share>=2")
    assert desk.replay(*scene_of(desk, ball_ahead(arm, 0.01)), "-q", *gates) == 1
    message = capsys.readouterr().out
    for least, words in ((0.03, "required >= 0.03"), (0.02, "required <= 0")):
        first = next(row for row in desk.rows() if float(row["clearance_exact"]) < least)
        assert f"{words}, first at {float(first['time_s']):.3f} s" in message
    assert "required >= 2" in message


@pytest.mark.usefixtures("painted", "moving")
def test_a_driven_arm_follows_the_log_and_its_divergence_is_measured(desk: Desk) -> None:
    assert desk.replay(*scene_of(desk, ((-1.0, 0.0, 1.5), 0.05)), "-q", "--mode", "closed-loop", "--follow") == 0
    metrics = desk.metrics()
    assert (metrics["num_steps"], metrics["goal_reached"]) == (101, 1)
    assert metrics["max_divergence_joints"] < 0.01 and metrics["max_divergence_position"] < 0.005
    assert float(desk.rows()[-1]["divergence_joints"]) == pytest.approx(metrics["end_divergence_joints"])
    assert (desk.folder / "out" / "divergence.png").is_file()


@pytest.mark.usefixtures("moving")
def test_a_later_start_says_what_its_times_count_from(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    drive = (*scene_of(desk, ((-1.0, 0.0, 1.5), 0.05)), "-q", "--mode", "closed-loop", "--follow")
    assert desk.replay(*drive, "--start-time", "0.9") == 0
    assert "times count from the start, at 0.90 s of the log" in capsys.readouterr().out.splitlines()
    assert desk.rows()[0]["time_s"] == "0"
    assert desk.replay(*drive, "--force") == 0
    assert "times count from" not in capsys.readouterr().out


@pytest.mark.usefixtures("moving")
def test_an_anchor_puts_the_arm_back_into_the_log(desk: Desk) -> None:
    stay = "--goal-joints=" + ",".join(str(v) for v in START + np.array([0, 0, 0, 0, 0, 0, 0.5]))
    drive = (*scene_of(desk, BALL), "-q", "--mode", "closed-loop", stay)
    assert desk.replay(*drive, "--re-anchor", "0.25", out="anchored") == 0
    assert desk.replay(*drive) == 0
    found = [float(row["divergence_joints"] or "nan") for row in desk.rows("anchored")]
    assert found[25] == found[50] == 0.0 < found[24]
    assert desk.json("events.json", "anchored")["anchored"][:2] == [25, 50]
    assert np.nanmax(found) < desk.metrics()["max_divergence_joints"]


@pytest.mark.usefixtures("moving")
@pytest.mark.parametrize("form", ["toml", "csv"])
def test_waypoints_are_reached_one_after_the_other(desk: Desk, arm: RobotModel, form: str) -> None:
    postures = [START + f * MOVE for f in (0.6, 0.0)]
    file = desk.folder / f"way.{form}"
    if form == "toml":
        file.write_text("\n".join(f"[[waypoint]]\njoints = {q.tolist()}" for q in postures))
    else:
        rows = [",".join(arm.joint_names), *(",".join(str(v) for v in q) for q in postures)]
        file.write_text("\n".join(rows) + "\n")
    assert desk.replay(*scene_of(desk, BALL), "-q", "--mode", "closed-loop", "--waypoints", str(file)) == 0
    assert desk.metrics()["num_goals_reached"] == 2
    frame = arm.frame_names[-1]
    places = [
        arm.frame_pose(np.array([float(row[f"q_joint{j}"]) for j in range(1, 8)]), frame)[:3, 3]
        for row in desk.rows()
    ]
    for posture, rows in zip(postures, (places, places[-1:]), strict=True):
        assert np.linalg.norm(rows - arm.frame_pose(posture, frame)[:3, 3], axis=1).min() <= 0.01


def test_a_closed_loop_that_outlasts_the_log_says_so_and_how_to_end_it_sooner(
    desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    far = ",".join(f"{value:g}" for value in logged()[0].position + 1.4)
    drive = (*scene_of(desk, ((-1.0, 0.0, 1.5), 0.05)), "-q", "--mode", "closed-loop", f"--goal-joints={far}")
    assert desk.replay(*drive, is_judged=True) == 5
    verdict = desk.verdict()
    assert re.search(r"^driven motion from 0\.00 s of the log to \d\.\d\d s past its end, ", verdict["scope"])
    (reason,) = [each for each in verdict["reasons"] if each["criterion"] == "map age"]
    assert re.match(
        r"the motion continues \d\.\d\d s past the end of the log, and the map is up to", reason["sentence"]
    )
    assert reason["remedy"].startswith("end it with the log (--set control.max_time=1), start earlier (--start-time)")
    assert "check the cameras" not in capsys.readouterr().out
    desk.replay(*drive, "--set", "control.max_time=1", out="ended", is_judged=True)
    assert "past the end" not in json.dumps(desk.verdict("ended"))

"""The planner, the log, the standstill and the closed loop side by side."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from experiments.__main__ import main
from experiments.methods import MOTION, PLAN, clearance_picture
from splatctrl_cli.config import Config
from splatctrl_cli.records import Float64, Label
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, SECOND, START, Desk, clearance, scene_of, splats_of, write_field, write_scene
from tests.cli.test_replay_modes import ball_ahead, log_motion
from tests.jobs.stage import FAR, MOVE, Ball, Stage

SHORT = ("--set", "control.max_time=4")
BRIEF = ("--set", "control.max_time=0.2")  # where nothing is asked about the closed loop
STANDSTILL = ("--methods", "standstill", *BRIEF)


def compared(desk: Desk, *words: str, out: str = "out") -> Any:
    """The metrics of a comparison that comes to a verdict, whichever that is."""
    assert asked(desk, *SHORT, *words, out=out) in (0, 1, 5)
    return desk.json("run.json", out)["metrics"]


def asked(desk: Desk, *words: str, out: str = "out") -> int:
    """The exit code."""
    return main(["baselines", str(desk.folder / "fake.mcap"), *desk.robot, "-o", str(desk.folder / out), *words])


@pytest.mark.usefixtures("painted")
def test_every_method_has_every_figure(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    log_motion(desk)
    metrics = compared(desk, *scene_of(desk, BALL))
    methods, planned = ("closed_loop", "log", "birrt", "birrt_ik"), ("birrt", "birrt_ik")
    names = {f"{method}_{name}" for method in methods for name in MOTION}
    assert set(metrics) == names | {f"{method}_{name}" for method in planned for name in PLAN}
    for method in methods:
        assert metrics[f"{method}_success"] == metrics[f"{method}_goal_reached"] == 1
        assert metrics[f"{method}_min_clearance_proved"] < metrics[f"{method}_min_clearance"]
        assert metrics[f"{method}_min_clearance_true"] is None
    straight = float(np.linalg.norm(MOVE))
    assert metrics["log_joint_path_rad"] == pytest.approx(straight)
    assert metrics["birrt_joint_path_rad"] <= straight + 0.01  # nothing is in the way, and another posture is nearer
    assert metrics["birrt_num_edges_proved"] == metrics["birrt_num_edges"] == 1
    assert metrics["birrt_planned_margin"] == Config().control.margin
    assert metrics["log_num_interventions"] is None and metrics["closed_loop_num_interventions"] >= 0
    out = capsys.readouterr().out
    assert "Side by side, from the same state to the same goal:" in out and "min_clearance_true" not in out
    assert (desk.folder / "out" / "methods.png").is_file()
    written = desk.json("methods.json")
    assert tuple(written["methods"]) == methods
    np.testing.assert_allclose(np.array(written["plans"]["birrt"]["waypoints"])[0], START)
    assert written["methods"]["birrt"]["joint_path_rad"] == metrics["birrt_joint_path_rad"]


def in_the_way(arm: RobotModel, q: Float64 = START + MOVE / 2) -> Ball:
    tip = arm.sphere_centers(q)[-1]
    return (float(tip[0]), float(tip[1]), float(tip[2])), 0.03


def test_a_ball_that_comes_later_is_not_planned_for_but_is_measured(desk: Desk, arm: RobotModel) -> None:
    log_motion(desk)
    later = splats_of(BALL, in_the_way(arm, START + MOVE))
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)), (3 * SECOND // 10, later), (SECOND, later))
    metrics = compared(desk, "--scene", str(scene), "--methods", "birrt", *BRIEF)
    assert (metrics["birrt_goal_reached"], metrics["birrt_success"]) == (1, 0)
    assert metrics["birrt_min_clearance"] < 0 < metrics["birrt_planned_margin"]


@pytest.mark.usefixtures("painted")
def test_a_goal_that_is_in_collision_leaves_a_row_without_a_motion(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    log_motion(desk)
    metrics = compared(desk, *scene_of(desk, ball_ahead(arm, -0.02)), "--methods", "birrt", *BRIEF)
    assert metrics["birrt_success"] == 0 and metrics["birrt_min_clearance"] is None
    assert "birrt: no path: goal-in-collision" in capsys.readouterr().out
    assert desk.json("methods.json")["plans"]["birrt"]["waypoints"] == []


@pytest.mark.parametrize("is_grid", [False, True])
def test_a_path_is_clear_of_the_splats_between_its_waypoints(desk: Desk, arm: RobotModel, is_grid: bool) -> None:
    log_motion(desk)
    ball = in_the_way(arm)
    field = ("--field", str(write_field(desk.folder / "field", ball, voxel=0.02))) if is_grid else ()
    metrics = compared(desk, *(field or scene_of(desk, ball)), "--methods", "birrt", *BRIEF)
    assert metrics["log_success"] == 0 and metrics["log_min_clearance"] < 0
    assert metrics["birrt_success"] == 1 and metrics["birrt_joint_path_rad"] > metrics["log_joint_path_rad"]
    assert metrics["birrt_min_clearance"] >= metrics["birrt_planned_margin"] - 1e-4
    figures, waypoints = (desk.json("methods.json")[key]["birrt"] for key in ("methods", "plans"))
    assert figures["num_edges_proved"] == figures["num_edges"] > 1
    assert 0 < figures["planned_margin"] <= Config().control.margin
    for a, b in pairwise(np.array(waypoints["waypoints"])):
        for share in np.linspace(0, 1, 200):
            assert clearance(arm, a + share * (b - a), ball) > figures["planned_margin"]
    assert figures["min_clearance_proved"] < figures["min_clearance"]


def test_the_standstill_waits_where_the_controller_goes_on(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    log_motion(desk)
    scene = write_passing_person(desk, arm)
    metrics = compared(desk, "--scene", str(scene), "--methods", "standstill,birrt", "--zone", "0.9,1.0")
    assert metrics["standstill_completed"] == metrics["closed_loop_completed"] == 1
    assert metrics["standstill_duration_s"] == pytest.approx(1.0 + 1.7, abs=0.02)
    stopped = pytest.approx(1.7 - 0.5 / 7.5, abs=0.02)  # of the visit less the time to brake
    assert metrics["standstill_longest_stop_s"] == metrics["standstill_stopped_s"] == stopped
    assert metrics["closed_loop_num_stops"] == 0 and 0.25 < metrics["closed_loop_min_human_distance"] < 0.9
    assert metrics["standstill_num_interventions"] == metrics["standstill_num_stops"] == 1
    assert metrics["standstill_joint_path_rad"] == pytest.approx(metrics["log_joint_path_rad"])
    assert metrics["standstill_duration_s"] > metrics["log_duration_s"] + 1
    assert "Beside people, from the same moment:" in capsys.readouterr().out
    assert [*desk.json("methods.json")["people"]] == ["closed_loop", "standstill"]
    assert [*desk.json("methods.json")["methods"]] == ["closed_loop", "log", "standstill", "birrt"]


def write_passing_person(desk: Desk, arm: RobotModel) -> Path:
    """A scene of nobody, from 0.3 to 2 s a person 30 cm ahead of the arm at the log's end, and nobody again."""
    alone, beside = splats_of(BALL), splats_of(BALL, ball_ahead(arm, 0.3))
    beside = replace(beside, labels=np.array([0, Label.HUMAN], np.uint8))
    maps = ((0, alone), (3 * SECOND // 10, beside), (2 * SECOND, alone), (3 * SECOND, alone))
    return write_scene(desk.folder / "scene", *maps)


def test_people_of_the_truth_are_preferred_to_those_of_the_scene(stage: Stage) -> None:
    stage.people = [((-1.0, 0.3, 1.3), 0.05)]
    person: Ball = ((1.5, 0.0, 0.5), 0.1)
    truth = stage.truth(FAR, person, name="human")  # all of it are people
    stage.desk.source.states = stage.states
    where = ("--scene", str(stage.scene()), *STANDSTILL)
    by_truth = compared(stage.desk, *where, "--truth", str(truth), "--human", "human1", out="true")
    assert by_truth["standstill_min_human_distance"] == pytest.approx(nearest(stage, person), abs=0.02)
    by_scene = compared(stage.desk, *where)
    assert by_scene["standstill_min_human_distance"] == pytest.approx(nearest(stage, stage.people[0]), abs=0.02)
    assert abs(by_scene["standstill_min_human_distance"] - by_truth["standstill_min_human_distance"]) > 0.2


def nearest(stage: Stage, ball: Ball) -> float:
    """Of the moving arm's surface over the logged motion [m]."""
    return min(clearance(stage.arm, state.position, ball) for state in stage.states)


def test_a_standstill_without_anybody_is_not_evaluable(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    stage.desk.source.states = stage.states
    where = ("--scene", str(stage.scene()), *STANDSTILL)
    assert asked(stage.desk, *where) == 5
    assert "expected splats labelled human, got none at any time" in capsys.readouterr().err
    assert asked(stage.desk, *where, "--truth", str(stage.truth(FAR, name="box"))) == 5
    assert "expected a primitive named human* or person*, got box0" in capsys.readouterr().err
    assert not (stage.desk.folder / "out").exists()


def test_ours_stands_beside_a_controller_of_the_users_own(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    stage.desk.source.states = stage.states
    (stage.desk.folder / "own.py").write_text(STILL)
    monkeypatch.chdir(stage.desk.folder)
    scene = ("--scene", str(stage.scene()), "--methods")
    metrics = compared(stage.desk, *scene, "qp-ik", "--controller", "own:Still")
    assert (metrics["qp_ik_success"], metrics["closed_loop_success"]) == (1, 0)
    ours = compared(stage.desk, *scene, "birrt", out="ours")
    assert metrics["qp_ik_duration_s"] == ours["closed_loop_duration_s"]
    assert metrics["closed_loop_num_interventions"] is None and metrics["qp_ik_num_interventions"] is not None


STILL = """
class Still:
    def __init__(self, start):
        self.num = len(start.joints)

    def step(self, now):
        return [0.0] * self.num
"""


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("--methods", "qp-ik"), 2, "--methods qp-ik: the closed loop is that already"),
        (("--methods", "standstill", "--zone", "1"), 2, "--zone 1: expected STOP,RESUME"),
        (("--methods", "standstill", "--zone", "2,1"), 2, "zone: expected 0 < stop <= resume"),
        (("--methods", "standstill", "--zone", "0.5,inf"), 2, "expected 0 < stop <= resume <= 100, got"),
        (("--methods", "standstill", "--zone-box", "0,0,0,1,1,0"), 2, "expected finite x0,y0,z0,x1,y1,z1"),
        (("--human", "visitor"), 2, "--human: expected --truth"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    desk: Desk, words: tuple[str, ...], code: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert asked(desk, "--scene", "nowhere", *words) == code
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--methods", "prm"), "expected standstill, birrt, birrt-ik, qp-ik, got 'prm'"),
        (("--goal", "1,2"), "expected 7 numbers"),
        (("--goal", "0,0,0,0,0,0,2"), "expected a unit quaternion"),
    ],
)
def test_words_that_do_not_parse_are_named(
    desk: Desk, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        asked(desk, "--scene", str(Path("nowhere")), *words)
    assert told in capsys.readouterr().err


@pytest.mark.usefixtures("painted")
def test_a_picture_of_gaps_and_of_no_value_is_1200_pixels_wide_and_the_same_each_time(tmp_path: Path) -> None:
    gap = np.linspace(0.1, 0.02, 50)
    gap[10:20] = np.nan
    curves = {"one": np.linspace(0.05, 0.08, 80), "two": gap, "three": np.full(30, 0.06), "none": np.full(30, np.nan)}
    for name in ("a.png", "b.png"):
        clearance_picture(tmp_path / name, curves, 0.01, 0.02)
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None and image.shape[1] == 1200 and image.std() > 1.0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()

"""The planner, the log, the standstill and the closed loop side by side."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import Config
from splatctrl_cli.jobs.replays.compare import certified_distance, figure_scales
from splatctrl_cli.jobs.replays.metrics import metric_names
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import BALL, SECOND, START, Desk, clearance, scene_of, splats_of, write_field, write_scene
from tests.cli.test_replay_modes import ball_ahead, moving, write_passing_person
from tests.jobs.stage import MOVE

pytestmark = pytest.mark.usefixtures("unpainted")

CLOSED = ("-q", "--mode", "closed-loop", "--set", "control.max_time=4")


@pytest.mark.painted
def test_every_method_has_every_figure_and_gates_can_name_them(
    desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    moving(desk)
    gates = ("--require", "birrt_min_clearance>=0.02", "--require", "birrt_ik_success>=1")
    assert desk.replay(*scene_of(desk, BALL), *CLOSED, "--baseline", "birrt", "--baseline", "birrt-ik", *gates) == 0
    metrics = desk.metrics()
    assert set(metrics) == set(
        metric_names("closed-loop", ("exact", "barrier"), has_truth=False, baselines=["birrt", "birrt-ik"])
    )
    for method in ("closed_loop", "log", "birrt", "birrt_ik"):
        assert metrics[f"{method}_success"] == metrics[f"{method}_goal_reached"] == 1
        assert metrics[f"{method}_min_clearance_proved"] < metrics[f"{method}_min_clearance"]
    straight = float(np.linalg.norm(MOVE))
    assert metrics["log_joint_path_rad"] == pytest.approx(straight)
    assert metrics["birrt_joint_path_rad"] <= straight + 0.01  # nothing is in the way, and another posture is nearer
    assert metrics["birrt_num_edges_proved"] == metrics["birrt_num_edges"] == 1
    assert metrics["birrt_planned_margin"] == Config().control.margin
    assert metrics["log_num_interventions"] is None and metrics["closed_loop_num_interventions"] >= 0
    out = capsys.readouterr().out
    assert "Side by side, from the same state to the same goal:" in out
    assert (desk.folder / "out" / "methods.png").is_file()
    document = json.loads((desk.folder / "out" / "methods.json").read_text())
    assert list(document["methods"]) == ["closed_loop", "log", "birrt", "birrt_ik"]
    waypoints = np.array(document["plans"]["birrt"]["waypoints"])
    np.testing.assert_allclose(waypoints[0], START)
    assert document["methods"]["birrt"]["joint_path_rad"] == metrics["birrt_joint_path_rad"]


def test_a_ball_in_the_way_of_the_log_is_planned_around(desk: Desk, arm: RobotModel) -> None:
    moving(desk)
    tip = arm.sphere_centers(START + MOVE / 2)[-1]
    ball = ((float(tip[0]), float(tip[1]), float(tip[2])), 0.03)
    assert desk.replay(*scene_of(desk, ball), *CLOSED, "--baseline", "birrt") == 0
    metrics = desk.metrics()
    assert metrics["log_success"] == 0 and metrics["log_min_clearance"] < 0
    assert metrics["birrt_success"] == 1
    assert metrics["birrt_min_clearance"] >= metrics["birrt_planned_margin"] - 1e-4
    assert metrics["birrt_joint_path_rad"] > metrics["log_joint_path_rad"]
    assert metrics["birrt_num_edges_proved"] == metrics["birrt_num_edges"] > 1


def test_a_ball_that_comes_later_is_not_planned_for_but_is_measured(desk: Desk, arm: RobotModel) -> None:
    moving(desk)
    tip = arm.sphere_centers(START + MOVE)[-1]
    late = ((float(tip[0]), float(tip[1]), float(tip[2])), 0.03)
    later = splats_of(BALL, late)
    scene = write_scene(desk.folder / "scene", (0, splats_of(BALL)), (3 * SECOND // 10, later), (SECOND, later))
    assert desk.replay("--scene", str(scene), *CLOSED, "--baseline", "birrt") == 0
    metrics = desk.metrics()
    assert metrics["birrt_goal_reached"] == 1 and metrics["birrt_success"] == 0
    assert metrics["birrt_min_clearance"] < 0 < metrics["birrt_planned_margin"]


@pytest.mark.painted
def test_a_goal_that_is_in_collision_leaves_a_row_without_a_motion(
    desk: Desk, arm: RobotModel, capsys: pytest.CaptureFixture[str]
) -> None:
    moving(desk)
    assert desk.replay(*scene_of(desk, ball_ahead(arm, -0.02)), *CLOSED, "--baseline", "birrt", out="a") == 0
    metrics = desk.metrics("a")
    assert metrics["birrt_success"] == 0 and metrics["birrt_min_clearance"] is None
    assert "birrt: no path: goal-in-collision" in capsys.readouterr().out
    gate = ("--require", "birrt_success>=1")
    assert desk.replay("--scene", str(desk.folder / "scene"), *CLOSED, "--baseline", "birrt", *gate, out="b") == 1


def test_all_baselines_stand_in_one_table(desk: Desk, arm: RobotModel) -> None:
    moving(desk)
    scene = str(write_passing_person(desk, arm))
    assert desk.replay("--scene", scene, *CLOSED, "--baseline", "standstill,birrt", "--zone", "0.9,1.0") == 0
    metrics = desk.metrics()
    assert set(figure_scales(["standstill", "birrt"], has_truth=False)) <= set(metrics)
    assert metrics["standstill_num_interventions"] == metrics["standstill_num_stops"] == 1
    assert metrics["standstill_joint_path_rad"] == pytest.approx(metrics["log_joint_path_rad"])
    assert metrics["standstill_duration_s"] > metrics["log_duration_s"] + 1


def test_what_is_planned_in_never_exceeds_the_exact_distance_and_the_kernel_field_is_no_proof(tmp_path: Path) -> None:
    """Beside and between splats of many sizes: certified <= the exact distance in float64 everywhere, which is
    1-Lipschitz; the controller's own field is steeper than that somewhere, so nothing follows from its samples.
    """
    from splatctrl_cli.jobs.replays.known_scene import splat_fields

    steepest = 0.0
    for seed in range(12):
        random = np.random.default_rng(seed)
        centers = random.uniform(-1.5, 1.5, (200, 3)).astype(np.float32)
        centers[100:] = centers[0] + random.normal(size=(100, 3)) * 0.03
        radii = random.uniform(0.002, 0.02, 200).astype(np.float32)
        fields = splat_fields(splats_of(*zip(map(tuple, centers), map(float, radii), strict=True)), Config(), 1)  # type: ignore[arg-type]
        points = np.concatenate(
            [
                random.uniform(-3, 3, (500, 3)),
                centers[100:] + random.normal(size=(100, 3)) * 0.02,
                centers.astype(float),
            ]
        )
        gap = np.linalg.norm(points[:, None] - centers.astype(np.float64), axis=2) - radii.astype(np.float64)
        certified = certified_distance(fields)(points)
        assert np.all(certified < gap.min(axis=1))
        assert np.all(certified > gap.min(axis=1) - 3e-5)
        near = points + random.normal(size=points.shape) * 2e-3
        change = np.abs(fields.barrier.query(near)[0] - fields.barrier.query(points)[0])
        steepest = max(steepest, float(np.max(change / np.linalg.norm(near - points, axis=1))))
    assert steepest > 1.2


@pytest.mark.parametrize("is_grid", [False, True])
def test_a_path_is_clear_of_the_splats_between_its_waypoints(desk: Desk, arm: RobotModel, is_grid: bool) -> None:
    moving(desk)
    tip = arm.sphere_centers(START + MOVE / 2)[-1]
    ball = ((float(tip[0]), float(tip[1]), float(tip[2])), 0.03)
    if is_grid:
        where = ("--field", str(write_field(desk.folder / "field", ball, voxel=0.02)))
    else:
        where = scene_of(desk, ball)
    assert desk.replay(*where, *CLOSED, "--baseline", "birrt", "--max-unknown", "1") == 0
    document = json.loads((desk.folder / "out" / "methods.json").read_text())
    figures, waypoints = document["methods"]["birrt"], np.array(document["plans"]["birrt"]["waypoints"])
    assert figures["num_edges_proved"] == figures["num_edges"] > 1
    assert 0 < figures["planned_margin"] <= Config().control.margin
    for a, b in pairwise(waypoints):
        for share in np.linspace(0, 1, 200):
            assert clearance(arm, a + share * (b - a), ball) > figures["planned_margin"]
    assert figures["min_clearance_proved"] < figures["min_clearance"]

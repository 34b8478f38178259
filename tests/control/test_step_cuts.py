"""Rows against what a step would meet beside its own rows: corners and shells, where the nearest surface changes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.fallbacks import Rung, descend
from splatctrl_cli.control.qp_rows import RowBuilder
from splatctrl_cli.control.replay import Outcome, ReplayTask, closed_loop
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.terms import State, stray_cost
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.robot.model import RobotModel
from tests.control.fakes import Balls, PlanarArm, far_away

ARM = PlanarArm()
CONFIG = ControlConfig(solver="daqp")
BOX = (-ARM.velocity_limit, ARM.velocity_limit)
TIP = 4  # the last sphere
BEAM = Balls([[r * np.cos(1.15), r * np.sin(1.15), 0.0] for r in (0.64, 0.72, 0.8, 0.88, 0.96)], [0.04] * 5)
TASK = ReplayTask(
    start=np.array([0.2, 0.3]),
    T_world_goal=ARM.frame_pose(np.array([1.6, 0.3]), "tip"),
    frame="tip",
    home=np.array([1.6, 0.3]),
)


def seven_joints(plain_arm: Path) -> RobotModel:
    folder = plain_arm / "tabletop"
    return RobotModel.from_urdf(folder / "robot.urdf", folder / "robot_spheres.yaml")


def state_at(q: np.ndarray, rate: float | np.ndarray = 0.0) -> State:
    return State(model=ARM, frame="tip", q=q, box=BOX, distance_rate=rate)


def test_an_arm_pressed_against_a_row_of_balls_keeps_its_margin() -> None:
    trace = closed_loop(ARM, CONFIG, TASK, lambda _: BEAM)
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - CONFIG.promise_tolerance
    assert all(step.scale == 1.0 and step.rung is Rung.SOLVED for step in trace.steps)


def test_without_cuts_the_same_steps_have_to_be_scaled_back() -> None:
    trace = closed_loop(ARM, replace(CONFIG, max_cuts=0), TASK, lambda _: BEAM)
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - CONFIG.promise_tolerance
    assert any(step.scale < 1.0 for step in trace.steps)


def test_a_cut_is_the_row_of_what_is_met_after_a_period() -> None:
    q, velocity = np.array([0.7, 0.5]), np.array([0.9, -0.4])
    state, later = state_at(q), q + CONFIG.period * velocity
    builder = RowBuilder(ARM, CONFIG, BEAM)
    rows = builder.cut(builder.at(state), state, velocity, np.array([3]))
    assert rows.cuts is not None and list(rows.cuts.index) == [3]

    def clearance(posture: np.ndarray) -> float:
        return float(BEAM.query(ARM.sphere_centers(posture)[[TIP]])[0][0] - ARM.sphere_set.radii[TIP])

    step = 1e-6 * np.eye(2)
    slope = [(clearance(later + d) - clearance(later - d)) / 2e-6 for d in step]
    np.testing.assert_allclose(rows.cuts.G[0], -np.array(slope), rtol=1e-6)
    linear = clearance(later) - CONFIG.period * np.dot(slope, velocity)
    now = max(linear, rows.external.distance[3])
    np.testing.assert_allclose(rows.cuts.distance[0], now, rtol=1e-9)
    np.testing.assert_allclose(rows.cuts.h[0], CONFIG.barrier_gain * (now - CONFIG.margin), rtol=1e-9)


def test_a_cut_counts_the_rate_of_its_own_sphere() -> None:
    builder, q, velocity = RowBuilder(ARM, CONFIG, BEAM), np.array([0.7, 0.5]), np.array([0.9, -0.4])
    rate = np.array([0.0, -0.1, -0.2, -0.3])
    still, moving = (
        builder.cut(builder.at(state), state, velocity, np.array([1, 3])).cuts
        for state in (state_at(q), state_at(q, rate))
    )
    assert still is not None and moving is not None
    np.testing.assert_allclose(moving.h - still.h, rate[[1, 3]])


def test_cuts_add_up_and_give_their_slack_to_the_row_they_belong_to() -> None:
    builder, q, velocity = RowBuilder(ARM, CONFIG, BEAM), np.array([0.7, 0.5]), np.array([0.9, -0.4])
    state = state_at(q)
    rows = builder.at(state)
    num_rows = int(rows.in_qp.sum())
    rows = builder.cut(builder.cut(rows, state, velocity, np.array([3])), state, velocity, np.array([2, 3]))
    assert rows.cuts is not None and list(rows.cuts.index) == [3, 2, 3]
    spread = rows.spread(np.concatenate([np.zeros(num_rows), [0.1, 0.2, 0.3]]))
    assert spread[2] == 0.2 and spread[3] == 0.3 and np.count_nonzero(spread) == 2


def test_far_from_everything_a_step_asks_the_field_twice() -> None:
    field = far_away()
    QpIkController(ARM, CONFIG, field, frame="tip").step(TASK.start, TASK.T_world_goal)
    assert field.num_queries == 2


@pytest.mark.parametrize("max_cuts", [1, 3])
def test_a_corner_stops_an_arm_at_both_of_its_sides(max_cuts: int) -> None:
    """The tip is driven into the gap between two balls, too narrow for it."""
    q = np.array([0.6, 0.0])
    tip = ARM.frame_pose(q, "tip")[:3, 3]
    along, across = np.array([np.cos(0.6), np.sin(0.6), 0.0]), np.array([-np.sin(0.6), np.cos(0.6), 0.0])
    gap = Balls([tip + 0.19 * across + 0.012 * s * along for s in (-6, 6)], [0.08, 0.08])
    goal = ARM.frame_pose(np.array([1.2, 0.0]), "tip")
    config = replace(CONFIG, max_cuts=max_cuts)
    task = ReplayTask(start=q, T_world_goal=goal, frame="tip", home=np.array([1.2, 0.0]))
    trace = closed_loop(ARM, config, task, lambda _: gap)
    assert min(step.clearance for step in trace.steps) >= CONFIG.margin - CONFIG.promise_tolerance


def test_an_arm_inside_a_shell_of_balls_gets_out(plain_arm: Path) -> None:
    """A cylinder of splats appears around the hand: every motion brings some sphere of it nearer to one of them."""
    arm, q = seven_joints(plain_arm), np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 0.0])
    T_world_goal = arm.frame_pose(np.array([0.8, 0.3, 0.0, -2.0, 0.0, 2.3, 1.6]), "hand")
    turn, height = np.meshgrid(np.arange(0.0, 2 * np.pi, 0.5), np.arange(-0.12, 0.12, 0.03), indexing="ij")
    shell = np.stack([0.06 * np.cos(turn), 0.06 * np.sin(turn), height], axis=-1).reshape(-1, 3)
    around_hand = arm.frame_pose(q, "hand")[:3, 3] + np.array([0.05, 0.03, 0.0])
    cylinder = SphereField((shell + around_hand).astype(np.float32), np.full(len(shell), 0.02, np.float32))
    nothing = SphereField(np.full((1, 3), 50.0, np.float32), np.full(1, 0.01, np.float32))
    task = ReplayTask(start=q, T_world_goal=T_world_goal, frame="hand")
    trace = closed_loop(arm, CONFIG, task, lambda t: cylinder if t >= 50_000_000 else nothing)
    clearance = np.array([step.clearance for step in trace.steps])
    assert clearance[5] < -0.05 and trace.outcome is Outcome.GOAL_REACHED
    assert np.all(clearance[60:] >= CONFIG.margin - CONFIG.promise_tolerance)


def distances(q: np.ndarray, field: Balls) -> np.ndarray:
    return field.query(ARM.sphere_centers(q)[1:])[0] - ARM.sphere_set.radii[1:]


@pytest.mark.parametrize(("outside_later", "is_broken"), [(0.0475, False), (0.0195, True)])
def test_a_sphere_outside_its_margin_does_not_give_way_to_those_within(outside_later: float, is_broken: bool) -> None:
    """One sphere, 1 cm within its margin, gains 9 mm: all lack less even where another breaks its row."""
    controller = QpIkController(ARM, CONFIG, BEAM, frame="tip")
    rows = controller._builder.at(state_at(TASK.start))
    distance = np.full(len(rows.external), 0.5)
    distance[:2] = [0.01, 0.05]
    external = replace(rows.external, distance=distance, h=CONFIG.barrier_gain * (distance - CONFIG.margin))
    rows = replace(rows, barriers=(external, rows.own))
    choice = descend(controller._solver, [stray_cost(np.zeros(2), 1.0)], BOX, rows.for_qp, CONFIG)
    choice = replace(choice, slack=np.zeros(int(rows.in_qp.sum())))
    later = rows.distance.copy()
    later[:2] = [0.019, outside_later]
    assert bool(np.any(controller._broken(choice, rows, later))) is is_broken

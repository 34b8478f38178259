"""Tasks, limits and barrier rows against known answers."""

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.barriers import (
    can_bind,
    fastest_approach,
)
from splatctrl_cli.control.goals import pose_error, reference_velocity, rotation_vector
from splatctrl_cli.control.limits import velocity_box
from splatctrl_cli.control.step import ControlStep, QpIkController
from splatctrl_cli.control.terms import Barrier, BarrierTerm, Cost, CostTerm, State, reach_cost, stray_cost
from splatctrl_cli.geometry import rotation_from_quat, transform_from
from tests.control.fakes import PlanarArm, far_away

STEP = 1e-6


def test_a_row_that_no_velocity_of_the_box_violates_cannot_bind() -> None:
    G, lowest, highest = np.array([[1.0, -2.0]]), np.array([-1.0, -0.5]), np.array([0.5, 1.0])
    assert fastest_approach(G, lowest, highest)[0] == pytest.approx(1.5)
    assert can_bind(G, np.array([1.49]), lowest, highest)[0]
    assert not can_bind(G, np.array([1.5]), lowest, highest)[0]


@pytest.mark.parametrize("outside", [-5.0, -0.05, 0.0, 0.05, 5.0])
def test_the_velocity_box_is_never_empty_and_points_back_inside(outside: float) -> None:
    lower, upper, limit = np.array([-1.0]), np.array([1.0]), np.array([2.0])
    q = np.array([1.0 + outside if outside > 0 else -1.0 + outside])
    lowest, highest = velocity_box(q, lower, upper, limit, 10.0)
    assert lowest[0] <= highest[0]
    assert lowest[0] >= -2.0 and highest[0] <= 2.0
    if outside > 0:
        assert highest[0] == pytest.approx(-min(10 * outside, 2.0))
    if outside < 0:
        assert lowest[0] == pytest.approx(min(-10 * outside, 2.0))


def test_an_unlimited_joint_keeps_its_velocity_limit() -> None:
    lowest, highest = velocity_box(np.zeros(1), np.array([-np.inf]), np.array([np.inf]), np.array([2.0]), 10.0)
    assert (lowest[0], highest[0]) == (-2.0, 2.0)


def test_task_costs_are_the_printed_squares_up_to_a_constant() -> None:
    rng = np.random.default_rng(0)
    J, u, w, v = rng.normal(size=(6, 7)), rng.normal(size=6), rng.uniform(0.5, 2, 6), rng.normal(size=7)
    H, c = reach_cost(J, u, w)
    assert 0.5 * v @ H @ v + c @ v + u @ (w * u) == pytest.approx((u - J @ v) @ (w * (u - J @ v)))
    H, c = stray_cost(u, 0.3)
    assert 0.5 * u @ H @ u + c @ u + 0.3 * u @ u == pytest.approx(0.0)


def test_the_rotation_vector_is_the_axis_times_the_angle() -> None:
    axis = np.array([1.0, -2.0, 2.0]) / 3
    for angle in (0.0, 1e-9, 1e-4, 0.5, 2.0, np.pi - 1e-4, np.pi - 1e-9):
        quat = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
        np.testing.assert_allclose(rotation_vector(rotation_from_quat(quat)), angle * axis, atol=2e-8)


def test_the_rotation_vector_of_a_half_turn_has_length_pi() -> None:
    vector = rotation_vector(np.diag([-1.0, 1.0, -1.0]))
    np.testing.assert_allclose(np.abs(vector), [0, np.pi, 0], atol=1e-12)


def test_the_pose_error_carries_the_frame_to_the_goal() -> None:
    start = transform_from([1.0, 2, 3], [0.1, 0.2, -0.3, 0.9])
    goal = transform_from([1.5, 2, 2], [0.3, 0.0, 0.1, 1.0])  # in the world's axes: not turned about the start's
    error = pose_error(start, goal)
    angle = np.linalg.norm(error[3:])
    turn = np.append(np.sin(angle / 2) * error[3:] / angle, np.cos(angle / 2))
    np.testing.assert_allclose(rotation_from_quat(turn) @ start[:3, :3], goal[:3, :3], atol=1e-12)
    np.testing.assert_allclose(error[:3], [0.5, 0, -1])


def test_the_reference_is_capped_in_norm_and_keeps_its_direction() -> None:
    error = np.array([3.0, 4, 0, 0.01, 0, 0])
    velocity = reference_velocity(error, gain=2.0, max_linear=0.25, max_angular=1.0)
    np.testing.assert_allclose(velocity, [0.15, 0.2, 0, 0.02, 0, 0])


class HoldElbow:
    """A cost of one's own: the elbow stays still."""

    def rows(self, state: State) -> Cost:
        return np.diag([0.0, 1e4]), np.zeros(2)


class SlowShoulder(BarrierTerm):
    """Rows of one's own: the shoulder turns at most 0.05 rad/s either way."""

    names = ("shoulder forwards", "shoulder backwards")

    def rows(self, state: State) -> Barrier:
        G, h = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.full(2, 0.05)
        far = np.full(2, np.inf)
        return Barrier(index=np.arange(2), G=G, h=h, distance=far, slack_cost=1e6, slack_weight=1.0)


@pytest.mark.parametrize("program", ["reduced", "printed"])
def test_terms_of_ones_own_add_up_with_those_of_the_paper(program: str) -> None:
    arm, q = PlanarArm(), np.array([0.3, 0.9])
    config, goal = ControlConfig(program=program), arm.frame_pose(np.array([0.9, 1.4]), "tip")

    def stepped(*terms: CostTerm | BarrierTerm) -> ControlStep:
        return QpIkController(arm, config, far_away(), frame="tip", terms=terms).step(q, goal)

    plain, held, slow = stepped(), stepped(HoldElbow()), stepped(SlowShoulder())
    assert np.all(np.abs(plain.velocity) > 0.1) and not plain.interventions
    assert abs(held.velocity[1]) < 0.01 and abs(held.velocity[0]) > 0.1
    assert slow.velocity[0] == pytest.approx(-0.05, abs=1e-6) and slow.scale == 1.0
    assert [row.name for row in slow.interventions] == ["shoulder backwards"]
    both = stepped(HoldElbow(), SlowShoulder())
    assert abs(both.velocity[0]) <= 0.05 + 1e-6 and abs(both.velocity[1]) < 0.01

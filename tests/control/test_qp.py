"""Tasks, limits and barrier rows against known answers; the program, its elimination and its solver."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.barriers import can_bind
from splatctrl_cli.control.goals import pose_error, reference_velocity, rotation_vector
from splatctrl_cli.control.qp import (
    SOLVERS,
    QuadraticProgram,
    Rung,
    assemble,
    assemble_hard,
    descend,
    residuals,
    solve_clarabel,
    solve_daqp,
)
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.terms import (
    Barrier,
    BarrierTerm,
    Cost,
    State,
    eliminated_weight,
    reach_cost,
    stray_cost,
    velocity_box,
)
from splatctrl_cli.geometry import rotation_from_quat, transform_from
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm, far_away
from tests.reference.control import literal_program


def barrier(G: Float64, h: Float64) -> Barrier:
    return Barrier(index=np.arange(len(h)), G=G, h=h, distance=h, slack_cost=1e3, slack_weight=100.0)


def seven_joint_costs(rng: np.random.Generator) -> tuple[Float64, Float64, Float64, Float64, list[Cost]]:
    J, u, Q, R = rng.normal(size=(6, 7)), 0.3 * rng.normal(size=6), rng.uniform(1, 9, 6), rng.uniform(1, 9, 6)
    return J, u, Q, R, [reach_cost(J, u, eliminated_weight(Q, R)), stray_cost(0.1 * np.ones(7), 1e-3)]


def random_rows(rng: np.random.Generator, fewer_than: int) -> Barrier:
    num = int(rng.integers(0, fewer_than))
    return barrier(0.4 * rng.normal(size=(num, 7)), rng.uniform(-0.2, 0.6, num))


def solved(costs: list[Cost], limit: ArrayLike, rows: list[Barrier], lowest: ArrayLike | None = None) -> Float64:
    """The solution within velocities up to a limit either way."""
    highest = np.asarray(limit, np.float64)
    low = -highest if lowest is None else np.asarray(lowest, np.float64)
    solution = solve_clarabel(assemble(costs, low, highest, rows))
    assert solution.is_solved
    return solution.z


@pytest.mark.parametrize("seed", range(5))
def test_eliminating_the_end_effector_velocity_leaves_the_literal_solution(seed: int) -> None:
    rng = np.random.default_rng(seed)
    J, u, Q, R, costs = seven_joint_costs(rng)
    G, h = rng.normal(size=(9, 7)), rng.uniform(-0.3, 0.3, 9)
    literal = solve_clarabel(literal_program(J, u, Q, R, (0.1 * np.ones(7), 1e-3), (G, h), (1e3, 100.0)))
    assert literal.is_solved
    np.testing.assert_allclose(solved(costs, np.full(7, 2.0), [barrier(G, h)])[:7], literal.z[:7], atol=2e-5)


def test_slack_costs_what_its_barrier_says() -> None:
    slack = np.array([0.3, 0.0, 2.0])
    rows = [barrier(np.ones((3, 2)), np.ones(3))]
    program = assemble([stray_cost(np.zeros(2), 1.0)], -np.ones(2), np.ones(2), rows)
    z = np.concatenate([np.zeros(2), slack])
    assert 0.5 * z @ program.H @ z + program.c @ z == pytest.approx(np.sum(1e3 * slack + 100.0 * slack**2))


@pytest.mark.parametrize("seed", range(5))
def test_culled_rows_leave_the_solution_as_it_was(seed: int) -> None:
    rng = np.random.default_rng(seed)
    *_, costs = seven_joint_costs(rng)
    G, h, limit = 0.3 * rng.normal(size=(60, 7)), rng.uniform(-0.1, 2.0, 60), np.full(7, 0.5)
    keep = can_bind(G, h, -limit, limit)
    assert 5 < keep.sum() < 55
    whole = solved(costs, limit, [barrier(G, h)])
    np.testing.assert_allclose(whole[:7], solved(costs, limit, [barrier(G[keep], h[keep])])[:7], atol=2e-6)
    np.testing.assert_allclose(whole[7:][~keep], 0.0, atol=1e-6)


def test_the_slack_is_exact_where_the_rows_can_hold() -> None:
    rng = np.random.default_rng(3)
    *_, costs = seven_joint_costs(rng)
    G = rng.normal(size=(4, 7))
    z = solved(costs, np.full(7, 2.0), [barrier(G, np.full(4, -0.05))])
    assert np.max(z[7:]) < 1e-7 and np.all(G @ z[:7] <= -0.05 + 1e-6)


def test_rows_that_contradict_each_other_give_way_by_what_is_missing() -> None:
    rows = barrier(np.array([[1.0], [-1.0]]), np.array([-0.1, -0.3]))
    z = solved([stray_cost(np.zeros(1), 1e-3)], [1.0], [rows])
    assert z[1] + z[2] == pytest.approx(0.4, abs=1e-6)
    degenerate = solved([stray_cost(np.zeros(2), 1.0)], [-1.5, 1.0], [], lowest=[-1.5, -1.0])
    np.testing.assert_allclose(degenerate, [-1.5, 0.0], atol=1e-6)


def test_one_row_dearer_than_its_slack_gives_way_whatever_the_others_cost() -> None:
    rows = replace(barrier(np.ones((2, 1)), np.array([0.0, 5.0])), slack_cost=0.1)
    box = np.array([-1.0]), np.array([1.0])
    choice = descend(solve_daqp, [stray_cost(np.ones(1), 1e3)], box, [rows], ControlConfig())
    assert choice.rung is Rung.RELAXED and choice.velocity[0] > 0.5


@pytest.mark.parametrize(
    ("v", "multiplier", "kind", "least", "most"),
    [
        (1.0, 2.0, "worst", 0.0, 1e-15),
        (1.5, 1.0, "primal", 0.5 - 1e-9, 0.5 + 1e-9),
        (1.0, 1.0, "dual", 0.1, 9.0),
        (0.0, 4.0, "gap", 0.1, 9.0),
        (0.0, 4.0, "worst", 0.1, 9.0),
        (2.0, -1.0, "dual", 0.1, 9.0),
        (np.nan, 2.0, "worst", np.inf, np.inf),
    ],
)
def test_residuals_vanish_at_the_optimum_and_nowhere_else(
    v: float, multiplier: float, kind: str, least: float, most: float
) -> None:
    """The program min v^2 - 4 v with v <= 1 has its optimum at v = 1, with multiplier 2."""
    program = QuadraticProgram(H=np.array([[2.0]]), c=np.array([-4.0]), G=np.array([[1.0]]), h=np.array([1.0]))
    assert least <= getattr(residuals(program, np.array([v]), np.array([multiplier])), kind) <= most


def test_two_solvers_agree_on_random_steps() -> None:
    rng = np.random.default_rng(0)
    num_active = 0
    for _ in range(300):
        *_, costs = seven_joint_costs(rng)
        program = assemble(costs, np.full(7, -1.0), np.full(7, 1.0), [random_rows(rng, 40)])
        ours, theirs = solve_daqp(program), solve_clarabel(program, tolerance=1e-14)
        assert ours.is_solved and theirs.is_solved and ours.residuals.worst < 1e-12
        num_active += int(np.count_nonzero(ours.multipliers > 1e-6))
        mine, other = (0.5 * z @ program.H @ z + program.c @ z for z in (ours.z, theirs.z))
        assert abs(mine - other) < 1e-8 * (1 + abs(other))
        np.testing.assert_allclose(ours.z[:7], theirs.z[:7], atol=1e-5)
    assert num_active > 1000


@pytest.mark.parametrize(
    ("name", "h", "words"),
    [("clarabel", -1.0, "nfeasible"), ("daqp", -1.0, "nfeasible"), ("clarabel", np.nan, "")],
)
def test_a_program_without_a_point_is_not_solved(name: str, h: float, words: str) -> None:
    nowhere = QuadraticProgram(H=np.eye(2), c=np.zeros(2), G=np.array([[1.0, 0], [-1, 0]]), h=np.array([h, -1.0]))
    solution = SOLVERS[name](nowhere)
    assert not solution.is_solved and solution.status and words in solution.status


def test_the_program_without_slacks_gives_the_same_step_where_it_is_used() -> None:
    rng, box = np.random.default_rng(5), (np.full(7, -1.0), np.full(7, 1.0))
    num_firm, num_priced = 0, 0
    for k in range(200):
        *_, costs = seven_joint_costs(rng)
        cheap = 1.0 if k % 4 == 0 else 1e3  # with cheap slacks rows give way although they could hold
        rows = replace(random_rows(rng, 25), slack_cost=cheap)
        whole, firm = solve_daqp(assemble(costs, *box, [rows])), solve_daqp(assemble_hard(costs, *box, [rows]))
        choice = descend(solve_daqp, costs, box, [rows], ControlConfig())
        np.testing.assert_allclose(choice.velocity, whole.z[:7], atol=1e-8)
        np.testing.assert_allclose(choice.slack, np.maximum(whole.z[7:], 0), atol=1e-8)
        np.testing.assert_allclose(choice.row_multipliers, whole.multipliers[14 : 14 + len(rows)], atol=1e-5)
        num_firm += firm.is_solved and choice.solution.z.shape == (7,)
        num_priced += firm.is_solved and choice.solution.z.shape != (7,)
    assert num_firm > 60 and num_priced > 3


def test_a_row_that_no_velocity_of_the_box_violates_cannot_bind() -> None:
    G, lowest, highest = np.array([[1.0, -2.0]]), np.array([-1.0, -0.5]), np.array([0.5, 1.0])
    assert can_bind(G, np.array([1.49]), lowest, highest)[0]
    assert not can_bind(G, np.array([1.5]), lowest, highest)[0]


@pytest.mark.parametrize("outside", [-5.0, -0.05, 0.0, 0.05, 5.0])
def test_the_velocity_box_is_never_empty_and_points_back_inside(outside: float) -> None:
    """A joint without limits keeps that of its velocity."""
    q, lower, upper = np.array([outside + np.sign(outside), 0.0]), np.array([-1.0, -np.inf]), np.array([1.0, np.inf])
    lowest, highest = velocity_box(q, lower, upper, np.array([2.0, 2.0]), 10.0)
    back = -np.sign(outside) * min(10 * abs(outside), 2.0)
    assert lowest[0] == pytest.approx(back if outside < 0 else -2.0)
    assert highest[0] == pytest.approx(back if outside > 0 else 2.0)
    assert (lowest[1], highest[1]) == (-2.0, 2.0)


def test_task_costs_are_the_printed_squares_up_to_a_constant() -> None:
    rng = np.random.default_rng(0)
    J, u, w, v = rng.normal(size=(6, 7)), rng.normal(size=6), rng.uniform(0.5, 2, 6), rng.normal(size=7)
    reach, stray = reach_cost(J, u, w), stray_cost(v, 0.3)
    for (H, c), constant, printed in (
        (reach, u @ (w * u), (u - J @ v) @ (w * (u - J @ v))),
        (stray, 0.3 * v @ v, 0.0),
    ):
        assert 0.5 * v @ H @ v + c @ v + constant == pytest.approx(printed)


def test_the_rotation_vector_is_the_axis_times_the_angle() -> None:
    axis = np.array([1.0, -2.0, 2.0]) / 3
    for angle in (0.0, 1e-9, 1e-4, 0.5, 2.0, np.pi - 1e-4, np.pi - 1e-9):
        quat = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
        np.testing.assert_allclose(rotation_vector(rotation_from_quat(quat)), angle * axis, atol=2e-8)
    np.testing.assert_allclose(np.abs(rotation_vector(np.diag([-1.0, 1.0, -1.0]))), [0, np.pi, 0], atol=1e-12)


def test_the_pose_error_carries_the_frame_to_the_goal() -> None:
    """The error is in world axes, not in those of the start."""
    start, goal = (
        transform_from([1.0, 2, 3], [0.1, 0.2, -0.3, 0.9]),
        transform_from([1.5, 2, 2], [0.3, 0.0, 0.1, 1.0]),
    )
    error = pose_error(start, goal)
    np.testing.assert_allclose(error[:3], [0.5, 0, -1])
    turn = Rotation.from_rotvec(error[3:]).as_matrix()
    np.testing.assert_allclose(turn @ start[:3, :3], goal[:3, :3], atol=1e-12)


def test_the_reference_is_capped_in_norm_and_keeps_its_direction() -> None:
    velocity = reference_velocity(np.array([3.0, 4, 0, 0.01, 0, 0]), gain=2.0, max_linear=0.25, max_angular=1.0)
    np.testing.assert_allclose(velocity, [0.15, 0.2, 0, 0.02, 0, 0])


def hold_elbow(state: State) -> Cost:
    """A cost of one's own: the elbow stays still."""
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
    arm, config = PlanarArm(), ControlConfig(program=program)
    plain, held, slow, both = (
        QpIkController(arm, config, far_away(), frame="tip", terms=terms).step(
            np.array([0.3, 0.9]), arm.frame_pose(np.array([0.9, 1.4]), "tip")
        )
        for terms in ((), (hold_elbow,), (SlowShoulder(),), (hold_elbow, SlowShoulder()))
    )
    assert np.all(np.abs(plain.velocity) > 0.1) and not plain.interventions
    assert abs(held.velocity[1]) < 0.01 and abs(held.velocity[0]) > 0.1
    assert (slow.velocity[0], slow.scale) == (pytest.approx(-0.05, abs=1e-6), 1.0)
    assert [row.name for row in slow.interventions] == ["shoulder backwards"]
    assert abs(both.velocity[0]) <= 0.05 + 1e-6 and abs(both.velocity[1]) < 0.01

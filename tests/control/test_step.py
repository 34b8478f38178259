"""One controller step: the ladder, the check after solving, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.fixed import MULTIPLIER
from splatctrl_cli.control import barriers
from splatctrl_cli.control.columns import is_shaped
from splatctrl_cli.control.preconditions import static_violations
from splatctrl_cli.control.qp import QpSolution, QuadraticProgram, Residuals, Rung, solve_clarabel
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.records import DistanceField, Float64
from tests.control.fakes import Balls, Nowhere, PlanarArm, Plane, far_away, steps_towards

CONFIG = ControlConfig()
Q = np.array([0.3, 0.6])
OWN = ("base[0]~fore[0]", "base[0]~fore[1]")


ARM = PlanarArm()


def controller(field: DistanceField, config: ControlConfig = CONFIG, **options: object) -> QpIkController:
    return QpIkController(ARM, config, field, frame="tip", **options)  # type: ignore[arg-type]


def goal(*q: float) -> Float64:
    return ARM.frame_pose(np.array(q), "tip")


class Scripted:
    """A solver that answers the first `num_bad` programs with `bad`, then honestly."""

    def __init__(self, num_bad: int, status: str = "AlmostSolved", residual: float = 0.0) -> None:
        self.num_bad, self.status, self.residual = num_bad, status, residual

    def __call__(self, program: QuadraticProgram) -> QpSolution:
        solution = solve_clarabel(program)
        if self.num_bad == 0:
            return solution
        self.num_bad -= 1
        residuals = Residuals(primal=self.residual, dual=0.0, gap=0.0)
        return replace(solution, status=self.status, is_solved=self.status == "Solved", residuals=residuals)


def test_a_free_step_moves_the_frame_towards_its_goal() -> None:
    step = controller(far_away()).step(Q, goal(0.5, 0.4))
    assert step.rung is Rung.SOLVED and step.scale == 1.0
    assert (ARM.frame_jacobian(Q, "tip") @ step.velocity) @ step.pose_error > 0
    assert step.num_rows == 0 and step.relaxed == () and step.violated_fixed == ()
    assert step.residual < CONFIG.max_residual and step.status == "Solved"


def test_at_the_goal_only_the_pull_home_is_left() -> None:
    np.testing.assert_allclose(controller(far_away(), home=Q).step(Q, goal(*Q)).velocity, 0.0, atol=1e-7)


def test_a_step_never_approaches_faster_than_its_row_allows() -> None:
    wall = Plane([-1.0, 0.0, 0.0], -0.93)  # free where x < 0.93; the outermost sphere ends at 0.9 + 0.04
    arm, q = PlanarArm(), np.array([0.1, 0.1])
    step = controller(wall).step(q, goal(0.0, 0.0))
    distance, gradient = wall.query(arm.sphere_centers(q))
    clearance = (distance - arm.sphere_set.radii)[1:]
    rate = np.einsum("si,sij,j->s", gradient, arm.spheres_at(q)[1], step.velocity)[1:]
    slack = sum(row.slack for row in step.relaxed)
    assert np.all(rate >= -CONFIG.barrier_gain * (clearance - CONFIG.margin) - slack - 1e-5)
    assert (step.clearance, step.nearest) == (pytest.approx(clearance.min()), "fore[1]")
    guarding = {row.name: row for row in step.interventions}["fore[1]"]
    assert guarding.kind is RowKind.SCENE and guarding.multiplier > MULTIPLIER


def test_a_sphere_within_the_margin_is_pushed_back_out() -> None:
    arm, q = PlanarArm(), np.array([0.2, 0.1])
    ahead = arm.sphere_centers(q)[4, 1] + 0.04
    wall = Plane([0.0, -1.0, 0.0], -(ahead + 0.005))  # 5 mm of clearance, 15 mm short of the margin
    step = controller(wall).step(q, goal(0.6, 0.6))
    assert step.rung is Rung.SOLVED
    lifted = arm.spheres_at(q)[1][4, 1] @ step.velocity
    assert lifted == pytest.approx(-CONFIG.barrier_gain * 0.015, abs=1e-4)


def test_rows_that_cannot_all_hold_are_relaxed_and_named() -> None:
    q = np.array([0.3, 0.0])
    tip = ARM.sphere_centers(q)[4]
    squeeze = Balls([tip + np.array([0, 0.09, 0]), tip - np.array([0, 0.09, 0])], [0.05, 0.05])
    step = controller(squeeze, replace(CONFIG, margin=0.2, self_margin=0.0)).step(q, goal(*q))
    assert step.rung is Rung.RELAXED or step.rung is Rung.HOLD
    assert {row.name for row in step.relaxed} & {"fore[0]", "fore[1]"}
    assert all(row.is_near and row.slack > CONFIG.slack_tolerance for row in step.relaxed)


def test_a_row_that_gives_way_to_a_fast_approach_far_away_is_not_near_its_margin() -> None:
    q = np.array([0.3, 0.0])
    beside = Balls([ARM.sphere_centers(q)[4] + np.array([0, 0.25, 0])], [0.05])
    step = controller(beside).step(q, goal(*q), distance_rate=-20.0)
    assert step.relaxed and not any(row.is_near for row in step.relaxed)


def test_spheres_that_no_joint_moves_stay_out_of_the_program_and_are_reported() -> None:
    buried_base = Balls([[0.0, 0.0, 0.0]], [0.1])
    assert controller(buried_base).step(Q, goal(0.35, 0.55)).rung is Rung.SOLVED
    (violation,) = static_violations(PlanarArm(), buried_base, Q, CONFIG.margin)
    assert (violation.sphere, violation.clearance) == ("base[0]", pytest.approx(-0.1 - 0.06))


def test_a_flat_field_cannot_be_acted_on_and_is_named() -> None:
    flat = Plane([0.0, 0.0, 1.0], 0.0, scale=1.0)  # the arm moves within the plane: no row can help
    step = controller(flat).step(Q, goal(*Q))
    found = sorted(step.violated_fixed), step.fixed_distance
    assert found == (["fore[0]", "fore[1]", "upper[0]", "upper[1]"], pytest.approx(-0.04))
    assert controller(far_away()).step(Q, goal(*Q)).fixed_distance == np.inf


@pytest.mark.parametrize(("status", "residual"), [("AlmostSolved", 0.0), ("Solved", 1e-3), ("MaxIterations", 0.0)])
def test_an_unchecked_solution_is_never_used(status: str, residual: float) -> None:
    """The first program has no slacks, the second has, and the third is of the least violation."""
    once, twice, thrice = (
        controller(far_away(), solver=Scripted(num, status, residual)).step(Q, goal(0.0, 0.0)) for num in (1, 2, 3)
    )
    assert once.rung is Rung.SOLVED
    assert twice.rung is Rung.MINIMUM_VIOLATION and twice.num_refused == 1
    np.testing.assert_allclose(twice.velocity, 0.0, atol=1e-6)
    assert thrice.rung is Rung.HOLD and thrice.scale == 0.0 and thrice.num_refused == 2
    assert np.all(thrice.velocity == 0.0)


class Cliff:
    """A field that lies about what comes next: distance 0.1 up to x = wall, then far below."""

    def __init__(self, wall: float, depth: float = -0.5) -> None:
        self.wall, self.depth = wall, depth

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        return np.where(points[:, 0] > self.wall, self.depth, 0.3), np.zeros_like(points)


def test_a_step_that_turns_out_worse_than_promised_is_scaled_back() -> None:
    q, target = np.array([0.5, -0.5]), goal(0.0, 0.0)
    tip = ARM.sphere_centers(q)[4, 0]
    free = controller(far_away()).step(q, target)
    reach = ARM.sphere_centers(q + CONFIG.period * free.velocity)[4, 0] - tip
    assert reach > 0
    step = controller(Cliff(tip + 0.3 * reach)).step(q, target)
    assert step.scale == 0.25 and is_shaped(step) and not is_shaped(free)
    np.testing.assert_allclose(step.velocity, 0.25 * free.velocity, atol=1e-5)
    for depth in (-0.5, np.nan):
        blocked = controller(Cliff(tip + 1e-9, depth)).step(q, target)
        assert blocked.rung is Rung.HOLD and np.all(blocked.velocity == 0.0)


def test_a_self_collision_row_holds_the_links_apart() -> None:
    folding = controller(far_away(), replace(CONFIG, self_margin=0.2))  # the fore arm back over the base sphere
    last = steps_towards(folding, np.array([0.0, 2.3]), goal(0.0, 2.59), 200)[0][-1]
    assert last.self_clearance >= 0.2 - 1e-4 and "base[0]~fore[1]" in last.intervening


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"period": 0.0}, "control.period"),
        (
            {"period": 0.02, "barrier_gain": 51.0},
            "control.barrier_gain: expected at most 1 / control.period = 50 1/s",
        ),
        ({"weight_slack": 0.0}, "control.weight_slack"),
    ],
)
def test_numbers_that_no_controller_can_run_with_are_refused(changes: dict[str, float], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        controller(far_away(), replace(CONFIG, **changes))


@pytest.mark.parametrize(
    ("q", "velocity_limit", "field", "error", "words"),
    [
        ([0.0, np.nan], 1.0, far_away(), InputError, "joint elbow is nan"),
        ([0.0, 0.0, 0.0], 1.0, far_away(), InputError, "expected 2 joints"),
        ([0.3, 0.6], 0.0, far_away(), InputError, "joint elbow: expected a velocity limit above zero"),
        ([0.3, 0.6], 1.0, Nowhere(), NotEvaluableError, r"sphere upper\[0\] at"),
    ],
)
def test_a_posture_an_arm_or_a_field_that_allows_no_step_is_refused_by_name(
    q: list[float], velocity_limit: float, field: DistanceField, error: type[Exception], words: str
) -> None:
    arm = PlanarArm()
    arm.velocity_limit[1] = velocity_limit
    with pytest.raises(error, match=words):
        QpIkController(arm, CONFIG, field, frame="tip").step(np.array(q), goal(*Q))


def test_a_start_outside_the_joint_limits_is_brought_back() -> None:
    q = np.array([2.95, 0.0])
    step = controller(far_away()).step(q, goal(*q))
    assert step.rung is Rung.SOLVED
    assert step.velocity[0] == pytest.approx(-0.5, abs=1e-5)  # gain 10 /s times 0.05 rad
    assert [(row.name, row.kind) for row in step.interventions] == [("shoulder highest", RowKind.LIMIT)]


def test_the_margin_of_a_velocity_is_the_room_that_its_tightest_row_has_left() -> None:
    wall, q, arm = Plane([-1.0, 0.0, 0.0], -0.99), np.array([0.3, 0.2]), PlanarArm()
    steered, names = controller(wall), ["upper[0]", "upper[1]", "fore[0]", "fore[1]", *OWN]

    def distances(at: Float64) -> Float64:
        centers = arm.sphere_centers(at)
        own = np.linalg.norm(centers[0] - centers[3:], axis=1) - 0.1
        return np.concatenate([(wall.query(centers)[0] - arm.sphere_set.radii)[1:], own])

    for velocity in np.random.default_rng(0).uniform(-1.4, 1.4, (20, 2)):
        found = steered.margin_of(q, velocity, distance_rate=-0.01)
        rate = (distances(q + 1e-6 * velocity) - distances(q - 1e-6 * velocity)) / 2e-6
        margin = np.repeat([CONFIG.margin, CONFIG.self_margin], [4, 2])
        rooms = CONFIG.barrier_gain * (distances(q) - margin) + rate - np.repeat([0.01, 0.0], [4, 2])
        assert found.barrier == pytest.approx(rooms.min(), abs=1e-7)
        assert found.barrier_row == names[int(np.argmin(rooms))]
        assert found.limit == pytest.approx(min(1.5 - velocity.max(), 1.5 + velocity.min()))
    assert steered.margin_of(q, steered.step(q, goal(0.0, 0.0)).velocity).barrier >= -1e-6
    assert steered.margin_of(q, np.array([0.0, 2.0])).limit_row == "elbow highest"


def test_a_step_changes_the_velocity_by_no_more_than_the_acceleration_allows() -> None:
    target = goal(-0.9, 1.4)
    steps, _ = steps_towards(controller(far_away(), replace(CONFIG, max_acceleration=3.0)), Q, target, 40)
    velocity = np.array([np.zeros(2), *(step.velocity for step in steps)])
    assert np.all(np.abs(np.diff(velocity, axis=0)) <= 0.03 + 1e-7)
    assert np.abs(velocity[-1]).max() > 0.2
    assert np.abs(controller(far_away()).step(Q, target, last_velocity=np.zeros(2)).velocity).max() > 0.1


@pytest.mark.parametrize(
    ("changes", "num_bad", "expected"),
    [
        ({"max_acceleration": 4.0}, 3, [0.46, 0.0]),
        ({}, 3, [0.0, 0.0]),
        ({"max_acceleration": 4.0, "program": "printed", "barrier_gain": 1.0}, 1, [0.46, 0.0]),
    ],
)
def test_holding_still_is_braking_where_the_arm_cannot_stop_at_once(
    changes: dict[str, object], num_bad: int, expected: list[float]
) -> None:
    steered = controller(far_away(), replace(CONFIG, **changes), solver=Scripted(num_bad))  # type: ignore[arg-type]
    step = steered.step(Q, goal(0.0, 0.0), last_velocity=np.array([0.5, -0.02]))
    assert step.rung is Rung.HOLD and step.scale == 0.0
    np.testing.assert_allclose(step.velocity, expected, atol=1e-12)


@pytest.mark.parametrize("wall", [1e-9, 4e-4, 8e-4])
def test_a_step_that_is_scaled_back_still_brakes_no_harder_than_it_can(wall: float) -> None:
    q, last = np.array([0.5, -0.5]), np.array([-0.3, 0.4])
    braking = controller(Cliff(ARM.sphere_centers(q)[4, 0] + wall), replace(CONFIG, max_acceleration=2.0))
    velocity = braking.step(q, goal(0.0, 0.0), last_velocity=last).velocity
    assert np.all(np.abs(velocity - last) <= 0.02 + 1e-7)


@pytest.mark.parametrize("acceleration", [2.0, 10.0])
def test_an_arm_that_cannot_stop_at_once_keeps_its_margin_by_looking_ahead(
    acceleration: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = {"max_acceleration": acceleration, "max_linear_speed": 1.5, "max_angular_speed": 9.0}
    steered = controller(Plane([0.0, -1.0, 0.0], -0.6), replace(CONFIG, barrier_gain=50.0, **limits))

    def least() -> float:
        steps, _ = steps_towards(steered, np.array([-0.9, 0.3]), goal(1.3, 0.3), 300)
        return min(step.clearance for step in steps)

    assert CONFIG.margin - 1e-4 < least() < CONFIG.margin + 1e-3
    monkeypatch.setattr(barriers, "braking_speed", lambda room, gain, *_: gain * room)
    assert least() < CONFIG.margin - 5e-3


def test_smoothness_pulls_the_velocity_towards_the_last_one() -> None:
    target, last, apart = goal(-0.9, 1.4), np.array([0.2, 0.2]), []
    free = controller(far_away()).step(Q, target, last_velocity=last).velocity
    for weight in (0.0, 0.1, 1.0, 100.0):
        smooth = controller(far_away(), replace(CONFIG, smoothness_weight=weight))
        apart.append(np.linalg.norm(smooth.step(Q, target, last_velocity=last).velocity - last))
        np.testing.assert_allclose(smooth.step(Q, target).velocity, free, atol=1e-9)
    assert apart[0] > apart[1] > apart[2] > apart[3]

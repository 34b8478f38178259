"""One controller step: the ladder, the check after solving, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.fixed import MULTIPLIER
from splatctrl_cli.control import barriers
from splatctrl_cli.control.open_loop import is_shaped
from splatctrl_cli.control.preconditions import static_violations
from splatctrl_cli.control.qp import ClarabelSolver, QpSolution, QuadraticProgram, Residuals, Rung
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.records import DistanceField, Float64
from tests.control.fakes import Balls, PlanarArm, Plane, far_away

CONFIG = ControlConfig()
Q = np.array([0.3, 0.6])


def controller(field: DistanceField, config: ControlConfig = CONFIG, **options: object) -> QpIkController:
    return QpIkController(PlanarArm(), config, field, frame="tip", **options)  # type: ignore[arg-type]


def goal(q: Float64) -> Float64:
    return PlanarArm().frame_pose(q, "tip")


class Scripted:
    """A solver that answers the first `num_bad` programs with `bad`, then honestly."""

    def __init__(self, num_bad: int, status: str = "AlmostSolved", residual: float = 0.0) -> None:
        self.num_bad, self.status, self.residual = num_bad, status, residual
        self.honest = ClarabelSolver()

    def solve(self, program: QuadraticProgram) -> QpSolution:
        solution = self.honest.solve(program)
        if self.num_bad == 0:
            return solution
        self.num_bad -= 1
        residuals = Residuals(primal=self.residual, dual=0.0, gap=0.0)
        return replace(solution, status=self.status, is_solved=self.status == "Solved", residuals=residuals)


def test_a_free_step_moves_the_frame_towards_its_goal() -> None:
    step = controller(far_away()).step(Q, goal(np.array([0.5, 0.4])))
    moved = PlanarArm().frame_jacobian(Q, "tip") @ step.velocity
    assert step.rung is Rung.SOLVED and step.scale == 1.0
    assert moved @ step.pose_error > 0
    assert step.num_rows == 0 and step.relaxed == () and step.violated_fixed == ()
    assert step.residual < CONFIG.max_residual and step.status == "Solved"


def test_at_the_goal_only_the_pull_home_is_left() -> None:
    step = controller(far_away(), home=Q).step(Q, goal(Q))
    np.testing.assert_allclose(step.velocity, 0.0, atol=1e-7)


def test_a_step_never_approaches_faster_than_its_row_allows() -> None:
    wall = Plane([-1.0, 0.0, 0.0], -0.93)  # free where x < 0.93; the outermost sphere ends at 0.9 + 0.04
    q = np.array([0.1, 0.1])
    step = controller(wall).step(q, goal(np.zeros(2)))
    arm = PlanarArm()
    centers, jacobians = arm.sphere_centers(q), arm.sphere_jacobians(q)
    distance, gradient = wall.query(centers)
    clearance = (distance - arm.sphere_set.radii)[1:]
    rate = np.einsum("si,sij,j->s", gradient, jacobians, step.velocity)[1:]
    slack = {row.name: row.slack for row in step.relaxed}
    assert np.all(rate >= -CONFIG.barrier_gain * (clearance - CONFIG.margin) - sum(slack.values()) - 1e-5)
    assert "fore[1]" in step.intervening
    assert step.clearance == pytest.approx(clearance.min()) and step.nearest == "fore[1]"


def test_a_sphere_within_the_margin_is_pushed_back_out() -> None:
    wall = Plane([0.0, -1.0, 0.0], -0.25)
    q = np.array([0.2, 0.1])
    ahead = PlanarArm().sphere_centers(q)[4, 1] + 0.04
    wall.offset = -(ahead + 0.005)  # 5 mm of clearance, 15 mm short of the margin
    step = controller(wall).step(q, goal(np.array([0.6, 0.6])))
    assert step.rung is Rung.SOLVED
    lifted = PlanarArm().sphere_jacobians(q)[4, 1] @ step.velocity
    assert lifted == pytest.approx(-CONFIG.barrier_gain * 0.015, abs=1e-4)


def test_rows_that_cannot_all_hold_are_relaxed_and_named() -> None:
    q = np.array([0.3, 0.0])
    tip = PlanarArm().sphere_centers(q)[4]
    squeeze = Balls([tip + np.array([0, 0.09, 0]), tip - np.array([0, 0.09, 0])], [0.05, 0.05])
    narrow = replace(CONFIG, margin=0.2, self_margin=0.0)
    step = controller(squeeze, narrow).step(q, goal(q))
    assert step.rung is Rung.RELAXED or step.rung is Rung.HOLD
    assert {row.name for row in step.relaxed} & {"fore[0]", "fore[1]"}
    assert all(row.slack > CONFIG.slack_tolerance for row in step.relaxed)


def test_spheres_that_no_joint_moves_stay_out_of_the_program_and_are_reported() -> None:
    buried_base = Balls([[0.0, 0.0, 0.0]], [0.1])
    step = controller(buried_base).step(Q, goal(np.array([0.35, 0.55])))
    assert step.rung is Rung.SOLVED
    (violation,) = static_violations(PlanarArm(), buried_base, Q, CONFIG.margin)
    assert violation.sphere == "base[0]"
    assert violation.clearance == pytest.approx(-0.1 - 0.06)


def test_a_flat_field_cannot_be_acted_on_and_is_named() -> None:
    flat = Plane([0.0, 0.0, 1.0], 0.0, scale=1.0)  # the arm moves within the plane: no row can help
    step = controller(flat).step(Q, goal(Q))
    assert set(step.violated_fixed) == {"upper[0]", "upper[1]", "fore[0]", "fore[1]"}
    assert step.fixed_distance == pytest.approx(-0.04)
    assert controller(far_away()).step(Q, goal(Q)).fixed_distance == np.inf


@pytest.mark.parametrize(("status", "residual"), [("AlmostSolved", 0.0), ("Solved", 1e-3), ("MaxIterations", 0.0)])
def test_an_unchecked_solution_is_never_used(status: str, residual: float) -> None:
    step = controller(far_away(), solver=Scripted(1, status, residual)).step(Q, goal(np.zeros(2)))
    assert step.rung is Rung.SOLVED  # with slacks, after the program without them did not check
    step = controller(far_away(), solver=Scripted(2, status, residual)).step(Q, goal(np.zeros(2)))
    assert step.rung is Rung.MINIMUM_VIOLATION
    assert step.num_refused == 1
    np.testing.assert_allclose(step.velocity, 0.0, atol=1e-6)
    step = controller(far_away(), solver=Scripted(3, status, residual)).step(Q, goal(np.zeros(2)))
    assert step.rung is Rung.HOLD and step.scale == 0.0 and step.num_refused == 2
    assert np.all(step.velocity == 0.0)


class Cliff:
    """A field that lies about what comes next: distance 0.1 up to x = wall, then far below."""

    def __init__(self, wall: float, depth: float = -0.5) -> None:
        self.wall, self.depth = wall, depth

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        return np.where(points[:, 0] > self.wall, self.depth, 0.3), np.zeros_like(points)


def test_a_step_that_turns_out_worse_than_promised_is_scaled_back() -> None:
    q = np.array([0.5, -0.5])
    tip = PlanarArm().sphere_centers(q)[4, 0]
    target = goal(np.zeros(2))
    free = controller(far_away()).step(q, target)
    reach = PlanarArm().sphere_centers(q + CONFIG.period * free.velocity)[4, 0] - tip
    assert reach > 0
    step = controller(Cliff(tip + 0.3 * reach)).step(q, target)
    assert step.scale == 0.25
    assert is_shaped(step) and not is_shaped(free)
    np.testing.assert_allclose(step.velocity, 0.25 * free.velocity, atol=1e-5)
    blocked = controller(Cliff(tip + 1e-9)).step(q, target)
    assert blocked.rung is Rung.HOLD and np.all(blocked.velocity == 0.0)
    no_distance = controller(Cliff(tip + 1e-9, np.nan)).step(q, target)
    assert no_distance.rung is Rung.HOLD


def test_a_self_collision_row_holds_the_links_apart() -> None:
    q = np.array([0.0, 2.3])  # the fore arm folds back over the base sphere
    arm = PlanarArm()
    own = QpIkController(arm, replace(CONFIG, self_margin=0.2), far_away(), frame="tip")
    for _ in range(200):
        step = own.step(q, goal(np.array([0.0, 2.59])))
        q = q + CONFIG.period * step.velocity
    assert step.self_clearance >= 0.2 - 1e-4
    assert "base[0]~fore[1]" in step.intervening


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


def test_a_posture_that_is_not_finite_or_has_another_size_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="joint elbow is nan"):
        controller(far_away()).step(np.array([0.0, np.nan]), goal(Q))
    with pytest.raises(InputError, match="expected 2 joints"):
        controller(far_away()).step(np.zeros(3), goal(Q))


def test_a_joint_without_a_velocity_limit_is_refused() -> None:
    arm = PlanarArm()
    arm.velocity_limit = np.array([1.0, 0.0])
    with pytest.raises(InputError, match="joint elbow: expected a velocity limit above zero"):
        QpIkController(arm, CONFIG, far_away(), frame="tip")


def test_a_field_without_a_distance_names_the_sphere_and_the_place() -> None:
    with pytest.raises(NotEvaluableError, match=r"sphere upper\[0\] at"):
        controller(Cliff(-9.0, np.nan)).step(Q, goal(Q))


def test_a_start_outside_the_joint_limits_is_brought_back() -> None:
    q = np.array([2.95, 0.0])
    step = controller(far_away()).step(q, goal(q))
    assert step.rung is Rung.SOLVED
    assert step.velocity[0] == pytest.approx(-0.5, abs=1e-5)  # gain 10 /s times 0.05 rad
    assert "shoulder highest" in step.intervening


def test_interventions_say_what_guards_and_at_what_price() -> None:
    wall = Plane([-1.0, 0.0, 0.0], -0.93)
    rows = {row.name: row for row in controller(wall).step(np.array([0.1, 0.1]), goal(np.zeros(2))).interventions}
    assert rows["fore[1]"].kind is RowKind.SCENE and rows["fore[1]"].multiplier > MULTIPLIER
    arm = PlanarArm()
    fast = controller(far_away(), replace(CONFIG, pose_gain=50.0, max_linear_speed=9.0, max_angular_speed=9.0))
    kinds = {row.name: row.kind for row in fast.step(arm.upper - 0.01, goal(arm.upper + 1.0)).interventions}
    assert kinds and set(kinds.values()) == {RowKind.LIMIT}


def test_the_margin_of_a_velocity_is_the_room_that_its_tightest_row_has_left() -> None:
    wall, q = Plane([-1.0, 0.0, 0.0], -0.99), np.array([0.3, 0.2])
    steered, arm = controller(wall), PlanarArm()
    for velocity in np.random.default_rng(0).uniform(-1.4, 1.4, (20, 2)):
        found = steered.margin_of(q, velocity, distance_rate=-0.01)
        ahead, before = (arm.sphere_centers(q + h * velocity) for h in (1e-6, -1e-6))
        rate = (wall.query(ahead)[0] - wall.query(before)[0])[1:] / 2e-6
        clearance = (wall.query(arm.sphere_centers(q))[0] - arm.sphere_set.radii)[1:]
        room = CONFIG.barrier_gain * (clearance - CONFIG.margin) - 0.01 + rate
        between = [np.linalg.norm(c[0] - c[3:], axis=1) for c in (ahead, arm.sphere_centers(q), before)]
        own = CONFIG.barrier_gain * (between[1] - 0.1 - CONFIG.self_margin) + (between[0] - between[2]) / 2e-6
        names = ["upper[0]", "upper[1]", "fore[0]", "fore[1]", "base[0]~fore[0]", "base[0]~fore[1]"]
        all_rooms = np.concatenate([room, own])
        assert found.barrier == pytest.approx(all_rooms.min(), abs=1e-7)
        assert found.barrier_row == names[int(np.argmin(all_rooms))]
        assert found.limit == pytest.approx(min(1.5 - velocity.max(), 1.5 + velocity.min()))
    step = steered.step(q, goal(np.zeros(2)))
    assert steered.margin_of(q, step.velocity).barrier >= -1e-6
    assert steered.margin_of(q, np.array([0.0, 2.0])).limit_row == "elbow highest"


def test_a_step_changes_the_velocity_by_no_more_than_the_acceleration_allows() -> None:
    limited = controller(far_away(), replace(CONFIG, max_acceleration=3.0))
    last, q = np.zeros(2), Q
    for _ in range(40):
        step = limited.step(q, goal(np.array([-0.9, 1.4])), last_velocity=last)
        assert np.all(np.abs(step.velocity - last) <= 0.03 + 1e-7)
        q, last = q + CONFIG.period * step.velocity, step.velocity
    assert np.abs(last).max() > 0.2
    free = controller(far_away()).step(Q, goal(np.array([-0.9, 1.4])), last_velocity=np.zeros(2))
    assert np.abs(free.velocity).max() > 0.1


def test_holding_still_is_braking_where_the_arm_cannot_stop_at_once() -> None:
    config, last = replace(CONFIG, max_acceleration=4.0), np.array([0.5, -0.02])
    step = controller(far_away(), config, solver=Scripted(3)).step(Q, goal(np.zeros(2)), last_velocity=last)
    assert step.rung is Rung.HOLD and step.scale == 0.0
    np.testing.assert_allclose(step.velocity, [0.46, 0.0], atol=1e-12)
    at_once = controller(far_away(), solver=Scripted(3)).step(Q, goal(np.zeros(2)), last_velocity=last)
    assert at_once.rung is Rung.HOLD and not at_once.velocity.any()
    printed = replace(config, program="printed", barrier_gain=1.0)
    step = controller(far_away(), printed, solver=Scripted(1)).step(Q, goal(np.zeros(2)), last_velocity=last)
    assert step.rung is Rung.HOLD
    np.testing.assert_allclose(step.velocity, [0.46, 0.0], atol=1e-12)


def test_a_step_that_is_scaled_back_still_brakes_no_harder_than_it_can() -> None:
    q, last = np.array([0.5, -0.5]), np.array([-0.3, 0.4])
    tip = PlanarArm().sphere_centers(q)[4, 0]
    config = replace(CONFIG, max_acceleration=2.0)
    for wall in (1e-9, 4e-4, 8e-4):
        step = controller(Cliff(tip + wall), config).step(q, goal(np.zeros(2)), last_velocity=last)
        assert np.all(np.abs(step.velocity - last) <= 0.02 + 1e-7)


@pytest.mark.parametrize("acceleration", [2.0, 10.0])
def test_an_arm_that_cannot_stop_at_once_keeps_its_margin_by_looking_ahead(
    acceleration: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = Plane([0.0, -1.0, 0.0], -0.6)
    config = replace(CONFIG, max_acceleration=acceleration, max_linear_speed=1.5, max_angular_speed=9.0)

    def least() -> float:
        steered, q, last, clearance = (
            controller(wall, replace(config, barrier_gain=50.0)),
            np.array([-0.9, 0.3]),
            np.zeros(2),
            [],
        )
        for _ in range(300):
            step = steered.step(q, goal(np.array([1.3, 0.3])), last_velocity=last)
            clearance.append(step.clearance)
            q, last = q + CONFIG.period * step.velocity, step.velocity
        return min(clearance)

    assert CONFIG.margin - 1e-4 < least() < CONFIG.margin + 1e-3
    monkeypatch.setattr(barriers, "braking_speed", lambda room, gain, *_: gain * room)
    assert least() < CONFIG.margin - 5e-3


def test_smoothness_pulls_the_velocity_towards_the_last_one() -> None:
    target, last = goal(np.array([-0.9, 1.4])), np.array([0.2, 0.2])
    free = controller(far_away()).step(Q, target, last_velocity=last).velocity
    apart = []
    for weight in (0.1, 1.0, 100.0):
        smooth = controller(far_away(), replace(CONFIG, smoothness_weight=weight))
        apart.append(np.linalg.norm(smooth.step(Q, target, last_velocity=last).velocity - last))
        np.testing.assert_allclose(smooth.step(Q, target).velocity, free, atol=1e-9)
    assert np.linalg.norm(free - last) > apart[0] > apart[1] > apart[2]

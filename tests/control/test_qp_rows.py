"""Every row of the program against finite differences of the distance that it guards, on real kinematic chains; and
the program as printed: it agrees with the reduced one where it must, and where it does not, by how much.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.fixed import BRAKING_SHARE
from splatctrl_cli.control.barriers import SceneStep, distance_rate, scene_margin
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.qp_rows import RowBuilder, Rows, assemble_printed
from splatctrl_cli.control.step import ControlStep, QpIkController
from splatctrl_cli.control.terms import JointLimits, RowKind, State, box_rows, stray_cost
from splatctrl_cli.records import DistanceField, Float64
from splatctrl_cli.robot.model import RobotModel
from tests.control.fakes import Balls, PlanarArm, Plane, far_away, sample_arm
from tests.reference.control import braking_room
from tests.refused import expect_refusal

CONFIG = ControlConfig()
STEP = 1e-6
ROOM = Balls([[0.6, 0.3, 0.5], [-0.4, 0.5, 0.7], [0.2, -0.6, 0.4]], [0.1, 0.05, 0.15])
SLOPE = Plane([0.4, -0.5, 0.6], -1.2, scale=0.8)


@pytest.fixture(scope="session", params=["sample arm", "Panda"])
def arm(request: pytest.FixtureRequest, plain_arm: Path) -> RobotModel:
    if request.param == "sample arm":
        return sample_arm(plain_arm)
    real = request.getfixturevalue("real_data")
    spheres = real / "robot_spheres" / "robometrics" / "robometrics" / "content" / "robot" / "franka_spheres.yml"
    urdf = real / "vamp_panda" / "resources" / "panda" / "panda.urdf"
    return RobotModel.from_urdf(urdf, spheres)


def postures(arm: RobotModel, num: int) -> Float64:
    """Postures well within the limits."""
    half = 0.4 * (arm.upper - arm.lower)
    return arm.middle + np.random.default_rng(5).uniform(-half, half, (num, len(half)))


def state_at(arm: RobotModel, q: Float64, rate: float | Float64 = 0.0) -> State:
    """State whose velocity box is wide enough for every row to bind."""
    wide = np.full(arm.num_joints, 1e3)
    return State(model=arm, frame=arm.frame_names[-1], q=q, box=(-wide, wide), distance_rate=rate)


def rows_of(arm: RobotModel, field: Balls | Plane, q: Float64, rate: float = 0.0, **options: object) -> Rows:
    return RowBuilder(arm, CONFIG, field, **options).at(state_at(arm, q, rate))  # type: ignore[arg-type]


def slopes(arm: RobotModel, field: Balls | Plane, q: Float64) -> Float64:
    """``dd/dq`` (M, J) by central differences of the distances of every row."""
    builder = RowBuilder(arm, CONFIG, field)
    steps = STEP * np.eye(arm.num_joints)
    return np.stack([(builder.distances(q + e) - builder.distances(q - e)) / (2 * STEP) for e in steps], axis=1)


@pytest.mark.parametrize("field", [ROOM, SLOPE], ids=["balls", "scaled plane"])
def test_every_row_is_less_the_derivative_of_its_distance_along_each_joint(
    arm: RobotModel, field: Balls | Plane
) -> None:
    for q in postures(arm, 6):
        rows, by_difference = rows_of(arm, field, q), slopes(arm, field, q)
        num_external = len(rows.external)
        np.testing.assert_allclose(rows.external.G, -by_difference[:num_external], atol=2e-8)
        np.testing.assert_allclose(rows.own.G, -by_difference[num_external:], atol=2e-8)
        assert len(rows.own) > 100 and np.abs(rows.own.G).max() > 0.1


def test_the_bound_of_every_row_is_the_gain_times_the_distance_above_its_margin(arm: RobotModel) -> None:
    q = postures(arm, 1)[0]
    rows, centers, radii = rows_of(arm, ROOM, q, rate=-0.07), arm.sphere_centers(q), arm.sphere_set.radii
    is_moving = arm.moving_spheres
    np.testing.assert_allclose(
        rows.external.h, 10.0 * (ROOM.query(centers)[0] - radii - 0.02)[is_moving] - 0.07, atol=1e-12
    )
    between = [np.linalg.norm(centers[a] - centers[b]) - radii[a] - radii[b] for a, b in arm.self_pairs()]
    np.testing.assert_allclose(rows.own.h, 10.0 * (np.array(between) - 0.02), atol=1e-12)


def test_what_is_left_of_a_row_is_its_promise_along_any_velocity(arm: RobotModel) -> None:
    random, builder = np.random.default_rng(7), RowBuilder(arm, CONFIG, ROOM)
    for q in postures(arm, 4):
        velocity = random.uniform(-1.0, 1.0, arm.num_joints)
        ahead, behind = builder.distances(q + STEP * velocity), builder.distances(q - STEP * velocity)
        margin = np.where(np.arange(len(ahead)) < len(builder.scene.names), CONFIG.margin, CONFIG.self_margin)
        promise = 10.0 * (builder.distances(q) - margin) + (ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(builder.room(state_at(arm, q), velocity), promise, atol=1e-7)


def test_a_row_with_limited_braking_asks_for_the_room_that_braking_takes(arm: RobotModel) -> None:
    acceleration, velocity = np.linspace(2.0, 5.0, arm.num_joints), np.full(arm.num_joints, 0.3)
    for q in postures(arm, 2):
        rows = rows_of(arm, ROOM, q, acceleration=acceleration)
        G = np.concatenate([rows.external.G, rows.own.G])
        room, deceleration = rows.distance - rows.margin, BRAKING_SHARE * np.abs(G) @ acceleration
        chosen = np.r_[np.arange(len(rows.external)), np.arange(len(rows.external), len(G), 40)]
        chosen = chosen[(room[chosen] > 0) & (deceleration[chosen] > 1e-6)]
        needed = [braking_room(float(rows.h[k]), 10.0, float(deceleration[k]), 0.01) for k in chosen]
        np.testing.assert_allclose(needed, room[chosen], rtol=1e-9)
        assert np.count_nonzero(rows.h[chosen] < 10.0 * room[chosen] - 1e-9) > 5
        builder = RowBuilder(arm, CONFIG, ROOM, acceleration)
        np.testing.assert_allclose(builder.room(state_at(arm, q), velocity), rows.h - G @ velocity, atol=1e-12)


def test_the_rate_of_a_row_is_the_derivative_of_its_distance_in_time(arm: RobotModel) -> None:
    q, speed, dt = postures(arm, 1)[0], np.array([-0.2, -0.3, 0.1]), 1e-3
    points, moved = arm.sphere_centers(q)[arm.moving_spheres], Balls(ROOM.centers + dt * speed, ROOM.radii)
    rate = distance_rate(SceneStep(newer=moved, older=ROOM, seconds=dt), points, limit=9.0)
    expected = -ROOM.query(points)[1] @ speed  # along the gradient of the nearest ball
    np.testing.assert_allclose(rate, np.minimum(expected, 0.0), atol=1e-3)
    assert np.min(expected) < -0.1 < 0.1 < np.max(expected)
    still, coming = rows_of(arm, ROOM, q), RowBuilder(arm, CONFIG, ROOM).at(state_at(arm, q, rate))
    np.testing.assert_allclose(coming.external.h - still.external.h, rate, atol=1e-12)
    np.testing.assert_array_equal(coming.own.h, still.own.h)


def test_a_limit_row_is_less_the_derivative_of_the_way_to_the_limit(arm: RobotModel) -> None:
    q, steps = arm.upper - 0.001, STEP * np.eye(arm.num_joints)

    def ways(q: Float64) -> Float64:
        return np.concatenate([arm.upper - q, q - arm.lower])

    G, h = box_rows(*JointLimits.of(arm, replace(CONFIG, barrier_gain=0.1)).box(q))
    by_difference = np.stack([(ways(q + e) - ways(q - e)) / (2 * STEP) for e in steps], axis=1)
    np.testing.assert_allclose(G, -by_difference, atol=1e-8)
    np.testing.assert_allclose(h, np.minimum(0.1 * ways(q), np.tile(arm.velocity_limit, 2)), atol=1e-12)


def test_the_printed_rows_hold_the_same_derivatives_and_give_way_outside_alone(arm: RobotModel) -> None:
    q, J, ones = postures(arm, 1)[0], arm.num_joints, np.ones(6)
    rows, state = rows_of(arm, ROOM, q), state_at(arm, q)
    program = assemble_printed(state, (ones, ones), stray_cost(np.zeros(J), 1e-3), rows.external, [rows.own])
    M = len(rows.external)
    np.testing.assert_allclose(program.G[2 * J :, :J], -slopes(arm, ROOM, q), atol=2e-8)
    np.testing.assert_array_equal(program.G[2 * J : 2 * J + M, J + 6 :], np.eye(M))
    assert not program.G[2 * J + M :, J:].any() and not program.G[:, J : J + 6].any()
    np.testing.assert_array_equal(program.h[2 * J :], rows.h)
    z = np.random.default_rng(0).normal(size=len(program.c))
    v, x = z[:J], z[J : J + 6]
    gap = x - state.jacobian @ v
    printed = x @ x + gap @ gap + CONFIG.weight_slack * z[J + 6 :] @ z[J + 6 :] + 1e-3 * v @ v
    assert 0.5 * z @ program.H @ z + program.c @ z == pytest.approx(printed)


def test_the_margin_of_a_row_grows_by_what_its_body_leaves_uncovered_where_that_is_asked_for() -> None:
    arm, q = PlanarArm(), np.array([0.3, 0.6])
    arm.sphere_deficit = np.array([np.nan, 0.01, 0.01, 0.03, 0.0])
    wanted = replace(CONFIG, coverage="margin")
    np.testing.assert_allclose(scene_margin(arm, CONFIG), 0.02)
    np.testing.assert_allclose(scene_margin(arm, wanted)[1:], [0.03, 0.03, 0.05, 0.02])
    state = State(model=arm, frame="tip", q=q, box=(np.full(2, -9.0), np.full(2, 9.0)))
    plain, wider = (RowBuilder(arm, config, far_away()).at(state) for config in (CONFIG, wanted))
    np.testing.assert_allclose(plain.external.h - wider.external.h, [0.1, 0.1, 0.3, 0.0], atol=1e-12)
    np.testing.assert_array_equal(plain.own.h, wider.own.h)
    arm.sphere_deficit[3] = np.nan
    expect_refusal(
        r"sphere fore\[0\]: expected a measured coverage", QpIkController, arm, wanted, far_away(), frame="tip"
    )


REDUCED = ControlConfig(barrier_gain=1.0)
PAPER = ControlConfig(program="printed", barrier_gain=1.0)


def both(field: DistanceField, q: Float64, goal: Float64, **changes: float) -> tuple[ControlStep, ...]:
    """The printed and the reduced step from q towards the pose of another posture."""
    arm = PlanarArm()
    configs = [replace(config, **changes) for config in (PAPER, REDUCED)]  # type: ignore[arg-type]
    T = arm.frame_pose(goal, "tip")
    return tuple(QpIkController(arm, config, field, frame="tip").step(q, T) for config in configs)


def test_both_forms_agree_where_no_external_row_is_active() -> None:
    random = np.random.default_rng(2)
    for _ in range(25):
        printed, reduced = both(far_away(), *random.uniform(-2.5, 2.5, (2, 2)), self_margin=0.0)
        np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-6)
        assert printed.rung is reduced.rung is Rung.SOLVED


@pytest.mark.parametrize(
    ("kind", "q", "goal", "changes"),
    [
        (RowKind.LIMIT, PlanarArm().upper - 0.05, PlanarArm().upper + 0.6, {"max_angular_speed": 3.0}),
        (RowKind.SELF, np.array([0.0, 2.45]), np.array([0.0, 2.6]), {"self_margin": 0.21}),
    ],
)
def test_both_forms_agree_at_limits_and_at_self_collision_rows(
    kind: RowKind, q: Float64, goal: Float64, changes: dict[str, float]
) -> None:
    printed, reduced = both(far_away(), q, goal, **changes)
    assert any(row.kind is kind for row in printed.interventions)
    np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-6)


def test_the_squared_slack_alone_gives_way_where_the_exact_one_holds() -> None:
    """More weight on it comes near the exact one."""
    wall, q, apart = Plane([-1.0, 0.0, 0.0], -0.96), np.array([0.3, 0.3]), []
    printed, reduced = both(wall, q, np.zeros(2))
    assert reduced.rung is Rung.SOLVED and not reduced.relaxed and printed.rung is Rung.RELAXED
    (row,) = [row for row in printed.interventions if row.kind is RowKind.SCENE]
    slack = {row.name: row.slack for row in printed.relaxed}
    assert slack[row.name] == pytest.approx(row.multiplier / (2 * PAPER.weight_slack), rel=1e-4)
    for weight in (1e2, 1e4, 1e6):
        printed, reduced = both(wall, q, np.zeros(2), weight_slack=weight)
        apart.append(float(np.max(np.abs(printed.velocity - reduced.velocity))))
    assert apart[0] > 10 * apart[1] > 100 * apart[2]


def test_a_program_without_a_solution_stands_still_because_the_paper_has_no_second_rung() -> None:
    printed, reduced = both(far_away(), np.array([0.0, 2.55]), np.array([0.0, 2.6]), self_margin=0.5)
    assert printed.rung is Rung.HOLD and not printed.velocity.any() and printed.num_refused == 1
    assert reduced.rung is Rung.RELAXED


@pytest.mark.parametrize("solver", ["clarabel", "daqp"])
def test_the_seven_joint_arm_is_driven_alike_by_both_forms(plain_arm: Path, solver: str) -> None:
    arm, q = sample_arm(plain_arm), np.array([0.6, 0.3, 0, -1.8, 0, 2.1, 0.78])
    frame, ball = arm.frame_names[-1], Balls([[0.5, 0.9, 1.2]], [0.05])
    configs = [replace(config, solver=solver, posture_weight=0.1) for config in (PAPER, REDUCED)]
    printed, reduced = (
        QpIkController(arm, config, ball, frame=frame).step(q, arm.frame_pose(q + 0.3, frame)) for config in configs
    )
    np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-5)
    assert np.linalg.norm(printed.velocity) > 0.05

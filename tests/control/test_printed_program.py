"""The program as printed: it agrees with the reduced one where it must, and where it does not, by how much."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import DistanceField, Float64
from splatctrl_cli.robot.model import RobotModel
from tests.control.fakes import Balls, PlanarArm, Plane, far_away

REDUCED = ControlConfig(barrier_gain=1.0)
PAPER = ControlConfig(program="printed", barrier_gain=1.0)


def both(field: DistanceField, q: Float64, goal: Float64, **changes: float) -> tuple[object, ...]:
    """The printed and the reduced step from q towards the pose of another posture."""
    arm = PlanarArm()
    T = arm.frame_pose(goal, "tip")
    configs = [replace(config, **changes) for config in (PAPER, REDUCED)]  # type: ignore[arg-type]
    return tuple(QpIkController(arm, config, field, frame="tip").step(q, T) for config in configs)


def test_both_forms_agree_where_no_external_row_is_active() -> None:
    random, arm = np.random.default_rng(2), PlanarArm()
    for _ in range(25):
        q, goal = (random.uniform(-2.5, 2.5, 2) for _ in range(2))
        printed, reduced = both(far_away(), q, goal, self_margin=0.0)
        np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-6)
        assert printed.rung is reduced.rung is Rung.SOLVED and len(printed.velocity) == len(arm.joint_names)


def test_both_forms_agree_at_limits_and_at_self_collision_rows() -> None:
    arm = PlanarArm()
    printed, reduced = both(far_away(), arm.upper - 0.05, arm.upper + 0.6, max_angular_speed=3.0)
    assert any(row.kind is RowKind.LIMIT for row in printed.interventions)
    np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-6)
    folded = np.array([0.0, 2.45])
    printed, reduced = both(far_away(), folded, np.array([0.0, 2.6]), self_margin=0.21)
    assert [row.kind for row in printed.interventions if row.kind is RowKind.SELF]
    np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-6)


def test_the_squared_slack_alone_gives_way_where_the_exact_one_holds() -> None:
    wall, q = Plane([-1.0, 0.0, 0.0], -0.96), np.array([0.3, 0.3])
    printed, reduced = both(wall, q, np.zeros(2))
    assert reduced.rung is Rung.SOLVED and not reduced.relaxed
    assert printed.rung is Rung.RELAXED
    (row,) = [row for row in printed.interventions if row.kind is RowKind.SCENE]
    slack = {row.name: row.slack for row in printed.relaxed}
    assert slack[row.name] == pytest.approx(row.multiplier / (2 * PAPER.weight_slack), rel=1e-4)


def test_more_weight_on_the_printed_slack_comes_near_the_exact_one() -> None:
    wall, q = Plane([-1.0, 0.0, 0.0], -0.96), np.array([0.3, 0.3])
    apart = []
    for weight in (1e2, 1e4, 1e6):
        printed, reduced = both(wall, q, np.zeros(2), weight_slack=weight)
        apart.append(float(np.max(np.abs(printed.velocity - reduced.velocity))))
    assert apart[0] > 10 * apart[1] > 100 * apart[2]


def test_a_program_without_a_solution_stands_still_because_the_paper_has_no_second_rung() -> None:
    q = np.array([0.0, 2.55])
    printed, reduced = both(far_away(), q, np.array([0.0, 2.6]), self_margin=0.5)
    assert printed.rung is Rung.HOLD and not printed.velocity.any() and printed.num_refused == 1
    assert reduced.rung is Rung.RELAXED


@pytest.mark.parametrize("solver", ["clarabel", "daqp"])
def test_the_seven_joint_arm_is_driven_alike_by_both_forms(sample_data: Path, solver: str) -> None:
    arm = RobotModel.from_urdf(
        sample_data / "tabletop" / "robot.urdf", sample_data / "tabletop" / "robot_spheres.yaml"
    )
    frame, q = arm.frame_names[-1], np.array([0.6, 0.3, 0, -1.8, 0, 2.1, 0.78])
    T = arm.frame_pose(q + 0.3, frame)
    ball = Balls([[0.5, 0.9, 1.2]], [0.05])
    configs = [replace(config, solver=solver, posture_weight=0.1) for config in (PAPER, REDUCED)]
    printed, reduced = (QpIkController(arm, config, ball, frame=frame).step(q, T) for config in configs)
    np.testing.assert_allclose(printed.velocity, reduced.velocity, atol=1e-5)
    assert np.linalg.norm(printed.velocity) > 0.05

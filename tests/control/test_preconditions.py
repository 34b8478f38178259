"""What must hold before a controller runs, and what its parts may not let pass."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.preconditions import check_free, static_violations
from splatctrl_cli.control.replay import SceneChange
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.records import Float64
from tests.control.fakes import Balls, PlanarArm, ThinArm, scene_of

Q = np.array([0.0, 0.0])


class PartlyBlank:
    """Balls whose distance is not known at x < 0.3, where the spheres that come first are."""

    def __init__(self, balls: Balls) -> None:
        self._balls = balls

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance, gradient = self._balls.query(points)
        return np.where(points[:, 0] < 0.3, np.nan, distance), gradient


def test_a_sphere_without_a_distance_hides_no_sphere_that_collides() -> None:
    with pytest.raises(NotEvaluableError, match=r"got sphere fore\[1\] 0\.0800 m deep"):
        check_free(PlanarArm(), PartlyBlank(Balls([[0.9, 0.0, 0.0]], [0.04])), Q)


def test_the_deepest_sphere_is_named_and_a_free_start_passes() -> None:
    deep = Balls([[0.9, 0.0, 0.0], [0.25, 0.05, 0.0]], [0.1, 0.02])
    with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0\.1400 m deep"):
        check_free(PlanarArm(), deep, Q)
    check_free(PlanarArm(), Balls([[0.9, 0.2, 0.0]], [0.1]), Q)
    check_free(PlanarArm(), Balls([[0.0, 0.0, 0.0]], [0.1]), Q)  # in the base, which no joint moves


def test_only_spheres_that_no_joint_moves_are_static() -> None:
    arm, balls = PlanarArm(), Balls([[0.0, 0.1, 0.0]], [0.03])
    (violation,) = static_violations(arm, balls, Q, 0.02)
    assert (violation.sphere, violation.clearance) == ("base[0]", pytest.approx(0.01))
    assert static_violations(arm, balls, Q, 0.01 - 1e-9) == ()


def test_a_start_is_free_where_the_links_own_surface_is() -> None:
    for radius, is_free in ((0.07, True), (0.09, False)):  # 1 cm deep in a sphere and in its surface
        centers, radii = [[0.9, 0.1, 0.0]], [radius]
        balls, scene = Balls(centers, radii), scene_of(centers, radii)
        with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0\.0[13]00 m deep"):
            check_free(ThinArm(), balls, Q)
        if is_free:
            check_free(ThinArm(), balls, Q, scene)
            continue
        with pytest.raises(NotEvaluableError, match=r"sphere fore\[1\] 0\.0100 m deep"):
            check_free(ThinArm(), balls, Q, scene)


@pytest.mark.parametrize(
    ("before", "after", "is_hit"),
    [(0.1, -0.01, True), (0.0, -1e-6, True), (-0.01, -0.02, False), (0.1, 0.0, False), (-0.02, 0.01, False)],
)
def test_only_a_scene_that_newly_comes_into_the_arm_is_a_hit(before: float, after: float, is_hit: bool) -> None:
    assert SceneChange(stamp_ns=0, before=before, after=after).is_hit == is_hit


def broken_rows(distance: list[float], later: list[float]) -> list[bool]:
    """Of rows with a margin of 20 mm that promise not to lose anything."""
    num = len(distance)
    rows = SimpleNamespace(
        distance=np.array(distance), margin=np.full(num, 0.02), h=np.zeros(num), spread=lambda slack: np.zeros(num)
    )
    controller: Any = SimpleNamespace(_config=ControlConfig())
    choice: Any = SimpleNamespace(slack=np.zeros(num))
    return QpIkController._broken(controller, choice, rows, np.array(later)).tolist()  # type: ignore[arg-type]


def test_rows_within_their_margins_may_lose_to_one_another_but_excuse_no_other_row() -> None:
    assert broken_rows([0.010, 0.000], [0.009, 0.015]) == [False, False]  # together they gain
    assert broken_rows([0.010, 0.000], [0.001, 0.001]) == [True, False]  # together they lose
    assert broken_rows([0.010, 0.100, 0.000], [0.009, 0.050, 0.015]) == [
        True,
        True,
        False,
    ]  # one is beyond
    assert broken_rows([0.010, 0.100], [0.010, 0.100]) == [False, False]
    assert broken_rows([0.100], [float("nan")]) == [True]

"""The monitored standstill on the planar arm, beside a person who comes and goes."""

import numpy as np
import pytest

from splatctrl_cli.control.course import LoggedMotion
from splatctrl_cli.control.explain import runs_of
from splatctrl_cli.control.standstill import Separation, Zone, monitored_standstill, separation_of
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64
from tests.control.fakes import PlanarArm

START, END = np.array([0.0, 0.2]), np.array([0.8, 0.5])
ZONE = Zone(stop=0.3, resume=0.4)


def motion() -> LoggedMotion:
    share = np.linspace(0, 1, 11)[:, None]
    return LoggedMotion(
        stamp_ns=np.arange(11, dtype=np.int64) * 100_000_000,
        position=START + share * (END - START),
        velocity=np.tile(END - START, (11, 1)),
    )


def visit(first_s: float, last_s: float) -> Separation:
    """A run beside a person who stands 10 cm off the arm's tip between two times."""

    def people(points: Float64, stamp_ns: int) -> Float64:
        is_there = first_s <= stamp_ns * 1e-9 < last_s
        return np.full(len(points), 0.14 if is_there else np.inf)

    return monitored_standstill(PlanarArm(), motion(), people, ZONE, start_ns=0, period=0.01, max_wait=1.0)


def test_alone_the_arm_takes_the_logged_time() -> None:
    run = visit(9.0, 9.0)
    assert run.duration_s == pytest.approx(1.0) and run.is_complete and not run.is_stopped.any()
    np.testing.assert_allclose(run.position[-1], END)


def test_a_visit_delays_the_path_by_as_long_as_it_lasts() -> None:
    run = visit(0.3, 0.8)
    assert run.is_complete and run.duration_s == pytest.approx(1.5, abs=0.011)
    ((first, end),) = runs_of(run.is_stopped)
    assert run.stamp_ns[first] == 300_000_000 and end - first == 50
    held = run.position[first:end]
    assert np.all(held == held[0])
    assert run.distance.min() == pytest.approx(0.1)


def test_a_person_who_stays_ends_the_run_after_the_longest_wait() -> None:
    run = visit(0.5, 1e9)
    assert not run.is_complete and run.duration_s == pytest.approx(2.0, abs=0.03)


def test_the_zone_is_left_later_than_it_is_entered() -> None:
    def people(points: Float64, stamp_ns: int) -> Float64:
        return np.full(len(points), 0.04 + abs(stamp_ns * 1e-9 - 0.5))

    run = monitored_standstill(PlanarArm(), motion(), people, ZONE, start_ns=0, period=0.01, max_wait=1.0)
    ((first, end),) = runs_of(run.is_stopped)
    assert run.distance[first - 1] >= ZONE.stop > run.distance[first]
    assert run.distance[end - 1] < ZONE.resume <= run.distance[end] + 1e-9
    with pytest.raises(UsageError, match="zone: expected 0 < stop <= resume"):
        Zone(stop=0.4, resume=0.3)


def test_a_known_motion_is_measured_the_same_way() -> None:
    logged = motion()
    velocity = logged.velocity * (np.arange(11) > 2)[:, None]
    run = separation_of(
        PlanarArm(), logged.stamp_ns, logged.position, velocity, lambda points, _: points[:, 1] + 1.0,
        still=1e-3, is_complete=True,
    )  # fmt: skip
    assert run.is_stopped.sum() == 3 and run.duration_s == pytest.approx(1.0)
    arm = PlanarArm()
    expected = [np.min(arm.sphere_centers(q)[1:, 1] + 1.0 - 0.04) for q in logged.position]
    np.testing.assert_allclose(run.distance, expected)

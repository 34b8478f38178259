"""The monitored standstill on the planar arm, beside a person who comes and goes."""

import numpy as np
import pytest

from experiments.standstill import (
    ZONE_RESOLUTION,
    BoxZone,
    Separation,
    Standstill,
    Zone,
    is_anybody_in,
    monitored_standstill,
    remembered,
    separation_of,
)
from splatctrl_cli.control.columns import runs_of
from splatctrl_cli.control.goals import LoggedMotion
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Box, Float64
from tests.control.fakes import PlanarArm
from tests.refused import expect_refusal

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
    assert (run.stamp_ns[first], end - first) == (300_000_000, 50)
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
    expect_refusal("zone: expected 0 < stop <= resume", Zone, stop=0.4, resume=0.3, error=UsageError)


def test_a_known_motion_is_measured_the_same_way() -> None:
    logged = motion()
    velocity = logged.velocity * (np.arange(11) > 2)[:, None]
    run = separation_of(
        PlanarArm(), logged.stamp_ns, logged.position, velocity, lambda points, _: points[:, 1] + 1.0,
        still=1e-3, is_complete=True,
    )  # fmt: skip
    assert (run.is_stopped.sum(), run.duration_s) == (3, pytest.approx(1.0))
    arm = PlanarArm()
    expected = [np.min(arm.sphere_centers(q)[1:, 1] + 1.0 - 0.04) for q in logged.position]
    np.testing.assert_allclose(run.distance, expected)


def braked(first_s: float, last_s: float, max_acceleration: float = 4.0) -> Standstill:
    """The same visit to a path with a bend, beside which the arm has to brake."""
    stamps = np.array([0, 300, 500, 1000], dtype=np.int64) * 1_000_000
    corners = np.array([[0.0, 0.2], [0.3, 0.2], [0.4, 0.5], [0.8, 0.5]])
    bent = LoggedMotion(stamp_ns=stamps, position=corners, velocity=np.zeros((4, 2)))

    def people(points: Float64, stamp_ns: int) -> Float64:
        return np.full(len(points), 0.14 if first_s <= stamp_ns * 1e-9 < last_s else np.inf)

    return monitored_standstill(
        PlanarArm(), bent, people, ZONE, start_ns=0, period=0.01, max_wait=1.0, max_acceleration=max_acceleration
    )


def test_braking_stays_on_the_path_and_within_the_acceleration() -> None:
    run = braked(0.25, 1.4)
    fastest, corners = 1.5, np.array([0.0, 0.3, 0.5, 1.0])  # [rad/s] of the second joint between 0.3 and 0.5 s
    along = [np.interp(run.path_s, corners, joint) for joint in ([0.0, 0.3, 0.4, 0.8], [0.2, 0.2, 0.5, 0.5])]
    np.testing.assert_allclose(run.position, np.column_stack(along), atol=1e-8)
    change = np.abs(np.diff(run.path_speed)) / 0.01
    assert change.max() == pytest.approx(4.0 / fastest)
    np.testing.assert_allclose(np.diff(run.path_s), 0.01 * run.path_speed[:-1], atol=1e-12)
    assert (run.path_speed.min(), run.path_speed.max()) == (0.0, 1.0)
    num_braking = np.count_nonzero((run.path_speed > 0) & (run.path_speed < 1))
    assert num_braking == pytest.approx(2 * fastest / 4.0 / 0.01, abs=3)


def test_a_path_that_brakes_goes_on_from_where_it_was_held_and_loses_the_visit() -> None:
    run = braked(0.25, 1.4)
    held = run.position[run.is_stopped]
    assert len(held) > 50 and np.all(held == held[0])
    assert run.is_complete and np.all(np.diff(run.path_s) >= 0)
    np.testing.assert_allclose(run.position[-1], [0.8, 0.5], atol=1e-9)
    assert run.duration_s == pytest.approx(1.0 + 1.15, abs=0.02)


def test_a_glance_slows_the_path_without_a_stop() -> None:
    run = braked(0.25, 0.35)
    assert not run.is_stopped.any() and run.path_speed.min() < 0.8
    assert run.duration_s > 1.02
    at_once = braked(0.25, 0.35, max_acceleration=0.0)
    assert (at_once.is_stopped.sum(), set(at_once.path_speed)) == (10, {0.0, 1.0})


def test_an_arm_that_starts_beside_a_person_stands() -> None:
    run = braked(-1.0, 0.5)
    assert run.path_speed[0] == 0.0 and run.is_stopped[:50].all()
    assert run.duration_s == pytest.approx(1.5 + 1.5 / 4.0 / 2, abs=0.02)


BOX = Box(lower=np.array([0.2, -0.3, 0.0]), upper=np.array([0.9, 0.5, 0.4]))


def test_a_person_is_in_a_box_where_a_ball_reaches_into_it() -> None:
    rng = np.random.default_rng(0)
    answers = []
    for middle, radius in zip(rng.uniform(-0.6, 1.4, (300, 3)), rng.uniform(0.02, 0.5, 300), strict=True):
        gap = np.linalg.norm(middle - np.clip(middle, BOX.lower, BOX.upper)) - radius
        if not 0 < gap < ZONE_RESOLUTION:
            found = is_anybody_in(BOX, lambda p, _, m=middle, r=radius: np.linalg.norm(p - m, axis=1) - r, 0)  # type: ignore[misc]
            assert found == (gap <= 0), (middle, radius)
            answers.append(found)
    assert 30 < sum(answers) < len(answers) - 30
    assert not is_anybody_in(BOX, lambda points, _: np.full(len(points), np.inf), 0)


def test_the_box_is_left_later_than_it_is_entered_wherever_the_arm_is() -> None:
    def people(points: Float64, stamp_ns: int) -> Float64:
        """A ball of 10 cm that goes up to the box at 1 m/s, 10 cm into it, and back."""
        depth = 0.1 - abs(stamp_ns * 1e-9 - 0.4)
        return np.linalg.norm(points - np.array([0.1 + depth, 0.1, 0.2]), axis=1) - 0.1

    zone = BoxZone(box=BOX, hysteresis=0.06)
    run = monitored_standstill(PlanarArm(), motion(), people, zone, start_ns=0, period=0.01, max_wait=1.0)
    ((first, end),) = runs_of(run.is_stopped)
    assert run.stamp_ns[first] * 1e-9 == pytest.approx(0.3, abs=0.011)
    assert run.stamp_ns[end] * 1e-9 == pytest.approx(0.5 + 0.06, abs=0.011)
    assert run.is_complete
    expect_refusal("hysteresis of 0 or more", BoxZone, box=BOX, hysteresis=-0.1, error=UsageError)


def test_people_of_the_last_map_hold_the_path_no_longer_than_they_are_remembered() -> None:
    def people(points: Float64, _: int) -> Float64:
        return np.full(len(points), 0.14)

    def run(memory: float) -> Standstill:
        seen = remembered(people, lambda stamp_ns: stamp_ns * 1e-9 - 0.5, memory)  # the last map is of 0.5 s
        return monitored_standstill(PlanarArm(), motion(), seen, ZONE, start_ns=0, period=0.01, max_wait=30.0)

    assert run(2.0).is_complete and run(2.0).duration_s == pytest.approx(2.5 + 1.0, abs=0.02)
    assert not run(99.0).is_complete


def test_people_of_a_map_without_a_time_stay() -> None:
    people = remembered(lambda points, _: np.full(len(points), 0.14), lambda _: float("nan"), 1.0)
    assert people(np.zeros((2, 3)), 9_000_000_000).tolist() == [0.14, 0.14]

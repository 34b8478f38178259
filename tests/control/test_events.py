"""The audit of logged states against known distances, and its events: intervals, their worst values and names."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import DistanceFunction, audit, observed_at
from splatctrl_cli.control.events import (
    UNREPRESENTED,
    Event,
    EventKind,
    Obstacle,
    Signal,
    audit_signals,
    events_of,
    first_intervention,
    stale_signal,
    step_signals,
)
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.step import ControlStep, Intervention, QpIkController, RowSlack
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import DistanceField, Float64
from tests.control.fakes import Balls, PlanarArm, Plane, far_away


def known(**fields: DistanceField) -> Mapping[str, DistanceFunction]:
    return {name: lambda points, field=field: field.query(points)[0] for name, field in fields.items()}


MANY = np.arange(600, dtype=np.int64)


def test_the_clearance_is_that_of_the_nearest_moving_sphere() -> None:
    walls = known(exact=Plane([-1.0, 0, 0], -1.2), half=Plane([-1.0, 0, 0], -1.2, 0.5))
    trace = audit(PlanarArm(), MANY[[0, 5]], np.array([[0.0, 0.0], [np.pi / 2, 0.0]]), lambda _: walls)
    np.testing.assert_allclose(trace.clearance["exact"].distance, [1.2 - 0.9 - 0.04, 1.2 - 0.04])
    np.testing.assert_allclose(trace.clearance["half"].distance[0], 0.5 * 0.3 - 0.04)
    assert trace.clearance["exact"].sphere[0] == 4


def test_a_sphere_that_no_joint_moves_does_not_count() -> None:
    trace = audit(PlanarArm(), MANY[:1], np.zeros((1, 2)), lambda _: known(exact=Balls([[0.0, 0, 0]], [0.01])))
    assert trace.clearance["exact"].distance[0] == pytest.approx(0.25 - 0.01 - 0.04)


def test_each_state_is_measured_in_the_scene_known_at_its_stamp() -> None:
    before = known(exact=Plane([-1.0, 0, 0], -2.0))
    after = known(exact=Plane([-1.0, 0, 0], -1.5))
    trace = audit(PlanarArm(), MANY, np.zeros((600, 2)), lambda stamp: before if stamp < 300 else after)
    np.testing.assert_allclose(trace.clearance["exact"].distance[:300], 1.06)
    np.testing.assert_allclose(trace.clearance["exact"].distance[300:], 0.56)


def test_states_of_one_scene_share_a_query() -> None:
    ball = far_away()
    scene = known(exact=ball)
    audit(PlanarArm(), MANY[:200], np.tile([0.0, 0.1], (200, 1)), lambda _: scene)
    assert ball.num_queries == 1


def test_a_field_without_a_distance_gives_nan_and_not_a_guess() -> None:
    def half_known(points: Float64) -> Float64:
        return np.where(points[:, 0] > 0.8, np.nan, 1.0)

    trace = audit(PlanarArm(), MANY[:2], np.array([[0.0, 0.0], [np.pi, 0.0]]), lambda _: {"grid": half_known})
    assert np.isnan(trace.clearance["grid"].distance[0])
    assert trace.clearance["grid"].distance[1] == pytest.approx(0.96)


def test_limits_self_clearance_and_unknown_space_are_reported() -> None:
    trace = audit(
        PlanarArm(),
        MANY[:2],
        np.array([[2.8, 0.0], [0.0, -2.7]]),
        lambda _: known(exact=far_away()),
        observed=lambda points: (points[:, 0] < 0.3).astype(np.uint8),
    )
    np.testing.assert_allclose(trace.limit_margin, [0.1, -0.1])
    assert trace.limit_joint.tolist() == [0, 1]
    assert trace.self_clearance[1] == pytest.approx(
        np.linalg.norm([0.5 + 0.4 * np.cos(2.7), 0.4 * np.sin(2.7)]) - 0.1
    )
    np.testing.assert_allclose(trace.unknown_share, [0.0, 0.5])


def test_a_point_takes_the_word_of_its_nearest_voxel() -> None:
    seen = np.arange(8, dtype=np.uint8).reshape(2, 2, 2)
    observed = partial(observed_at, seen, np.array([1.0, 1, 1]), 0.1)
    points = np.array([[1.0, 1, 1], [1.04, 1.06, 1.0], [1.1, 1.1, 1.149], [1.1, 1.1, 1.151], [0.9, 1, 1]])
    assert observed(points).tolist() == [0, 2, 7, 0, 0]


STAMPS = np.arange(6, dtype=np.int64) * 100_000_000


def step(**changes: object) -> ControlStep:
    arm = PlanarArm()
    controller = QpIkController(arm, ControlConfig(), far_away(), frame="tip")
    plain = controller.step(np.array([0.3, 0.6]), arm.frame_pose(np.array([0.5, 0.4]), "tip"))
    return replace(plain, **changes)  # type: ignore[arg-type]


def row(name: str, kind: RowKind, multiplier: float) -> Intervention:
    return Intervention(name=name, kind=kind, multiplier=multiplier)


def test_an_event_has_the_worst_value_of_its_run_and_every_name_in_order() -> None:
    signal = Signal(
        kind=EventKind.SCENE,
        is_on=np.array([False, True, True, True, False, True]),
        value=np.array([9.0, 1, 3, 2, 9, 5]),
        names_at=lambda i: ["a", "b"] if i == 3 else ["b"],
    )
    first, second = events_of(STAMPS, [signal])
    assert (first.start_s, first.end_s, first.num_states) == (pytest.approx(0.1), pytest.approx(0.3), 3)
    assert (first.worst, first.worst_s, first.state) == (3.0, pytest.approx(0.2), 2)
    assert first.names == ("b", "a") and first.num_names == 2 and first.worst_name == "b"
    assert second.first_ns == second.last_ns == 500_000_000 and second.worst == 5.0
    (low,) = events_of(STAMPS, [replace(signal, is_on=signal.value < 4, is_high_worse=False)])
    assert low.worst == 1.0


def test_many_names_are_counted_and_not_all_listed() -> None:
    signal = Signal(
        kind=EventKind.SELF,
        is_on=np.ones(6, np.bool_),
        value=np.ones(6),
        names_at=lambda i: [f"{i}{j}" for j in "abcd"],
    )
    (event,) = events_of(STAMPS, [signal])
    assert len(event.names) == 12 and event.num_names == 24


def test_a_clearance_below_the_margin_names_its_sphere_and_a_collision_lies_within_it() -> None:
    ball, arm = Balls([[0.9, 0.25, 0.0]], [0.1]), PlanarArm()
    positions = np.array([[angle, 0.0] for angle in (-1.0, 0.05, 0.15, 0.25, 0.5, 3.0)])
    trace = audit(arm, STAMPS, positions, lambda _: {"exact": lambda points: ball.query(points)[0]})
    names = ("base[0]", "upper[0]", "upper[1]", "fore[0]", "fore[1]")
    found = {e.kind: e for e in events_of(trace.stamp_ns, audit_signals(trace, 0.08, names, arm.joint_names))}
    below, collision, outside = (
        found[k] for k in (EventKind.BELOW_MARGIN, EventKind.IN_COLLISION, EventKind.OUTSIDE_LIMITS)
    )
    assert below.first_ns <= collision.first_ns <= collision.last_ns <= below.last_ns
    assert below.worst == collision.worst == pytest.approx(trace.clearance["exact"].distance.min())
    assert "fore[1]" in below.names and below.source == "exact" and collision.worst_s == pytest.approx(0.3)
    assert outside.names == ("shoulder",) and outside.worst == pytest.approx(-0.1)
    assert EventKind.UNKNOWN_SPACE not in found and EventKind.WITHOUT_DISTANCE not in found


def test_a_state_without_a_distance_is_an_event_and_not_below_the_margin() -> None:
    trace = audit(
        PlanarArm(),
        STAMPS,
        np.full((len(STAMPS), 2), 0.1),
        lambda _: {"exact": lambda points: np.full(len(points), np.nan)},
    )
    names = ("base[0]", "upper[0]", "upper[1]", "fore[0]", "fore[1]")
    (event,) = events_of(trace.stamp_ns, audit_signals(trace, 0.02, names, ("shoulder", "elbow")))
    assert event.kind is EventKind.WITHOUT_DISTANCE and event.num_states == 6


def test_steps_become_events_by_what_shaped_them() -> None:
    steps = [
        step(),
        step(interventions=(row("fore[1]", RowKind.SCENE, 0.5), row("elbow highest", RowKind.LIMIT, 0.1))),
        step(interventions=(row("upper[1]", RowKind.SCENE, 0.5), row("fore[1]", RowKind.SCENE, 3.0))),
        step(interventions=(row("fore[1]", RowKind.SCENE, 2.5),), scale=0.5),
        step(rung=Rung.RELAXED, relaxed=(RowSlack(name="fore[1]", slack=0.03),)),
        step(rung=Rung.HOLD, scale=0.0),
    ]
    found = {event.kind: event for event in events_of(STAMPS, step_signals(steps))}
    assert set(found) == {
        EventKind.SCENE, EventKind.LIMIT, EventKind.SCALED_BACK, EventKind.RELAXED, EventKind.HOLD
    }  # fmt: skip
    assert found[EventKind.SCENE].names == ("fore[1]", "upper[1]") and found[EventKind.SCENE].worst == 3.0
    assert found[EventKind.SCENE].worst_name == "fore[1]"
    assert found[EventKind.LIMIT].names == ("elbow highest",) and found[EventKind.SCALED_BACK].worst == 0.5
    assert found[EventKind.RELAXED].worst == 0.03 and found[EventKind.HOLD].first_ns == 500_000_000
    assert not events_of(STAMPS, step_signals([None] * 6))


def test_the_first_intervention_is_the_controllers_and_not_the_motions() -> None:
    signals = [
        Signal(kind=EventKind.BELOW_MARGIN, is_on=np.arange(6) < 2, value=np.zeros(6), names_at=lambda _: ["a"]),
        Signal(kind=EventKind.LIMIT, is_on=np.arange(6) > 3, value=np.ones(6), names_at=lambda _: ["elbow highest"]),
    ]
    first = first_intervention(events_of(STAMPS, signals))
    assert isinstance(first, Event) and first.kind is EventKind.LIMIT
    assert first_intervention(events_of(STAMPS, signals[:1])) is None


def test_a_map_is_stale_where_it_is_older_than_allowed() -> None:
    age = np.array([np.nan, 0.1, 0.6, 1.2, 0.0, 0.4])
    (event,) = events_of(STAMPS, [stale_signal(age, 0.5)])
    assert (event.kind, event.num_states, event.worst) == (EventKind.STALE_MAP, 2, 1.2)


def test_an_obstacle_says_what_and_where() -> None:
    assert str(Obstacle(distance=0.1, position=(1, 0, 0.5), splat=7, label="human")) == (
        "human splat 7 at (1.000, 0.000, 0.500)"
    )
    assert str(Obstacle(distance=0.1, position=(1, 0, 0.5), cell=(1, 2, 3))).startswith("cell (1, 2, 3) at")
    said = str(Obstacle(distance=0.1, position=(1, 0, 0.5), label=UNREPRESENTED))
    assert said == "unrepresented voxel at (1.000, 0.000, 0.500)"


def test_a_row_that_no_joint_changes_is_an_event_of_its_own_distance() -> None:
    held = step(violated_fixed=("upper[0]",), fixed_distance=-0.02, clearance=0.4)
    (event,) = [event for event in events_of(STAMPS[:2], step_signals([step(), held])) if event.kind == "cannot-act"]
    assert event.kind is EventKind.CANNOT_ACT and event.worst == -0.02
    assert (event.state, event.names) == (1, ("upper[0]",))

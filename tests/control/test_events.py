"""The audit of logged states against known distances, and its events: intervals, their worst values and names."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.audit import AuditTrace, DistanceFunction, audit, observed_at
from splatctrl_cli.control.columns import (
    UNREPRESENTED,
    Event,
    EventKind,
    Obstacle,
    Signal,
    audit_columns,
    audit_signals,
    events_of,
    first_intervention,
    motion_signals,
    step_columns,
    step_signals,
)
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.step import ControlStep, Intervention, QpIkController, RowSlack
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import DistanceField
from tests.control.fakes import Balls, Nowhere, PlanarArm, Plane, far_away


def known(**fields: DistanceField) -> Mapping[str, DistanceFunction]:
    return {name: lambda points, field=field: field.query(points)[0] for name, field in fields.items()}


def wall(x: float, scale: float = 1.0) -> Plane:
    """Free where x is less."""
    return Plane([-1.0, 0, 0], -x, scale)


NAMES = ("base[0]", "upper[0]", "upper[1]", "fore[0]", "fore[1]")
JOINTS, PAIRS = ("shoulder", "elbow"), ("base and fore", "base and tip", "upper and tip")


MANY = np.arange(600, dtype=np.int64)


def test_the_clearance_is_that_of_the_nearest_moving_sphere() -> None:
    scene = known(exact=wall(1.2), half=wall(1.2, 0.5), base=Balls([[0.0, 0, 0]], [0.01]))
    trace = audit(PlanarArm(), MANY[[0, 5]], np.array([[0.0, 0.0], [np.pi / 2, 0.0]]), lambda _: scene)
    np.testing.assert_allclose(trace.clearance["exact"].distance, [1.2 - 0.9 - 0.04, 1.2 - 0.04])
    np.testing.assert_allclose(trace.clearance["half"].distance[0], 0.5 * 0.3 - 0.04)
    assert trace.clearance["exact"].sphere[0] == 4
    assert trace.clearance["base"].distance[0] == pytest.approx(0.25 - 0.01 - 0.04)  # no joint moves the base's


def test_each_state_is_measured_in_the_scene_known_at_its_stamp() -> None:
    scenes = known(exact=wall(2.0)), known(exact=wall(1.5))
    trace = audit(PlanarArm(), MANY, np.zeros((600, 2)), lambda stamp: scenes[stamp >= 300])
    np.testing.assert_allclose(trace.clearance["exact"].distance, np.repeat([1.06, 0.56], 300))


def test_states_of_one_scene_share_a_query() -> None:
    scene = known(exact=(ball := far_away()))
    audit(PlanarArm(), MANY[:200], np.tile([0.0, 0.1], (200, 1)), lambda _: scene)
    assert ball.num_queries == 1


def test_a_field_without_a_distance_gives_nan_and_not_a_guess() -> None:
    grid = {"grid": lambda points: np.where(points[:, 0] > 0.8, np.nan, 1.0)}
    trace = audit(PlanarArm(), MANY[:2], np.array([[0.0, 0.0], [np.pi, 0.0]]), lambda _: grid)
    np.testing.assert_allclose(trace.clearance["grid"].distance, [np.nan, 0.96])


def test_limits_self_clearance_and_unknown_space_are_reported() -> None:
    states, scene = np.array([[2.8, 0.0], [0.0, -2.7]]), known(exact=far_away())
    trace = audit(
        PlanarArm(), MANY[:2], states, lambda _: scene, observed=lambda points: (points[:, 0] < 0.3).astype(np.uint8)
    )
    np.testing.assert_allclose(trace.limit_margin, [0.1, -0.1])
    assert trace.limit_joint.tolist() == [0, 1]
    tip = [0.5 + 0.4 * np.cos(2.7), 0.4 * np.sin(2.7)]
    assert trace.self_clearance[1] == pytest.approx(np.linalg.norm(tip) - 0.1)
    np.testing.assert_allclose(trace.unknown_share, [0.0, 0.5])


def test_a_point_takes_the_word_of_its_nearest_voxel() -> None:
    seen = np.arange(8, dtype=np.uint8).reshape(2, 2, 2)
    points = np.array([[1.0, 1, 1], [1.04, 1.06, 1.0], [1.1, 1.1, 1.149], [1.1, 1.1, 1.151], [0.9, 1, 1]])
    assert observed_at(seen, np.array([1.0, 1, 1]), 0.1, points).tolist() == [0, 2, 7, 0, 0]


STAMPS = np.arange(6, dtype=np.int64) * 100_000_000


def step(**changes: object) -> ControlStep:
    arm = PlanarArm()
    controller = QpIkController(arm, ControlConfig(), far_away(), frame="tip")
    plain = controller.step(np.array([0.3, 0.6]), arm.frame_pose(np.array([0.5, 0.4]), "tip"))
    return replace(plain, **changes)  # type: ignore[arg-type]


def row(name: str, kind: RowKind, multiplier: float) -> Intervention:
    return Intervention(name=name, kind=kind, multiplier=multiplier)


def signal(kind: EventKind, is_on: ArrayLike, value: ArrayLike, *names: str) -> Signal:
    on = np.asarray(is_on, np.bool_)
    return Signal(kind=kind, is_on=on, value=np.broadcast_to(value, len(on)), who=[names] * len(on))


def audit_events(trace: AuditTrace, margin: float) -> tuple[Event, ...]:
    columns = audit_columns(trace, NAMES, JOINTS, PAIRS)
    return events_of(trace.stamp_ns, audit_signals(columns, [*trace.clearance], margin))


def test_an_event_has_the_worst_value_of_its_run_and_every_name_in_order() -> None:
    """Many names are counted, and not all listed."""
    given = signal(EventKind.SCENE, [0, 1, 1, 1, 0, 1], [9.0, 1, 3, 2, 9, 5])
    first, second = events_of(STAMPS, [replace(given, who=[("a", "b") if i == 3 else "b" for i in range(6)])])
    assert (first.start_s, first.end_s, first.num_states) == (pytest.approx(0.1), pytest.approx(0.3), 3)
    assert (first.worst, first.worst_s, first.state) == (3.0, pytest.approx(0.2), 2)
    assert first.names == ("b", "a") and first.num_names == 2 and first.worst_name == "b"
    assert second.first_ns == second.last_ns == 500_000_000 and second.worst == 5.0
    many = replace(
        given, is_on=given.value < 4, is_high_worse=False, who=[tuple(f"{i}{j}" for j in "abcde") for i in range(6)]
    )
    (low,) = events_of(STAMPS, [many])
    assert (low.worst, len(low.names), low.num_names) == (1.0, 12, 15)


def test_a_clearance_below_the_margin_names_its_sphere_and_a_collision_lies_within_it() -> None:
    scene, arm = known(exact=Balls([[0.9, 0.25, 0.0]], [0.1])), PlanarArm()
    positions = np.array([[angle, 0.0] for angle in (-1.0, 0.05, 0.15, 0.25, 0.5, 3.0)])
    trace = audit(arm, STAMPS, positions, lambda _: scene)
    found = {
        e.kind: e
        for e in events_of(trace.stamp_ns, audit_signals(audit_columns(trace, NAMES, JOINTS, PAIRS), ["exact"], 0.08))
    }
    below, collision = found.pop(EventKind.BELOW_MARGIN), found.pop(EventKind.IN_COLLISION)
    (outside,) = found.values()
    assert below.first_ns <= collision.first_ns <= collision.last_ns <= below.last_ns
    assert below.worst == collision.worst == pytest.approx(trace.clearance["exact"].distance.min())
    assert "fore[1]" in below.names and below.source == "exact" and collision.worst_s == pytest.approx(0.3)
    assert (outside.kind, outside.names, outside.worst) == ("outside-limits", ("shoulder",), pytest.approx(-0.1))


def test_a_state_without_a_distance_is_an_event_and_not_below_the_margin() -> None:
    trace = audit(PlanarArm(), STAMPS, np.full((6, 2), 0.1), lambda _: known(exact=Nowhere()))
    (event,) = audit_events(trace, 0.02)
    assert event.kind is EventKind.WITHOUT_DISTANCE and event.num_states == 6


def test_steps_become_events_by_what_shaped_them() -> None:
    steps = [
        step(),
        step(interventions=(row("fore[1]", RowKind.SCENE, 0.5), row("elbow highest", RowKind.LIMIT, 0.1))),
        step(interventions=(row("upper[1]", RowKind.SCENE, 0.5), row("fore[1]", RowKind.SCENE, 3.0))),
        step(interventions=(row("fore[1]", RowKind.SCENE, 2.5),), scale=0.5),
        step(rung=Rung.RELAXED, relaxed=(RowSlack(name="fore[1]", slack=0.03, is_near=True),)),
        step(rung=Rung.HOLD, scale=0.0, violated_fixed=("upper[0]",), fixed_distance=-0.02, clearance=0.4),
    ]
    found = {event.kind: event for event in events_of(STAMPS, step_signals(step_columns(steps, 2)))}
    assert found.pop(EventKind.HOLD).first_ns == 500_000_000
    assert {kind: (event.worst, event.state) for kind, event in found.items()} == {
        EventKind.SCENE: (3.0, 2),
        EventKind.LIMIT: (0.1, 1),
        EventKind.SCALED_BACK: (0.5, 3),
        EventKind.RELAXED: (0.03, 4),
        EventKind.CANNOT_ACT: (-0.02, 5),
    }
    assert found[EventKind.SCENE].names == ("fore[1]", "upper[1]")
    assert found[EventKind.LIMIT].names == ("elbow highest",) and found[EventKind.CANNOT_ACT].names == ("upper[0]",)
    assert found[EventKind.SCENE].worst_name == "fore[1]"
    assert not events_of(STAMPS, step_signals(step_columns([None] * 6, 2)))


def test_the_first_intervention_is_the_controllers_and_not_the_motions() -> None:
    below = signal(EventKind.BELOW_MARGIN, np.arange(6) < 2, 0.0, "a")
    limit = signal(EventKind.LIMIT, np.arange(6) > 3, 1.0, "elbow highest")
    first = first_intervention(events_of(STAMPS, [below, limit]))
    assert isinstance(first, Event) and first.kind is EventKind.LIMIT
    assert first_intervention(events_of(STAMPS, [below])) is None


def test_a_map_is_stale_where_it_is_older_than_allowed() -> None:
    age = np.array([np.nan, 0.1, 0.6, 1.2, 0.0, 0.4])
    never = dict.fromkeys(("velocity_share", "acceleration_share", "unbounded_s"), np.zeros(6))
    nowhere = {"velocity_joint": [""] * 6, "acceleration_joint": [""] * 6, "clearance_between": np.full(6, np.nan)}
    (event,) = events_of(STAMPS, motion_signals({**never, **nowhere, "map_age_s": age}, 0.02, 0.5))
    assert (event.kind, event.num_states, event.worst) == (EventKind.STALE_MAP, 2, 1.2)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"splat": 7, "label": "human"}, "human splat 7 at (1.000, 0.000, 0.500)"),
        ({"cell": (1, 2, 3)}, "cell (1, 2, 3) at (1.000, 0.000, 0.500)"),
        ({"label": UNREPRESENTED}, "unrepresented voxel at (1.000, 0.000, 0.500)"),
    ],
)
def test_an_obstacle_says_what_and_where(more: dict[str, Any], words: str) -> None:
    assert str(Obstacle(distance=0.1, position=(1, 0, 0.5), **more)) == words

"""Columns of a trace, from states and a controller's steps, and the events in them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any

import numpy as np

from splatctrl_cli.control.audit import AuditTrace
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import Bool, Float64, Index, Stamps

NamedColumns = Mapping[str, Any]
"""Columns by name: arrays (T, ...), NaN for no value; or T words, or tuples of words, empty for no value."""

RUNGS = tuple(Rung)


def names_at(names: Sequence[str], index: Index) -> list[str]:
    """Names (T,) by index (T,); empty for -1."""
    return [names[i] if i >= 0 else "" for i in index.tolist()]


def audit_columns(
    part: AuditTrace, spheres: Sequence[str], joints: Sequence[str], pairs: Sequence[str]
) -> NamedColumns:
    """Columns of audited states; q: position (T, J); is_blank: True where any field has no distance."""
    blank = np.any([np.isnan(nearest.distance) for nearest in part.clearance.values()], axis=0)
    columns: dict[str, Any] = {"stamp_ns": part.stamp_ns, "q": part.position, "is_blank": blank}
    for field, nearest in part.clearance.items():
        columns[f"clearance_{field}"] = nearest.distance
        columns[f"nearest_{field}"] = names_at(spheres, nearest.sphere)
    return columns | {
        "self_clearance": part.self_clearance,
        "self_pair": names_at(pairs, part.self_pair),
        "limit_margin": part.limit_margin,
        "limit_joint": names_at(joints, part.limit_joint),
        "unknown_share": part.unknown_share,
    }


def is_shaped(step: ControlStep | None, kind: RowKind | None = None) -> bool:
    """True if a row (of a kind) shapes the command.

    Without a kind, any fallback or scaling counts, too. False for external controllers.
    """
    if step is None or step.rung is Rung.OUTSIDE:
        return False
    if kind is not None:
        return any(row.kind is kind for row in step.interventions)
    return bool(step.interventions) or step.scale < 1 or step.rung is not Rung.SOLVED


def step_columns(steps: Sequence[ControlStep | None], num_joints: int) -> NamedColumns:
    """Columns of a controller's steps; None is a state without a step.

    v (T, J) [rad/s]: velocity. rung_number: index in RUNGS. position_error [m], rotation_error [rad]. shaped:
    `is_shaped`, NaN for an external controller. multiplier_*: largest of a kind. who_*: rows, by falling multiplier;
    who_relaxed: by falling slack.
    """

    def number(value: Callable[[ControlStep], float]) -> Float64:
        return np.array([np.nan if step is None else value(step) for step in steps], dtype=np.float64)

    def words(value: Callable[[ControlStep], Any]) -> list[Any]:
        return ["" if step is None else value(step) for step in steps]

    def shaped(step: ControlStep, kind: RowKind | None = None) -> float:
        return np.nan if step.rung is Rung.OUTSIDE else float(is_shaped(step, kind))

    blank = np.full(num_joints, np.nan)
    columns = {
        "v": np.array([blank if step is None else step.velocity for step in steps]),
        "barrier_clearance": number(lambda step: step.clearance),
        "barrier_nearest": words(lambda step: step.nearest),
        "rung": words(lambda step: str(step.rung)),
        "rung_number": number(lambda step: RUNGS.index(step.rung)),
        "scale": number(lambda step: step.scale),
        "slack": number(lambda step: max((row.slack for row in step.relaxed), default=0.0)),
        "relaxed_near": number(lambda step: any(row.is_near for row in step.relaxed)),
        "relaxed": words(lambda step: " ".join(row.name for row in step.relaxed)),
        "who_relaxed": words(
            lambda step: tuple(row.name for row in sorted(step.relaxed, key=lambda row: -row.slack))
        ),
        "intervening": words(lambda step: "; ".join(step.intervening)),
        "multipliers": words(lambda step: "; ".join(f"{row.multiplier:.4g}" for row in step.interventions)),
        "num_rows": words(lambda step: step.num_rows),
        "num_refused": number(lambda step: step.num_refused),
        "residual": number(lambda step: step.residual),
        "position_error": number(lambda step: float(np.linalg.norm(step.pose_error[:3]))),
        "rotation_error": number(lambda step: float(np.linalg.norm(step.pose_error[3:]))),
        "fixed_distance": number(lambda step: step.fixed_distance),
        "who_fixed": words(lambda step: step.violated_fixed),
        "shaped": number(shaped),
    }
    for kind in RowKind:
        own = [[] if step is None else [row for row in step.interventions if row.kind is kind] for step in steps]
        columns[f"shaped_{kind}"] = number(partial(shaped, kind=kind))
        columns[f"multiplier_{kind}"] = np.array([max((row.multiplier for row in rows), default=0.0) for rows in own])
        columns[f"who_{kind}"] = [
            tuple(row.name for row in sorted(rows, key=lambda row: -row.multiplier)) for rows in own
        ]
    return columns


UNREPRESENTED = "unrepresented voxel"  # label of an occupied voxel without a splat
MAX_NAMES = 12  # listed per event; num_names counts all


class EventKind(StrEnum):
    """Kind of an event; the comment describes its worst value."""

    BELOW_MARGIN = "below-margin"  # least clearance [m]
    IN_COLLISION = "in-collision"  # least clearance [m]
    WITHOUT_DISTANCE = "without-distance"  # number of fields without a distance
    UNKNOWN_SPACE = "unknown-space"  # largest share of sphere centres
    BETWEEN_STATES = "between-states"  # least bound [m] of the clearance since the state before
    NOT_BOUNDED = "not-bounded"  # longest time [s] without a bound on the arm's place
    SELF_COLLISION = "self-collision"  # least distance of two spheres of the arm [m]
    OUTSIDE_LIMITS = "outside-limits"  # least distance to the limit, negative [rad]
    TOO_FAST = "too-fast"  # largest velocity, as a share of its limit
    TOO_SUDDEN = "too-sudden"  # largest acceleration, as a share of its limit
    STALE_MAP = "stale-map"  # oldest scene [s]
    SCENE = "scene"  # largest multiplier of a row against the scene
    SELF = "self"  # likewise, of a self-collision row
    LIMIT = "limit"  # likewise, of a joint's position or velocity limit
    RELAXED = "relaxed"  # largest slack [m/s]
    MINIMUM_VIOLATION = "minimum-violation"  # largest residual
    HOLD = "hold"  # least barrier clearance [m]
    SCALED_BACK = "scaled-back"  # least scale
    ROW_BROKEN = "row-broken"  # largest excess over a barrier row by an external controller [m/s]
    CANNOT_ACT = "cannot-act"  # least distance [m] of a violated row that no joint moves


UNITS = {  # of a kind's worst value, if it has one
    **dict.fromkeys(("below-margin", "in-collision", "between-states", "self-collision", "hold", "cannot-act"), "m"),
    **{"outside-limits": "rad", "stale-map": "s", "not-bounded": "s", "relaxed": "m/s", "row-broken": "m/s"},
}
INTERVENTIONS = frozenset(
    {
        *(EventKind.SCENE, EventKind.SELF, EventKind.LIMIT, EventKind.RELAXED),
        *(EventKind.MINIMUM_VIOLATION, EventKind.HOLD, EventKind.SCALED_BACK),
    }
)
"""Kinds in which the controller did not follow its goal."""

SHOWN = {"": "", "exact": "", "true": " (truth)"}  # measures with shown events, and their label


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """Nearest obstacle: distance [m] from a point to its surface; position (3,) [m], world.

    splat: index in its scene's file; label: the splat's, or UNREPRESENTED; cell: in a grid; name: of any other
    obstacle.
    """

    distance: float
    position: tuple[float, float, float]
    splat: int | None = None
    label: str | None = None
    cell: tuple[int, int, int] | None = None
    name: str = ""

    def __str__(self) -> str:
        where = ", ".join(f"{v:.3f}" for v in self.position)
        unit = UNREPRESENTED if self.label == UNREPRESENTED else f"cell {self.cell}"
        what = unit if self.splat is None else f"{self.label} splat {self.splat}"
        return f"{self.name or what} at ({where})"


@dataclass(frozen=True, kw_only=True)
class Event:
    """An interval of successive states with its worst value.

    names: in order, at most MAX_NAMES of num_names; source: the field, or empty; state: index of the worst value's
    state; worst_name, obstacle: at that state.
    """

    kind: EventKind
    source: str
    first_ns: int
    last_ns: int
    start_s: float
    end_s: float
    num_states: int
    worst: float
    worst_s: float
    state: int
    worst_name: str
    names: tuple[str, ...]
    num_names: int
    obstacle: Obstacle | None = None


@dataclass(frozen=True, kw_only=True)
class Signal:
    """Source of events of one kind, by state: is_on (T,), value (T,), who (T,).

    who: the value's name, or names, the value's first.
    """

    kind: EventKind
    is_on: Bool
    value: Float64
    who: Sequence[str | tuple[str, ...]] = ()
    is_high_worse: bool = True
    source: str = ""

    def names(self, first: int, end: int) -> list[str]:
        """Names at states [first, end), each once, in order."""
        there = [(who,) if isinstance(who, str) else who for who in self.who[first:end]]
        return list(dict.fromkeys(name for names in there for name in names))


def runs_of(is_on: Bool) -> list[tuple[int, int]]:
    """First index, and one past the last, of each run of true values (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_on, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in zip(edges[::2], edges[1::2], strict=True)]


Near = Callable[[EventKind, str, int], Obstacle | None]
"""Kind of an event, name and state index of its worst value -> the nearest obstacle there."""


def events_of(stamp_ns: Stamps, signals: Iterable[Signal], near: Near | None = None) -> tuple[Event, ...]:
    """Events of all signals (T,), by start; near: finds the obstacle of a worst value."""
    runs = [(signal, first, end) for signal in signals for first, end in runs_of(signal.is_on)]
    runs.sort(key=lambda run: (stamp_ns[run[1]], -stamp_ns[run[2] - 1]))
    return tuple(_event(stamp_ns, signal, first, end, near) for signal, first, end in runs)


def _event(stamp_ns: Stamps, signal: Signal, first: int, end: int, near: Near | None) -> Event:
    values = signal.value[first:end]
    at = first + int(np.argmax(values) if signal.is_high_worse else np.argmin(values))
    start_s, end_s, worst_s = (float(stamp_ns[i] - stamp_ns[0]) * 1e-9 for i in (first, end - 1, at))
    names, name = signal.names(first, end), next(iter(signal.names(at, at + 1)), "")
    return Event(
        kind=signal.kind,
        source=signal.source,
        first_ns=int(stamp_ns[first]),
        last_ns=int(stamp_ns[end - 1]),
        start_s=start_s,
        end_s=end_s,
        num_states=end - first,
        worst=float(signal.value[at]),
        worst_s=worst_s,
        state=at,
        worst_name=name,
        names=tuple(names[:MAX_NAMES]),
        num_names=len(names),
        obstacle=None if near is None else near(signal.kind, name, at),
    )


def first_intervention(events: Sequence[Event]) -> Event | None:
    """Earliest event in which the controller deviated from its request."""
    return next((event for event in events if event.kind in INTERVENTIONS), None)


def clearance_signals(columns: NamedColumns, source: str, margin: float) -> list[Signal]:
    """Signals of a field's clearance (T,) [m]: below the margin, in contact, unknown."""
    distance, who = columns[f"clearance_{source}"], columns[f"nearest_{source}"]
    low = partial(Signal, value=distance, who=who, is_high_worse=False, source=source)
    is_blank = np.isnan(distance)
    return [
        low(kind=EventKind.BELOW_MARGIN, is_on=distance < margin),
        low(kind=EventKind.IN_COLLISION, is_on=distance < 0),
        Signal(kind=EventKind.WITHOUT_DISTANCE, is_on=is_blank, value=is_blank * 1.0, who=who, source=source),
    ]


def audit_signals(columns: NamedColumns, fields: Sequence[str], margin: float) -> list[Signal]:
    """Signals of audited states: clearance by each field, unknown space, limits, self-collision."""
    unknown, outside, touching = (columns[name] for name in ("unknown_share", "limit_margin", "self_clearance"))
    low = partial(Signal, is_high_worse=False)
    return [
        *(signal for field in fields for signal in clearance_signals(columns, field, margin)),
        Signal(kind=EventKind.UNKNOWN_SPACE, is_on=unknown > 0, value=unknown),
        low(kind=EventKind.OUTSIDE_LIMITS, is_on=outside < 0, value=outside, who=columns["limit_joint"]),
        low(kind=EventKind.SELF_COLLISION, is_on=touching < 0, value=touching, who=columns["self_pair"]),
    ]


def motion_signals(columns: NamedColumns, margin: float, max_map_age: float) -> list[Signal]:
    """Signals of motion and time: limits exceeded, clearance [m] between states, old maps [s]."""
    fast, sudden, lower = (columns[name] for name in ("velocity_share", "acceleration_share", "clearance_between"))
    unbounded, age = columns["unbounded_s"], columns["map_age_s"]
    return [
        Signal(kind=EventKind.TOO_FAST, is_on=fast > 1, value=fast, who=columns["velocity_joint"]),
        Signal(kind=EventKind.TOO_SUDDEN, is_on=sudden > 1, value=sudden, who=columns["acceleration_joint"]),
        Signal(kind=EventKind.BETWEEN_STATES, is_on=lower < margin, value=lower, is_high_worse=False),
        Signal(kind=EventKind.NOT_BOUNDED, is_on=unbounded > 0, value=unbounded),
        Signal(kind=EventKind.STALE_MAP, is_on=age > max_map_age, value=age),
    ]


def step_signals(columns: NamedColumns) -> list[Signal]:
    """Signals of a controller's steps: rows that shaped them, fallbacks, violated rows."""
    rung, scale, slack = np.array(columns["rung"]), columns["scale"], columns["slack"]
    is_least, is_hold, is_outside = (rung == each for each in (Rung.MINIMUM_VIOLATION, Rung.HOLD, Rung.OUTSIDE))
    cannot_act = np.array([len(names) > 0 for names in columns["who_fixed"]])
    by_slack = partial(Signal, value=slack, who=columns["who_relaxed"])
    at_nearest = partial(Signal, who=columns["barrier_nearest"])
    rows = ((kind, columns[f"multiplier_{kind}"], columns[f"who_{kind}"]) for kind in RowKind)
    return [
        *(Signal(kind=EventKind(kind.value), is_on=value > 0, value=value, who=who) for kind, value, who in rows),
        by_slack(kind=EventKind.RELAXED, is_on=(slack > 0) & ~is_outside),
        by_slack(kind=EventKind.ROW_BROKEN, is_on=(slack > 0) & is_outside),
        at_nearest(kind=EventKind.MINIMUM_VIOLATION, is_on=is_least, value=columns["residual"]),
        at_nearest(kind=EventKind.HOLD, is_on=is_hold, value=columns["barrier_clearance"], is_high_worse=False),
        at_nearest(kind=EventKind.SCALED_BACK, is_on=(scale < 1) & ~is_hold, value=scale, is_high_worse=False),
        Signal(
            kind=EventKind.CANNOT_ACT,
            is_on=cannot_act,
            value=columns["fixed_distance"],
            who=columns["who_fixed"],
            is_high_worse=False,
        ),
    ]

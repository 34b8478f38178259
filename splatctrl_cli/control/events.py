"""Events of an audit and a controller: intervals with worst value and names."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from splatctrl_cli.control.audit import AuditTrace
from splatctrl_cli.control.limits import Strain
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import Bool, Float64, Index, Stamps

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


INTERVENTIONS = frozenset(
    {
        *(EventKind.SCENE, EventKind.SELF, EventKind.LIMIT, EventKind.RELAXED),
        *(EventKind.MINIMUM_VIOLATION, EventKind.HOLD, EventKind.SCALED_BACK),
    }
)
"""Kinds in which the controller did something else than it was asked for."""

SHOWN = {"": "", "exact": "", "true": " (truth)"}  # measures with shown events, and their label


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """Nearest obstacle: distance [m] of its surface to a point; place (3,) [m], world.

    splat: index in its scene's file; label: the splat's, or UNREPRESENTED; cell: of a grid; name: of others.
    """

    distance: float
    position: tuple[float, float, float]
    splat: int | None = None
    label: str | None = None
    cell: tuple[int, int, int] | None = None
    name: str = ""

    def __str__(self) -> str:
        where = ", ".join(f"{v:.3f}" for v in self.position)
        if self.name:
            what = self.name
        elif self.splat is not None:
            what = f"{self.label} splat {self.splat}"
        else:
            what = UNREPRESENTED if self.label == UNREPRESENTED else f"cell {self.cell}"
        return f"{what} at ({where})"


@dataclass(frozen=True, kw_only=True)
class Event:
    """An interval of successive states with its worst value.

    names: in order, at most MAX_NAMES of num_names; source: the field, or empty; state: index of the worst state;
    worst_name, obstacle: there.
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


Names = Callable[[int], Sequence[str]] | tuple[Sequence[str], Index]
"""Names at a state, the value's own first; or names of which each state has one, by index (T,)."""


@dataclass(frozen=True, kw_only=True)
class Signal:
    """Source of events of one kind: is_on (T,), value (T,); without names by default."""

    kind: EventKind
    is_on: Bool
    value: Float64
    names: Names = lambda _: ()
    is_high_worse: bool = True
    source: str = ""

    def names_over(self, first: int, end: int) -> Iterable[str]:
        """Names at states [first, end); some may repeat."""
        if callable(self.names):
            return (name for i in range(first, end) for name in self.names(i))
        names, index = self.names
        found, at = np.unique(index[first:end], return_index=True)
        return [names[int(i)] for i in found[np.argsort(at)]]


def runs_of(is_on: Bool) -> list[tuple[int, int]]:
    """First and one past the last index of each run of true values (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_on, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def events_of(stamp_ns: Stamps, signals: Iterable[Signal]) -> tuple[Event, ...]:
    """Intervals of all signals (T,), by start."""
    fold = EventFold()
    fold.add(stamp_ns, signals)
    return fold.events()


Near = Callable[[EventKind, str, int], Obstacle | None]
"""Kind of an event, name of its worst and at which of the states -> what is nearest there."""


class EventFold:
    """Intervals of signals in blocks of states; an interval may span blocks."""

    def __init__(self) -> None:
        self._num, self._start_ns = 0, 0
        self._open: dict[int, Event] = {}  # by the signal's order, with all their names
        self._closed: list[tuple[int, Event]] = []

    def add(self, stamp_ns: Stamps, signals: Iterable[Signal], near: Near | None = None) -> None:
        """Add a block of stamps (T,) and signals (T,), in the same order each time.

        near: the obstacle of a worst value.
        """
        if not self._num:
            self._start_ns = int(stamp_ns[0])
        for order, signal in enumerate(signals):
            before = self._open.pop(order, None)
            runs = runs_of(signal.is_on)
            if before is not None and not (runs and runs[0][0] == 0):
                self._closed.append((order, before))
                before = None
            for first, end in runs:
                event = self._grown(before, stamp_ns, signal, first, end, near)
                before = None
                if end == len(stamp_ns):
                    self._open[order] = event
                else:
                    self._closed.append((order, event))
        self._num += len(stamp_ns)

    def events(self) -> tuple[Event, ...]:
        """All intervals so far, by start; an open one ends with the last state."""
        events = sorted([*self._closed, *self._open.items()], key=lambda e: (e[1].first_ns, -e[1].last_ns, e[0]))
        return tuple(replace(event, names=event.names[:MAX_NAMES]) for _, event in events)

    def _grown(
        self, before: Event | None, stamp_ns: Stamps, signal: Signal, first: int, end: int, near: Near | None
    ) -> Event:
        """`before` (None: a new event) with the states [first, end) of this block."""
        values = signal.value[first:end]
        at = first + int(np.argmax(values) if signal.is_high_worse else np.argmin(values))
        worst = float(signal.value[at])
        start_s, end_s, worst_s = (float(int(stamp_ns[i]) - self._start_ns) * 1e-9 for i in (first, end - 1, at))
        names = tuple(dict.fromkeys([*(before.names if before else ()), *signal.names_over(first, end)]))
        grown: dict[str, Any] = {
            "last_ns": int(stamp_ns[end - 1]),
            "end_s": end_s,
            "num_states": end - first + (before.num_states if before else 0),
            "names": names,
            "num_names": len(names),
        }
        if before is None or (worst > before.worst if signal.is_high_worse else worst < before.worst):
            name = next(iter(signal.names_over(at, at + 1)), "")
            obstacle = None if near is None else near(signal.kind, name, at)
            grown |= {"worst": worst, "worst_s": worst_s, "state": self._num + at, "worst_name": name}
            grown["obstacle"] = obstacle
        if before is not None:
            return replace(before, **grown)
        return Event(kind=signal.kind, source=signal.source, first_ns=int(stamp_ns[first]), start_s=start_s, **grown)


def first_intervention(events: Sequence[Event]) -> Event | None:
    """Earliest event in which the controller deviated from its request."""
    return next((event for event in events if event.kind in INTERVENTIONS), None)


def audit_signals(
    audit: AuditTrace, margin: float, spheres: Sequence[str], joints: Sequence[str], pairs: Sequence[str] = ()
) -> list[Signal]:
    """Signals of T audited states: clearance, limits, known space."""
    signals = []
    for source, clearance in audit.clearance.items():
        signals += clearance_signals(source, clearance.distance, clearance.sphere, margin, spheres)
        is_blank = np.isnan(clearance.distance)
        signals.append(
            Signal(
                kind=EventKind.WITHOUT_DISTANCE,
                is_on=is_blank,
                value=is_blank.astype(np.float64),
                names=(spheres, clearance.sphere),
                source=source,
            )
        )
    unknown, outside, touching = np.nan_to_num(audit.unknown_share), audit.limit_margin, audit.self_clearance
    return [
        *signals,
        Signal(kind=EventKind.UNKNOWN_SPACE, is_on=unknown > 0, value=unknown),
        _low(EventKind.OUTSIDE_LIMITS, outside < 0, outside, (joints, audit.limit_joint)),
        _low(EventKind.SELF_COLLISION, touching < 0, touching, (pairs, audit.self_pair)),
    ]


def clearance_signals(
    source: str, distance: Float64, sphere: Index, margin: float, spheres: Sequence[str]
) -> list[Signal]:
    """Signals below the margin and in contact, by the nearest sphere's clearance (T,) [m]."""
    names = (spheres, sphere)
    return [
        _low(kind, distance < bound, distance, names, source)
        for kind, bound in ((EventKind.BELOW_MARGIN, margin), (EventKind.IN_COLLISION, 0.0))
    ]


def limit_signals(strain: Strain, joints: Sequence[str]) -> list[Signal]:
    """Signals of joint velocity and acceleration above their limits."""
    return [
        Signal(kind=kind, is_on=value > 1, value=value, names=(joints, joint))
        for kind, value, joint in (
            (EventKind.TOO_FAST, strain.velocity, strain.velocity_joint),
            (EventKind.TOO_SUDDEN, strain.acceleration, strain.acceleration_joint),
        )
    ]


def interval_signals(lower: Float64, unbounded: Float64, margin: float) -> list[Signal]:
    """Signals between states: clearance bound (T,) [m] below the margin, unbounded time (T,) [s]."""
    return [
        Signal(kind=EventKind.BETWEEN_STATES, is_on=lower < margin, value=lower, is_high_worse=False),
        Signal(kind=EventKind.NOT_BOUNDED, is_on=unbounded > 0, value=unbounded),
    ]


def stale_signal(age_s: Float64, max_age_s: float) -> Signal:
    """Signal of a stale scene; age_s (T,) [s], NaN for an unstamped scene."""
    return Signal(kind=EventKind.STALE_MAP, is_on=age_s > max_age_s, value=np.nan_to_num(age_s))


def step_signals(steps: Sequence[ControlStep | None]) -> list[Signal]:
    """Signals of the controller's steps at T states; None: no step."""

    def relaxed(i: int) -> Sequence[str]:
        return [row.name for row in sorted(_taken_step(steps, i).relaxed, key=lambda row: -row.slack)]

    slack = _of(steps, lambda step: max((row.slack for row in step.relaxed), default=0.0))
    is_outside = _of(steps, lambda step: float(step.rung is Rung.OUTSIDE)) > 0
    residual, clearance = _of(steps, lambda step: step.residual), _of(steps, lambda step: step.clearance)
    is_least = _of(steps, lambda step: float(step.rung is Rung.MINIMUM_VIOLATION)) > 0
    is_hold = _of(steps, lambda step: float(step.rung is Rung.HOLD)) > 0
    scale = _of(steps, lambda step: step.scale, otherwise=1.0)
    cannot = _of(steps, lambda step: float(len(step.violated_fixed))) > 0
    fixed = _of(steps, lambda step: step.fixed_distance)

    def nearest(i: int) -> Sequence[str]:
        return [_taken_step(steps, i).nearest]

    return [
        *(_intervention_signal(steps, kind) for kind in RowKind),
        Signal(kind=EventKind.RELAXED, is_on=(slack > 0) & ~is_outside, value=slack, names=relaxed),
        Signal(kind=EventKind.ROW_BROKEN, is_on=(slack > 0) & is_outside, value=slack, names=relaxed),
        Signal(kind=EventKind.MINIMUM_VIOLATION, is_on=is_least, value=residual, names=nearest),
        _low(EventKind.HOLD, is_hold, clearance, nearest),
        _low(EventKind.SCALED_BACK, (scale < 1) & ~is_hold, scale, nearest),
        _low(EventKind.CANNOT_ACT, cannot, fixed, lambda i: _taken_step(steps, i).violated_fixed),
    ]


def _intervention_signal(steps: Sequence[ControlStep | None], kind: RowKind) -> Signal:
    def largest(step: ControlStep) -> float:
        return max((row.multiplier for row in step.interventions if row.kind is kind), default=0.0)

    def names_at(index: int) -> Sequence[str]:
        rows = [row for row in _taken_step(steps, index).interventions if row.kind is kind]
        return [row.name for row in sorted(rows, key=lambda row: -row.multiplier)]

    value = _of(steps, largest)
    return Signal(kind=EventKind(kind.value), is_on=value > 0, value=value, names=names_at)


def _low(kind: EventKind, is_on: Bool, value: Float64, names: Names, source: str = "") -> Signal:
    return Signal(kind=kind, is_on=is_on, value=value, names=names, is_high_worse=False, source=source)


def _of(
    steps: Sequence[ControlStep | None], value: Callable[[ControlStep], float], otherwise: float = 0.0
) -> Float64:
    return np.array([otherwise if step is None else value(step) for step in steps], dtype=np.float64)


def _taken_step(steps: Sequence[ControlStep | None], index: int) -> ControlStep:
    step = steps[index]
    assert step is not None
    return step

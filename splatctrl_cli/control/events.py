"""When and why: runs of states with something to say about them, as intervals with their worst value and names."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from splatctrl_cli.records import Bool, Float64, Index, Stamps

UNREPRESENTED = "unrepresented voxel"  # label of an obstacle that is occupied and has no splat
MAX_NAMES = 12  # of an event; how many there are is in num_names


class EventKind(StrEnum):
    """What happened over an interval; the comment says what its worst value is."""

    BELOW_MARGIN = "below-margin"  # least clearance [m]
    IN_COLLISION = "in-collision"  # least clearance [m]
    WITHOUT_DISTANCE = "without-distance"  # number of fields without one
    UNKNOWN_SPACE = "unknown-space"  # largest share of sphere centres
    BETWEEN_STATES = "between-states"  # least bound [m] of the clearance since the state before
    NOT_BOUNDED = "not-bounded"  # longest time [s] in which nobody knows where the arm was
    SELF_COLLISION = "self-collision"  # least distance of two spheres of the arm [m]
    OUTSIDE_LIMITS = "outside-limits"  # least distance to the limit, negative [rad]
    TOO_FAST = "too-fast"  # largest velocity, as a share of its limit
    TOO_SUDDEN = "too-sudden"  # largest acceleration, as a share of its limit
    STALE_MAP = "stale-map"  # oldest scene [s]
    SCENE = "scene"  # largest multiplier of a row against the scene
    SELF = "self"  # the same of a self-collision row
    LIMIT = "limit"  # the same of a joint's position or velocity limit
    RELAXED = "relaxed"  # largest slack [m/s]
    MINIMUM_VIOLATION = "minimum-violation"  # largest residual
    HOLD = "hold"  # least barrier clearance [m]
    SCALED_BACK = "scaled-back"  # least scale
    ROW_BROKEN = "row-broken"  # largest excess over a barrier row, of a controller that is not ours [m/s]
    CANNOT_ACT = "cannot-act"  # least distance [m] of a violated row that has no joint to turn


INTERVENTIONS = frozenset(
    {
        *(EventKind.SCENE, EventKind.SELF, EventKind.LIMIT, EventKind.RELAXED),
        *(EventKind.MINIMUM_VIOLATION, EventKind.HOLD, EventKind.SCALED_BACK),
    }
)
"""Kinds in which the controller did something else than it was asked for."""

SHOWN = {"": "", "exact": "", "true": " (truth)"}  # measures whose events people are shown, with what it is called


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """What is nearest: its surface's distance [m] to a point and its place (3,) [m], world; a splat's index in the
    file of its scene and its label (UNREPRESENTED without a splat), a grid's cell, or the name of what it is.
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
    """An interval of consecutive states: first and last stamp [ns] and time [s], how many, the worst value and when,
    its names in the order they came up (at most MAX_NAMES of num_names), and the obstacle at the worst.

    source: the field it is by, empty where none is; state: index of the worst, worst_name: who it is of.
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
class OneEach:
    """One of `names` at each state, by index (T,)."""

    names: Sequence[str]
    index: Index

    def __call__(self, i: int) -> Sequence[str]:
        return [self.names[int(self.index[i])]]

    def over(self, first: int, end: int) -> Sequence[str]:
        """Each name of these states once, in the order they come up."""
        found, at = np.unique(self.index[first:end], return_index=True)
        return [self.names[int(i)] for i in found[np.argsort(at)]]


@dataclass(frozen=True, kw_only=True)
class Signal:
    """What makes events of one kind: is_on (T,), value (T,), the names at a state (the one that the value is of comes
    first), and which end is the worse.
    """

    kind: EventKind
    is_on: Bool
    value: Float64
    names_at: Callable[[int], Sequence[str]]
    is_high_worse: bool = True
    source: str = ""

    def names_over(self, first: int, end: int) -> Iterable[str]:
        """The names at these states, in the order they come up."""
        if isinstance(self.names_at, OneEach):
            return self.names_at.over(first, end)
        return (name for i in range(first, end) for name in self.names_at(i))


def runs_of(is_on: Bool) -> list[tuple[int, int]]:
    """First and one past the last index of every run of true values (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_on, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def events_of(stamp_ns: Stamps, signals: Iterable[Signal]) -> tuple[Event, ...]:
    """The intervals of all signals (T,), by their start."""
    fold = EventFold()
    fold.add(stamp_ns, signals)
    return fold.events()


Near = Callable[[EventKind, str, int], Obstacle | None]
"""Kind of an event, name of its worst and at which of the states -> what is nearest there."""


@dataclass(kw_only=True)
class _Run:
    """An interval as far as it is known; state: of the worst, counted from the first block on."""

    order: int
    kind: EventKind
    source: str
    first_ns: int
    last_ns: int = 0
    num_states: int = 0
    worst: float = np.nan
    state: int = -1
    worst_ns: int = 0
    worst_name: str = ""
    names: dict[str, None] = field(default_factory=dict)
    obstacle: Obstacle | None = None


class EventFold:
    """The intervals of signals that come in blocks of states; one that crosses a border is one interval."""

    def __init__(self) -> None:
        self._num, self._start_ns = 0, 0
        self._open: dict[int, _Run] = {}
        self._closed: list[_Run] = []

    def add(self, stamp_ns: Stamps, signals: Iterable[Signal], near: Near | None = None) -> None:
        """The next block's stamps (T,) and signals (T,), the same kinds in the same order every time.

        near: asked for the obstacle of every worst value in this block.
        """
        if not self._num:
            self._start_ns = int(stamp_ns[0])
        for order, signal in enumerate(signals):
            before = self._open.pop(order, None)
            runs = runs_of(signal.is_on)
            if before is not None and not (runs and runs[0][0] == 0):
                self._closed.append(before)
                before = None
            for first, end in runs:
                run = before or _Run(
                    order=order, kind=signal.kind, source=signal.source, first_ns=int(stamp_ns[first])
                )
                before = None
                self._grown(run, stamp_ns, signal, first, end, near)
                if end == len(stamp_ns):
                    self._open[order] = run
                else:
                    self._closed.append(run)
        self._num += len(stamp_ns)

    def events(self) -> tuple[Event, ...]:
        """All intervals so far, by their start; one that is not over ends with the last state."""
        runs = [*self._closed, *self._open.values()]
        return tuple(self._event(run) for run in sorted(runs, key=lambda r: (r.first_ns, -r.last_ns, r.order)))

    def _grown(self, run: _Run, stamp_ns: Stamps, signal: Signal, first: int, end: int, near: Near | None) -> None:
        """The run, with states `first` up to `end` of a block."""
        values = signal.value[first:end]
        at = first + int(np.argmax(values) if signal.is_high_worse else np.argmin(values))
        worst = float(signal.value[at])
        run.last_ns = int(stamp_ns[end - 1])
        run.num_states += end - first
        run.names |= dict.fromkeys(signal.names_over(first, end))
        if run.state < 0 or (worst > run.worst if signal.is_high_worse else worst < run.worst):
            run.worst, run.state, run.worst_ns = worst, self._num + at, int(stamp_ns[at])
            run.worst_name = next(iter(signal.names_at(at)), "")
            run.obstacle = None if near is None else near(signal.kind, run.worst_name, at)

    def _event(self, run: _Run) -> Event:
        start_s, end_s, worst_s = (
            float(stamp - self._start_ns) * 1e-9 for stamp in (run.first_ns, run.last_ns, run.worst_ns)
        )
        names = tuple(run.names)
        return Event(
            kind=run.kind,
            source=run.source,
            first_ns=run.first_ns,
            last_ns=run.last_ns,
            start_s=start_s,
            end_s=end_s,
            num_states=run.num_states,
            worst=run.worst,
            worst_s=worst_s,
            state=run.state,
            worst_name=run.worst_name,
            names=names[:MAX_NAMES],
            num_names=len(names),
            obstacle=run.obstacle,
        )


def first_intervention(events: Sequence[Event]) -> Event | None:
    """The earliest event in which the controller did something else than it was asked for."""
    return next((event for event in events if event.kind in INTERVENTIONS), None)

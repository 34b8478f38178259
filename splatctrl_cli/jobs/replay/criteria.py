"""Input of a replay's criteria, thresholds as table rows, and criteria of the controller."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatctrl_cli.config.fixed import LIMIT_EXCEEDED, SLIGHTLY_UNDER
from splatctrl_cli.control.columns import Event, EventKind, names_at
from splatctrl_cli.control.replay import Outcome as LoopOutcome
from splatctrl_cli.evaluate.verdict import Outcome, Reason, failed, not_evaluable, passed_reason, plural
from splatctrl_cli.jobs.replay.inputs import LoggedStates
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.request import Replay, ReplayInputs, ReplayRequest, Trace
from splatctrl_cli.records import Float64
from splatctrl_cli.voxels import EvidenceClass

SAFE, MARGIN, CONTACT, LIMITS, CONTROL = "safe", "margin broken", "contact", "limits broken", "controller failed"
BROKEN, UNKNOWN = "failed", "*not evaluable*"  # in the table of criteria
SLOW = "log joint states more often"


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Input of a replay's criteria."""

    request: ReplayRequest
    inputs: ReplayInputs
    logged: LoggedStates
    replay: Replay
    metrics: Metrics

    @property
    def threshold(self) -> float:
        """Margin [m] less solver and rounding error."""
        return self.replay.margin - SLIGHTLY_UNDER

    @property
    def past_end_s(self) -> float:
        """Driven time after the log's last state [s]."""
        return max(int(self.replay.trace.stamp_ns[-1]) - int(self.inputs.states.stamp_ns[-1]), 0) * 1e-9


def events_of(replay: Replay, kind: EventKind, source: str = "") -> Sequence[Event]:
    return [event for event in replay.events if event.kind is kind and event.source == source]


def mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"


def worst_state(
    trace: Trace, values: Float64, pick: Callable[[Float64], np.intp] = np.nanargmin, who: Sequence[str] = ()
) -> Reason | None:
    """Value that `pick` chooses, as a reason without a sentence; None without values.

    values: (T,). who: names (T,).
    """
    count = int(np.sum(~np.isnan(values)))
    if not count:
        return None
    at = int(pick(values))
    name = who[at] if who else ""
    return not_evaluable(sentence="", value=float(values[at]), time_s=trace.seconds(at), who=name, count=count)


def largest_about(trace: Trace, column: str) -> float | None:
    """Largest value about the arm; None if that space was not evaluated."""
    largest = worst_state(trace, trace[column], np.nanargmax)
    return None if largest is None else largest.value


Number = float | Callable[[Judged], float]


@dataclass(frozen=True, kw_only=True)
class Bound:
    """Threshold as a row of a table; the worst value of a quantity decides.

    on: a column (T,) of the trace, (T, K) for the least of `parts`, or a function that returns the worst value. who:
    column of names. at_most, at_least: the allowed value, or a function of the input; `tolerance` widens it. above:
    without either, the value must exceed this (0: the margin). say, passed: sentences; without `passed`, a pass gives
    no reason. quantity, why: for the documentation.
    """

    on: str | Callable[[Judged], Reason | None]
    parts: tuple[EvidenceClass, ...] = ()
    who: str = ""
    at_most: Number | None = None
    at_least: Number | None = None
    above: float = 0.0
    tolerance: Number = 0.0
    unit: str = ""
    say: str
    passed: str = ""
    remedy: str = ""
    outcome: Outcome = Outcome.NOT_EVALUABLE
    label: str = ""
    quantity: str = ""
    why: str = ""

    def __call__(self, judged: Judged) -> Iterator[Reason]:
        """Yield the reason; none without a value."""
        least = self.above or judged.replay.margin
        worst = self.on(judged) if callable(self.on) else self._worst_state(judged.replay.trace, least)
        if worst is None or worst.value is None:
            return
        threshold = next(number for number in (self.at_most, self.at_least, least) if number is not None)
        allowed, tolerance = (
            number(judged) if callable(number) else number for number in (threshold, self.tolerance)
        )
        value = worst.value
        words = {
            **{"value": value, "negated": -value, "mm": mm(value), "ms": 1e3 * value, "percent": 100 * value},
            **{"allowed": allowed, "allowed_mm": mm(allowed), "allowed_ms": 1e3 * allowed},
            **{"allowed_percent": 100 * allowed, "who": worst.who, "words": worst.sentence},
        }
        if self.breaks(value, allowed, tolerance):
            yield replace(
                worst,
                outcome=self.outcome,
                sentence=self.say.format(**words),
                threshold=allowed,
                unit=self.unit,
                remedy=self.remedy,
                label=self.label,
            )
        elif self.passed:
            yield passed_reason(self.passed.format(**words), value, allowed, self.unit, worst.count or 0)

    def breaks(self, values: Any, allowed: float, tolerance: float = 0.0) -> Any:
        """True for values that are not allowed."""
        if self.at_most is not None:
            return values > allowed + tolerance
        return values <= allowed if self.at_least is None else values < allowed - tolerance

    def is_broken(self, trace: Trace, margin: float) -> bool:
        """True if a state breaks this limit about the arm; margin [m]."""
        allowed = self.at_most if isinstance(self.at_most, float) else self.above or margin
        return bool(np.any(self.breaks(self.values(trace), allowed)))

    def values(self, trace: Trace) -> Float64:
        """Column (T,); NaN where space about the arm was not evaluated."""
        values: Float64 = trace[str(self.on)]
        return values[:, self.parts].min(axis=1) if self.parts else values

    @property
    def name(self) -> str:
        return self.parts[0].name.lower() if self.parts else str(self.on)

    @property
    def docs(self) -> str:
        """Row of the documentation's table of limits, its cells separated by |."""
        within = f"more than {1e3 * self.above:g} mm" if self.above else "more than the margin"
        within = f"at most {100 * self.at_most:g} %" if isinstance(self.at_most, float) else within
        return f"{self.quantity} | {within} | {self.why}"

    def _worst_state(self, trace: Trace, least: float) -> Reason | None:
        """Worst state; with `above`, also its place and the number of broken states."""
        values, pick = self.values(trace), np.nanargmin if self.at_most is None else np.nanargmax
        worst = worst_state(trace, values, pick, trace[self.who] if self.who else ())
        if worst is None or (self.at_most, self.at_least) != (None, None):
            return worst
        at, places = int(pick(values)), trace["class_places" if self.parts else f"{self.on}_place"]
        nearest = min(self.parts, key=lambda kind: float(trace[str(self.on)][at, kind]), default=0)
        place = tuple(places[at, 3 * nearest : 3 * nearest + 3].tolist())
        cause = "at ({:.2f}, {:.2f}, {:.2f}) m".format(*place)
        return replace(worst, place=place, cause=cause, count=int((values <= least).sum()))


def controller(judged: Judged) -> Iterator[Reason]:
    """Every step of the closed loop is solved.
    Rows may be relaxed only at over twice their margin. A user's controller always answers validly.
    """
    outside, trace, metrics = judged.replay.outside, judged.replay.closed_loop, judged.metrics
    if outside is not None:
        num, failure = outside.num_answers, outside.failure
        yield (
            passed_reason(f"all {num} steps answered", 0.0, 0.0, "", num)
            if failure is None
            else failed(
                sentence=f"{failure.fault}: {failure.sentence}; after {plural(num, 'answer')},",
                value=1.0,
                threshold=0.0,
                time_s=float(failure.stamp_ns - judged.replay.trace.stamp_ns[0]) * 1e-9,
                count=num + 1,
                label=CONTROL,
            )
        )
        return
    if trace is None:
        return
    num_relaxed, num_near = int(metrics["num_relaxed"] or 0), int(np.nansum(judged.replay.trace["relaxed_near"]))
    bad = {"relaxed": num_near, **{name: metrics[f"num_{name}"] or 0 for name in ("minimum_violation", "hold")}}
    if not sum(bad.values()):
        far = f", {num_relaxed} of them with rows relaxed, all over twice their margin away" if num_relaxed else ""
        yield passed_reason(f"all {len(trace.steps)} steps solved{far}", 0.0, 0.0, "", len(trace.steps))
        return
    kinds = [kind for kind in EventKind if bad.get(kind.replace("-", "_"))]
    first = min((e for kind in kinds for e in events_of(judged.replay, kind)), key=lambda e: e.first_ns)
    counts = ", ".join(f"{int(count)} {name.replace('_', ' ')}" for name, count in bad.items() if count)
    yield failed(
        sentence=f"constraints could not be satisfied at {sum(bad.values()):.0f} of {len(trace.steps)} steps "
        f"({counts}), first",
        value=float(sum(bad.values())),
        threshold=0.0,
        time_s=first.start_s,
        who=first.worst_name,
        cause="" if first.obstacle is None else f"near {first.obstacle}",
        count=len(trace.steps),
        label=CONTROL,
    )


def scene_hits(judged: Judged) -> Iterator[Reason]:
    """No obstacle appears inside the arm's surface; judged in closed loop."""
    if hits := [change for change in judged.replay.scene_changes if change.is_hit]:
        yield failed(
            sentence=f"{plural(len(hits), 'obstacle')} appeared inside the arm, first",
            value=float(len(hits)),
            threshold=0.0,
            time_s=float(hits[0].stamp_ns - judged.replay.trace.stamp_ns[0]) * 1e-9,
            count=len(judged.replay.scene_changes),
            label=CONTACT,
        )


def goal(judged: Judged) -> Iterator[Reason]:
    """The goal is reached; judged in closed loop."""
    trace, request = judged.replay.closed_loop, judged.request
    if trace is None or request.follow or request.twist_topic is not None:
        return
    reached = trace.outcome is LoopOutcome.GOAL_REACHED
    has_way = trace.outcome not in (LoopOutcome.GOAL_REACHED, LoopOutcome.CONTROLLER_FAILED)
    yield Reason(
        outcome=Outcome.PASSED if reached else Outcome.FAILED,
        sentence="reached" if reached else f"not reached: {trace.outcome}",
        value=float(reached),
        threshold=1.0,
        count=len(trace.steps),
        label="goal not reached",
        remedy="--set control.max_detours=3 lets the planner find a way round" if has_way else "",
    )


def _commanded(judged: Judged) -> Reason | None:
    replay = judged.replay
    if replay.outside is None:
        return None
    shares = np.abs(replay.trace["v"]) / replay.model.velocity_limit
    who = names_at(replay.model.joint_names, shares.argmax(axis=1))
    return worst_state(replay.trace, shares.max(axis=1), np.nanargmax, who)


COMMANDED = Bound(
    on=_commanded,
    at_most=1.0,
    tolerance=LIMIT_EXCEEDED - 1.0,
    say="{who} is commanded {value:.2f} times its limit",
    outcome=Outcome.FAILED,
    label=LIMITS,
)

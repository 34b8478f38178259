"""Input of a replay's criteria; criteria of time and of the controller."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import CLOCKS_APART, LIMIT_EXCEEDED, SAME_MOMENT_NS, SLIGHTLY_UNDER
from splatctrl_cli.control.events import Event, EventKind
from splatctrl_cli.control.replay import Outcome as LoopOutcome
from splatctrl_cli.evaluate.verdict import Outcome, Reason, failed, lacking, passed_reason, plural
from splatctrl_cli.jobs.replay.inputs import LoggedStates
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.request import Replay, ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay.trace import Trace
from splatctrl_cli.records import Float64

SAFE, MARGIN, CONTACT, LIMITS, CONTROL = "safe", "margin broken", "contact", "limits broken", "controller failed"
BROKEN, UNKNOWN = "failed", "*not evaluable*"  # in the table of criteria
SLOW = "log joint states more often"


@dataclass(frozen=True, kw_only=True)
class Judged:
    """The input of a replay's criteria."""

    request: ReplayRequest
    inputs: ReplayInputs
    logged: LoggedStates
    replay: Replay
    metrics: Metrics

    @property
    def threshold(self) -> float:
        """The margin [m] less solver and rounding error."""
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
    trace: Trace, column: str, who: str, pick: Callable[[Float64], np.intp] = np.nanargmin
) -> tuple[float, float, str]:
    """Value, time [s] and name at the state that `pick` takes."""
    values = trace[column]
    at = int(pick(values))
    return float(values[at]), trace.seconds(at), trace[who][at]


def nearby(trace: Trace, column: str) -> tuple[float, float, int] | None:
    """Largest value about the arm, its time [s], and the number of values."""
    values = trace[column]
    num = int(np.isfinite(values).sum())
    return (float(np.nanmax(values)), trace.seconds(int(np.nanargmax(values))), num) if num else None


def evidence_age(judged: Judged) -> Iterator[Reason]:
    """Depth about the arm is at most `--max-map-age` old and not newer than the state. After half a second
    without any, the next depth shows nothing where the arm was. A baked field has no times (a note).
    """
    first_ns, margin = int(judged.replay.trace.stamp_ns[0]), judged.replay.margin
    for found in judged.replay.unwatched:
        since, until, when = ((ns - first_ns) * 1e-9 for ns in (found.since_ns, found.depth_ns, found.stamp_ns))
        yield lacking(
            sentence=f"no camera gave depth near the arm from {since:.2f} to {until:.2f} s, and then an obstacle "
            f"is {mm(found.clearance)} from the arm's place, margin {mm(margin)},",
            value=found.clearance,
            threshold=margin,
            unit="m",
            time_s=when,
            remedy="its time of arrival is unknown: cameras must give depth all the time",
            count=judged.replay.num_states,
        )
    ahead = nearby(judged.replay.trace, "evidence_ahead")
    allowed = SAME_MOMENT_NS / 1e9  # frames of one time step differ in time
    if ahead is not None and ahead[0] > allowed:
        yield lacking(
            sentence=f"the newest depth near the arm is {ahead[0]:.2f} s newer than the state that it judges",
            value=-ahead[0],
            threshold=-allowed,
            unit="s",
            time_s=ahead[1],
            remedy="a state is judged by what was known then: reconstruct with snapshots, or check the clocks",
            count=ahead[2],
        )
    near, oldest = nearby(judged.replay.trace, "evidence_age"), judged.request.max_map_age
    if near is not None:
        age, time_s, count = near
        words, remedy = _end_words(judged, age, time_s)
        yield (
            passed_reason(f"depth from about the arm at most {age:.2f} s before", age, oldest, "s", count)
            if age <= oldest
            else lacking(
                sentence=f"{words}the newest depth near the arm is {age:.2f} s old, allowed {oldest:g} s",
                value=age,
                threshold=oldest,
                unit="s",
                time_s=time_s,
                remedy=remedy
                or "frames that have no depth or repeat it do not count: check the cameras ('splatctrl check')",
                count=count,
            )
        )


def _end_words(judged: Judged, age: float, time_s: float) -> tuple[str, str]:
    lasts = judged.replay.trace.seconds(-1) - judged.past_end_s
    if not judged.past_end_s or (age - (time_s - lasts)) > judged.request.max_map_age + SAME_MOMENT_NS / 1e9:
        return "", ""
    remedy = f"end it with the log (--set control.max_time={max(lasts, 0.01):.3g}), start earlier (--start-time), or"
    return f"the motion continues {judged.past_end_s:.2f} s past the end of the log, and ", f"{remedy} record longer"


def map_age(judged: Judged) -> Iterator[Reason]:
    """The map is at most `--max-map-age` old (a baked field: from its moment). Newer depth shows nothing within the
    margin: of a state's own time that a late map (`--latency`) did not contain, or the next after the last state.
    """
    yield from _overtaken(judged)
    ages, allowed = judged.replay.trace["map_age_s"], judged.request.max_map_age
    known = ages[np.isfinite(ages)]
    most = float(known.max(initial=-np.inf))
    if not len(known) and judged.request.field is not None and judged.inputs.source.has_clock:
        yield lacking(
            sentence="the field does not say what time it shows",
            remedy="give --scene, or bake a reconstruction instead of bare splats",
            count=judged.replay.num_states,
        )
    elif len(known) and most <= allowed:
        yield passed_reason(f"at most {most:.2f} s", most, allowed, "s", len(known))
    elif len(known):
        worst = max(events_of(judged.replay, EventKind.STALE_MAP), key=lambda event: event.worst)
        words, remedy = _end_words(judged, most, worst.worst_s)
        yield lacking(
            sentence=f"{words}the map is up to {most:.2f} s old, allowed {allowed:g} s, from {worst.start_s:.2f} to "
            f"{worst.end_s:.2f} s",
            value=most,
            threshold=allowed,
            unit="s",
            time_s=worst.worst_s,
            remedy=remedy or "the cameras must cover the motion in time; --max-map-age says how old a map may be",
            count=len(known),
        )


def _overtaken(judged: Judged) -> Iterator[Reason]:
    first_ns, margin = int(judged.replay.trace.stamp_ns[0]), judged.replay.margin
    found = sorted(judged.replay.overtaken, key=lambda each: each.clearance)
    for worst in [each for each in found if each.depth_ns <= each.stamp_ns][:1]:
        yield failed(
            sentence=f"depth of {(worst.depth_ns - first_ns) * 1e-9:.2f} s, not yet in the map of that time, "
            f"shows an obstacle {mm(worst.clearance)} from the arm, margin {mm(margin)},",
            value=worst.clearance,
            threshold=margin,
            unit="m",
            time_s=(worst.stamp_ns - first_ns) * 1e-9,
            remedy="the map comes too late for this motion: lower --latency, or drive more slowly",
            count=judged.replay.num_states,
            label=CONTACT if worst.clearance < 0 else MARGIN,
        )
    for last in [each for each in found if each.depth_ns > each.stamp_ns][:1]:
        yield lacking(
            sentence=f"the next depth, {(last.depth_ns - last.stamp_ns) * 1e-9:.2f} s after the last state, shows an "
            f"obstacle {mm(last.clearance)} from the arm, margin {mm(margin)},",
            value=last.clearance,
            threshold=margin,
            unit="m",
            time_s=(last.stamp_ns - first_ns) * 1e-9,
            remedy="it may have come earlier: judge a longer time",
            count=judged.replay.num_states,
        )


def judged_time(judged: Judged) -> Iterator[Reason]:
    """No gap over `verdict.longest_interval` in which the arm could reach the margin within its velocity
    limits. No state without a distance or dropped for its stamp (*judged states*). At most `verdict.lead_in` before
    the first map.
    """
    config, replay = judged.request.config.verdict, judged.replay
    stamps, unbounded, blank = replay.trace.stamp_ns, replay.trace["unbounded_s"], replay.trace["is_blank"]
    if blank.any():
        yield lacking(
            criterion="judged states",
            sentence=f"the path leaves known space: at {int(blank.sum())} of {len(stamps)} states a sphere is where "
            "the field has no distance, first",
            value=float(blank.mean()),
            threshold=config.unjudged,
            time_s=replay.trace.seconds(int(np.argmax(blank))),
            remedy="bake with field.unknown = free or obstacle, over a box that holds the motion",
            count=len(stamps),
        )
    duration = max(float(stamps[-1] - stamps[0]) * 1e-9, 1e-9)
    share = float(unbounded.sum()) / duration
    if share > config.unjudged:
        longest = int(np.argmax(unbounded))
        yield lacking(
            sentence=f"{float(unbounded.sum()):.2f} s of {duration:.2f} s lie between states too far apart to bound "
            f"the motion ({plural(int((unbounded > 0).sum()), 'gap')}, the longest {unbounded[longest]:.2f} s, "
            "ending",
            value=share,
            threshold=config.unjudged,
            time_s=replay.trace.seconds(longest),
            cause=f"expected at most {config.longest_interval:g} s)",
            remedy=SLOW,
            count=len(stamps),
        )
    dropped = judged.inputs.source.loss.conflicting_states
    if dropped > config.unjudged * (dropped + len(stamps)):
        yield lacking(
            criterion="judged states",
            sentence=f"{dropped} logged states were dropped: they repeat a stamp with other positions",
            value=float(dropped),
            threshold=config.unjudged,
            remedy="stamp every state with its own time, or give --stamps log",
            count=len(stamps),
        )
    if replay.lead_in_s > config.lead_in:
        yield lacking(
            sentence=f"the first {replay.lead_in_s:.2f} s ({replay.num_before_scene} states) come before the first "
            "map",
            value=replay.lead_in_s,
            threshold=config.lead_in,
            unit="s",
            remedy="judge the rest alone with --start-time first-map",
            count=judged.replay.num_states,
        )


def clocks(judged: Judged) -> Iterator[Reason]:
    """Cameras and robot agree within 50 ms beyond the estimate's own uncertainty."""
    clock = judged.logged.clock
    if clock is None or clock.offset_s is None or clock.uncertainty_s is None:
        return
    offset, uncertainty = float(clock.offset_s), float(clock.uncertainty_s)
    yield (
        passed_reason(f"{1e3 * abs(offset):.0f} ms apart", abs(offset), CLOCKS_APART, "s", clock.num_intervals)
        if abs(offset) - uncertainty <= CLOCKS_APART
        else lacking(
            sentence=f"the cameras' clock is {1e3 * abs(offset):.0f} ms {'ahead of' if offset > 0 else 'behind'} "
            f"the robot's (+- {1e3 * uncertainty:.0f} ms)",
            value=abs(offset),
            threshold=CLOCKS_APART,
            unit="s",
            remedy="synchronise the clocks, or shift one in the log",
            count=clock.num_intervals,
        )
    )


def controller(judged: Judged) -> Iterator[Reason]:
    """Every step of the closed loop is solved. Rows may be relaxed over twice their margin away. A user's controller
    always answers validly.
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
    found = ", ".join(f"{int(count)} {name.replace('_', ' ')}" for name, count in bad.items() if count)
    yield failed(
        sentence=f"its rows could not be satisfied at {found} of {len(trace.steps)} steps, first",
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
            sentence=f"obstacles appeared inside the arm {len(hits)} times, first",
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


def commanded(judged: Judged) -> Reason | None:
    """A reason if a user's controller commands more than the velocity limits."""
    replay = judged.replay
    if replay.outside is None:
        return None
    shares = np.abs(replay.trace["v"]) / replay.model.velocity_limit
    if not np.nanmax(shares, initial=0.0) > LIMIT_EXCEEDED:
        return None
    state, joint = np.unravel_index(np.nanargmax(shares), shares.shape)
    name, most = replay.model.joint_names[joint], float(shares[state, joint])
    return failed(
        sentence=f"{name} is commanded {most:.2f} times its limit",
        value=most,
        threshold=1.0,
        time_s=replay.trace.seconds(int(state)),
        who=name,
        count=judged.replay.num_states,
        label=LIMITS,
    )

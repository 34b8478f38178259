"""Criteria of time: ages of maps and of evidence, time without either, clocks."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from operator import attrgetter

import numpy as np

from splatctrl_cli.config.fixed import CLOCKS_APART, SAME_MOMENT_NS
from splatctrl_cli.control.columns import runs_of
from splatctrl_cli.evaluate.verdict import Outcome, Reason, failed, not_evaluable, plural
from splatctrl_cli.jobs.replay.criteria import CONTACT, MARGIN, SLOW, Bound, Judged, mm, worst_state


def evidence_age(judged: Judged) -> Iterator[Reason]:
    """Depth near the arm is at most `--max-map-age` old and not newer than the state.
    After 0.5 s without depth there, the next depth shows no obstacle where the arm was. A baked field has no times.
    """
    first_ns, margin = int(judged.replay.trace.stamp_ns[0]), judged.replay.margin
    for later in judged.replay.unwatched:
        since, until, when = ((ns - first_ns) * 1e-9 for ns in (later.since_ns, later.depth_ns, later.stamp_ns))
        yield not_evaluable(
            sentence=f"no camera gave depth near the arm from {since:.2f} to {until:.2f} s, and then an obstacle "
            f"is {mm(later.clearance)} from the arm's place, margin {mm(margin)},",
            value=later.clearance,
            threshold=margin,
            unit="m",
            time_s=when,
            remedy="its time of arrival is unknown: record depth without pauses",
            count=judged.replay.num_states,
        )
    yield from AHEAD(judged)
    yield from _blame_end(judged, EVIDENCE_AGE(judged))


OLDEST: Callable[[Judged], float] = attrgetter("request.max_map_age")
AHEAD = Bound(
    on=lambda judged: worst_state(judged.replay.trace, -judged.replay.trace["evidence_ahead"]),
    at_least=-SAME_MOMENT_NS / 1e9,  # frames of one time step differ in time
    unit="s",
    say="the newest depth near the arm is {negated:.2f} s newer than the state that it judges",
    remedy="a state is judged by what was known then: reconstruct with snapshots, or check the clocks",
)
EVIDENCE_AGE = Bound(
    on="evidence_age",
    at_most=OLDEST,
    unit="s",
    say="the newest depth near the arm is {value:.2f} s old, allowed {allowed:g} s",
    passed="the newest depth near the arm is at most {value:.2f} s old",
    remedy="frames that have no depth or repeat it do not count: check the cameras ('splatctrl check')",
)


def _blame_end(judged: Judged, reasons: Iterable[Reason]) -> Iterator[Reason]:
    """Explain an age by the end of the log, if the motion continues past it."""
    lasts, past = judged.replay.trace.seconds(-1) - judged.past_end_s, judged.past_end_s
    for reason in reasons:
        since = (reason.value or 0.0) - ((reason.time_s or 0.0) - lasts)
        if reason.outcome is Outcome.PASSED or not past or since > OLDEST(judged) + SAME_MOMENT_NS / 1e9:
            yield reason
            continue
        yield replace(
            reason,
            sentence=f"the motion continues {past:.2f} s past the end of the log, and {reason.sentence}",
            remedy=f"end it with the log (--set control.max_time={max(lasts, 0.01):.3g}), start earlier "
            "(--start-time), or record longer",
        )


def _oldest_map(judged: Judged) -> Reason | None:
    trace = judged.replay.trace
    ages = trace["map_age_s"]
    oldest = worst_state(trace, ages, np.nanargmax)
    is_old = np.append(ages > OLDEST(judged), False)
    if oldest is None or not is_old.any():
        return oldest
    first, end = next((first, end) for first, end in runs_of(is_old) if first <= np.nanargmax(ages) < end)
    return replace(oldest, sentence=f"from {trace.seconds(first):.2f} to {trace.seconds(end - 1):.2f} s")


MAP_AGE = Bound(
    on=_oldest_map,
    at_most=OLDEST,
    unit="s",
    say="the map is up to {value:.2f} s old, allowed {allowed:g} s ({words})",
    passed="at most {value:.2f} s",
    remedy="record depth during the whole motion, or raise --max-map-age",
)


def map_age(judged: Judged) -> Iterator[Reason]:
    """The map is at most `--max-map-age` old (a baked field: from its moment).
    With `--latency`, depth of a state's own time shows no obstacle within the margin; nor does the next depth after
    the last state.
    """
    yield from _overtaken(judged)
    has_clock = judged.inputs.source.has_clock
    if np.isnan(judged.replay.trace["map_age_s"]).all() and judged.request.field is not None and has_clock:
        yield not_evaluable(
            sentence="the baked field has no time",
            remedy="give --scene, or bake a reconstruction instead of bare splats",
            count=judged.replay.num_states,
        )
    yield from _blame_end(judged, MAP_AGE(judged))


def _overtaken(judged: Judged) -> Iterator[Reason]:
    first_ns, margin = int(judged.replay.trace.stamp_ns[0]), judged.replay.margin
    overtaken = sorted(judged.replay.overtaken, key=lambda each: each.clearance)
    for worst in [each for each in overtaken if each.depth_ns <= each.stamp_ns][:1]:
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
    for last in [each for each in overtaken if each.depth_ns > each.stamp_ns][:1]:
        yield not_evaluable(
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
    """Velocity limits keep the arm outside the margin between states over `verdict.longest_interval` apart.
    Every state has a distance, and none was dropped for its stamp (*judged states*). The first map is at most
    `verdict.lead_in` later than the first state.
    """
    config, replay = judged.request.config.verdict, judged.replay
    stamps, unbounded, blank = replay.trace.stamp_ns, replay.trace["unbounded_s"], replay.trace["is_blank"]
    if blank.any():
        yield not_evaluable(
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
    if (share := float(unbounded.sum()) / duration) > config.unjudged:
        longest = int(np.argmax(unbounded))
        yield not_evaluable(
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
        yield not_evaluable(
            criterion="judged states",
            sentence=f"{dropped} logged states were dropped: they repeat a stamp with other positions",
            value=float(dropped),
            threshold=config.unjudged,
            remedy="stamp every state with its own time, or give --stamps log",
            count=len(stamps),
        )
    if replay.lead_in_s > config.lead_in:
        yield not_evaluable(
            sentence=f"the first {replay.lead_in_s:.2f} s ({replay.num_before_scene} states) come before the first "
            "map",
            value=replay.lead_in_s,
            threshold=config.lead_in,
            unit="s",
            remedy="judge the rest alone with --start-time first-map",
            count=judged.replay.num_states,
        )


def _clock_offset(judged: Judged) -> Reason | None:
    clock = judged.logged.clock
    if clock is None or clock.offset_s is None or clock.uncertainty_s is None:
        return None
    side = "ahead of" if clock.offset_s > 0 else "behind"
    words = f"{side} the robot's (+- {1e3 * clock.uncertainty_s:.0f} ms)"
    return not_evaluable(sentence=words, value=abs(float(clock.offset_s)), count=clock.num_intervals)


CLOCKS = Bound(
    on=_clock_offset,
    at_most=CLOCKS_APART,
    tolerance=attrgetter("logged.clock.uncertainty_s"),
    unit="s",
    say="the cameras' clock is {ms:.0f} ms {words}, allowed {allowed_ms:.0f} ms",
    passed="{ms:.0f} ms apart",
    remedy="synchronise the clocks, or shift one in the log",
)

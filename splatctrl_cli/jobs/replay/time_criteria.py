"""Criteria of a replay's verdict: that the evidence is of the time that it judges."""

from collections.abc import Iterator

import numpy as np

from splatctrl_cli.config.fixed import CLOCKS_APART, SAME_MOMENT_NS
from splatctrl_cli.control.events import EventKind
from splatctrl_cli.evaluate.verdict import Reason, counted, failed, held, lacking
from splatctrl_cli.jobs.replay.criteria_input import (
    CONTACT,
    MARGIN,
    SLOW,
    Judged,
    events_of,
    mm,
    nearby,
    seconds_at,
)
from splatctrl_cli.jobs.replay.metrics import is_blank


def evidence_age(judged: Judged) -> Iterator[Reason]:
    """The depth about the arm is at most `--max-map-age` old, none is newer than the state that it judges, and where
    there was none for half a second the next shows nothing in the arm's place of that time. Frames without depth do
    not count; a baked field does not say when it was seen (a note).
    """
    yield from _unwatched(judged)
    ahead = nearby(judged, judged.replay.near["ahead"])
    allowed = SAME_MOMENT_NS / 1e9  # the frames of one time step lie apart
    if ahead is not None and ahead[0] > allowed:
        yield lacking(
            sentence=f"the newest depth near the arm is {ahead[0]:.2f} s later than the state that it judges",
            value=-ahead[0],
            threshold=-allowed,
            unit="s",
            time_s=ahead[1],
            remedy="a state is judged by what was known then: reconstruct with snapshots, or check the clocks",
            count=ahead[2],
        )
    near = nearby(judged, judged.replay.near["age"])
    if near is not None and near[0] > judged.request.max_map_age:
        words, remedy = _after_end(judged, near[0], near[1])
        yield lacking(
            sentence=f"{words}the newest depth near the arm is {near[0]:.2f} s old, allowed "
            f"{judged.request.max_map_age:g} s",
            value=near[0],
            threshold=judged.request.max_map_age,
            unit="s",
            time_s=near[1],
            remedy=remedy
            or "frames that have no depth or repeat it do not count: check the cameras ('splatctrl check')",
            count=near[2],
        )
    elif near is not None:
        words = f"depth from about the arm at most {near[0]:.2f} s before"
        yield held(words, near[0], judged.request.max_map_age, "s", near[2])


def _after_end(judged: Judged, age: float, time_s: float) -> tuple[str, str]:
    """First words and the remedy where evidence of an age [s] at a time is too old because the log had ended; else
    empty.
    """
    lasts = float(judged.replay.audit.stamp_ns[-1] - judged.replay.audit.stamp_ns[0]) * 1e-9 - judged.past_end_s
    at_end = age - (time_s - lasts)
    if not judged.past_end_s or at_end > judged.request.max_map_age + SAME_MOMENT_NS / 1e9:
        return "", ""
    remedy = f"end it with the log (--set control.max_time={max(lasts, 0.01):.3g}), start earlier (--start-time), or"
    return f"the motion goes on {judged.past_end_s:.2f} s past the end of the log, and ", f"{remedy} record longer"


def _unwatched(judged: Judged) -> Iterator[Reason]:
    """What the next depth shows of a time without any."""
    first_ns, margin = int(judged.replay.audit.stamp_ns[0]), judged.replay.margin
    for found in judged.replay.unwatched:
        since, until, when = ((ns - first_ns) * 1e-9 for ns in (found.since_ns, found.until_ns, found.stamp_ns))
        yield lacking(
            sentence=f"no camera gave depth from about the arm from {since:.2f} to {until:.2f} s, and then a thing "
            f"is {mm(found.clearance)} from where the arm was, margin {mm(margin)},",
            value=found.clearance,
            threshold=margin,
            unit="m",
            time_s=when,
            remedy="nobody can say when it came: cameras must give depth all the time",
            count=judged.num_states,
        )


def map_age(judged: Judged) -> Iterator[Reason]:
    """The map is at most `--max-map-age` old (of a baked field, the time from its moment), and newer depth shows
    nothing within the margin of a state: depth of its own time that a late map (`--latency`) did not have yet, or the
    next depth after the last state.
    """
    yield from _overtaken(judged)
    ages, allowed = np.asarray(judged.replay.map_age_s), judged.request.max_map_age
    known = ages[np.isfinite(ages)]
    if not len(known):
        if judged.request.field is not None and judged.inputs.source.has_clock:
            yield lacking(
                sentence="the field does not say what time it shows",
                remedy="give --scene, or bake a reconstruction instead of bare splats",
                count=judged.num_states,
            )
        return
    most = float(known.max())
    if most <= allowed:
        yield held(f"at most {most:.2f} s", most, allowed, "s", len(known))
        return
    worst = max(events_of(judged.replay, EventKind.STALE_MAP), key=lambda event: event.worst)
    words, remedy = _after_end(judged, most, worst.worst_s)
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
    """The worst state in depth of its own time, and the last state in the next depth."""
    first_ns, margin = int(judged.replay.audit.stamp_ns[0]), judged.replay.margin
    found = sorted(judged.replay.overtaken, key=lambda each: each.clearance)
    for worst in [each for each in found if each.depth_ns <= each.stamp_ns][:1]:
        yield failed(
            sentence=f"depth of {(worst.depth_ns - first_ns) * 1e-9:.2f} s, which the map of then did not have yet, "
            f"shows a thing {mm(worst.clearance)} from the arm, margin {mm(margin)},",
            value=worst.clearance,
            threshold=margin,
            unit="m",
            time_s=(worst.stamp_ns - first_ns) * 1e-9,
            remedy="the map comes too late for this motion: lower --latency, or drive more slowly",
            count=judged.num_states,
            label=CONTACT if worst.clearance < 0 else MARGIN,
        )
    for last in [each for each in found if each.depth_ns > each.stamp_ns][:1]:
        yield lacking(
            sentence=f"the next depth, {(last.depth_ns - last.stamp_ns) * 1e-9:.2f} s after the last state, shows a "
            f"thing {mm(last.clearance)} from where the arm is, margin {mm(margin)},",
            value=last.clearance,
            threshold=margin,
            unit="m",
            time_s=(last.stamp_ns - first_ns) * 1e-9,
            remedy="nobody can say whether it came before: judge a longer time",
            count=judged.num_states,
        )


def judged_time(judged: Judged) -> Iterator[Reason]:
    """No gap longer than `verdict.longest_interval` in which the arm could reach the margin within its velocity
    limits; no state without a distance or dropped for its stamp (*judged states*); at most `verdict.lead_in` before
    the first map.
    """
    config, stamps = judged.request.config.verdict, judged.replay.audit.stamp_ns
    blank = is_blank(judged.replay)
    if blank.any():
        yield lacking(
            criterion="judged states",
            sentence=f"the path leaves known space: at {int(blank.sum())} of {len(stamps)} states a sphere is where "
            "the field has no distance, first",
            value=float(blank.mean()),
            threshold=config.unjudged,
            time_s=seconds_at(judged, int(np.argmax(blank))),
            remedy="bake with field.unknown = free or obstacle, over a box that holds the motion",
            count=len(stamps),
        )
    yield from _gaps(judged)
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
    yield from _lead_in(judged)


def _gaps(judged: Judged) -> Iterator[Reason]:
    """Between states too far apart to bound the motion."""
    replay, config = judged.replay, judged.request.config.verdict
    stamps, unbounded = replay.audit.stamp_ns, replay.between["unbounded"]
    duration = max(float(stamps[-1] - stamps[0]) * 1e-9, 1e-9)
    share = float(unbounded.sum()) / duration
    if share > config.unjudged:
        worst = max(events_of(replay, EventKind.NOT_BOUNDED), key=lambda event: event.worst)
        yield lacking(
            sentence=f"{float(unbounded.sum()):.2f} s of {duration:.2f} s lie between states too far apart to bound "
            f"the motion ({counted(int((unbounded > 0).sum()), 'gap')}, the longest {worst.worst:.2f} s, ending",
            value=share,
            threshold=config.unjudged,
            time_s=worst.worst_s,
            cause=f"expected at most {config.longest_interval:g} s)",
            remedy=SLOW,
            count=len(stamps),
        )


def clocks(judged: Judged) -> Iterator[Reason]:
    """Cameras and robot agree within 50 ms beyond the estimate's own uncertainty."""
    clock = judged.logged.clock
    if clock is None or clock.offset_s is None or clock.uncertainty_s is None:
        return
    offset, uncertainty = float(clock.offset_s), float(clock.uncertainty_s)
    apart = abs(offset) - uncertainty
    if apart <= CLOCKS_APART:
        yield held(f"{1e3 * abs(offset):.0f} ms apart", abs(offset), CLOCKS_APART, "s", clock.num_intervals)
        return
    yield lacking(
        sentence=f"the cameras' clock is {1e3 * abs(offset):.0f} ms {'ahead of' if offset > 0 else 'behind'} "
        f"the robot's (+- {1e3 * uncertainty:.0f} ms)",
        value=abs(offset),
        threshold=CLOCKS_APART,
        unit="s",
        remedy="synchronise the clocks, or shift one in the log",
        count=clock.num_intervals,
    )


def _lead_in(judged: Judged) -> Iterator[Reason]:
    """States before the first map."""
    replay = judged.replay
    if not replay.lead_in_s > judged.request.config.verdict.lead_in:
        return
    yield lacking(
        sentence=f"the first {replay.lead_in_s:.2f} s ({replay.num_before_scene} states) come before the first map",
        value=replay.lead_in_s,
        threshold=judged.request.config.verdict.lead_in,
        unit="s",
        remedy="judge the rest alone with --start-time first-map",
        count=judged.num_states,
    )

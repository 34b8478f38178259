"""Criteria of a replay's verdict: whether the evidence reaches."""

from collections.abc import Iterator

import numpy as np

from splatctrl_cli.config.fixed import (
    BLIND,
    CLOCKS_APART,
    COARSE_VOXEL,
    HIDDEN,
    MISPLACED,
    SAME_MOMENT_NS,
    SOME_UNSEEN,
    UNSEEN,
)
from splatctrl_cli.control.events import EventKind
from splatctrl_cli.evaluate.conformal import ConformalBound
from splatctrl_cli.evaluate.verdict import Criterion, Reason, held, lacking
from splatctrl_cli.jobs.replays.criteria_input import (
    SLOW,
    UNKNOWN,
    Judged,
    counted,
    events_of,
    least_of,
    mm,
    nearby,
    seconds_at,
)
from splatctrl_cli.jobs.replays.metrics import is_blank


def known_space(judged: Judged) -> Iterator[Reason]:
    """Cameras saw at least 53 % of the space around the moving arm; where they saw less than two thirds, at most 9 %
    of the moving spheres come to space of which less than a tenth was seen; at most `--max-unknown` of the sphere
    centres are in space never seen; the margin about the arm reaches no unseen space within 30 mm of a surface, nor a
    place where cameras looked and got no depth. A baked field needs its channel `observed`.
    """
    for column, allowed, least, words in (
        ("unseen", UNSEEN, 0.0, "of the space about the arm that the motion comes to was never seen by a camera"),
        (
            "blind",
            BLIND,
            SOME_UNSEEN,
            "of the moving spheres come to space of which a camera never saw more than a tenth",
        ),
    ):
        near = nearby(judged, column, judged.replay.near["unseen"] >= least)
        if near is not None and near[0] > allowed:
            yield lacking(
                sentence=f"{100 * near[0]:.0f} % {words}, allowed {100 * allowed:g} %",
                value=near[0],
                threshold=allowed,
                time_s=near[1],
                remedy="add a camera that sees where the arm goes",
                count=near[2],
            )
        elif near is not None:
            yield held(f"{100 * near[0]:.0f} % {words}", near[0], allowed, "", near[2])
    yield from _hidden(judged)
    yield from _unanswered(judged)
    yield from _unknown_share(judged)


def _unknown_share(judged: Judged) -> Iterator[Reason]:
    """Of the sphere centres, in space that no camera saw and the robot never was in."""
    share, allowed = judged.metrics["unknown_share"], judged.request.max_unknown
    if share is None:
        yield lacking(sentence="what cameras saw is not recorded")
        return
    if share <= allowed:
        yield held(f"{100 * share:.2g} % of sphere centres in unseen space", share, allowed, "", judged.num_states)
        return
    first = int(np.argmax(judged.replay.audit.unknown_share > allowed))
    yield lacking(
        sentence=f"{100 * share:.1f} % of the sphere centres lie in space no camera ever saw, allowed "
        f"{100 * allowed:g} %, first",
        value=share,
        threshold=allowed,
        time_s=seconds_at(judged, first),
        remedy="add a camera, or give a larger --max-unknown",
        count=judged.num_states,
    )


def _hidden(judged: Judged) -> Iterator[Reason]:
    """Space that no camera saw, a margin away from the arm and close to a surface of the map: one side of a thing
    says little of where the other ends.
    """
    distance, margin = judged.replay.near["hidden"], judged.replay.margin
    if not np.any(distance < HIDDEN):
        return
    worst = int(np.nanargmin(distance))
    yield lacking(
        sentence=f"space that no camera saw is {mm(margin)} from the arm, the margin, and "
        f"{mm(max(distance[worst], 0.0))} from a surface of the map: it may go on there, allowed {mm(HIDDEN)}",
        value=float(distance[worst]),
        threshold=HIDDEN,
        unit="m",
        time_s=seconds_at(judged, worst),
        place=tuple(judged.replay.near["hidden_place"][worst].tolist()),
        cause="at ({:.2f}, {:.2f}, {:.2f}) m".format(*judged.replay.near["hidden_place"][worst]),
        remedy="add a camera that sees that side",
        count=int((distance < HIDDEN).sum()),
    )


def _unanswered(judged: Judged) -> Iterator[Reason]:
    """Where cameras looked and got no depth, within the margin of the arm: a dark or shiny thing may stand there."""
    distance, margin = judged.replay.near["unanswered"], judged.replay.margin
    if not np.any(distance < margin):
        return
    worst = int(np.nanargmin(distance))
    yield lacking(
        sentence=f"cameras looked at a place {mm(distance[worst])} from the arm and got no depth from it, margin "
        f"{mm(margin)}",
        value=float(distance[worst]),
        threshold=margin,
        unit="m",
        time_s=seconds_at(judged, worst),
        place=tuple(judged.replay.near["place"][worst].tolist()),
        cause="at ({:.2f}, {:.2f}, {:.2f}) m".format(*judged.replay.near["place"][worst]),
        remedy="a dark, shiny or clear thing may stand there: add a camera that gets depth there",
        count=int(np.isfinite(distance).sum()),
    )


def evidence_age(judged: Judged) -> Iterator[Reason]:
    """The depth about the arm is at most `--max-map-age` old, none is newer than the state that it judges, and where
    there was none for half a second the next shows nothing in the arm's place of that time. Frames without depth do
    not count; a baked field does not say when it was seen (a note).
    """
    yield from _unwatched(judged)
    ahead = nearby(judged, "ahead")
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
    near = nearby(judged, "age")
    if near is not None and near[0] > judged.request.max_map_age:
        yield lacking(
            sentence=f"the newest depth near the arm is {near[0]:.2f} s old, allowed "
            f"{judged.request.max_map_age:g} s",
            value=near[0],
            threshold=judged.request.max_map_age,
            unit="s",
            time_s=near[1],
            remedy="frames without depth do not count: check the cameras ('splatctrl check')",
            count=near[2],
        )
    elif near is not None:
        words = f"depth from about the arm at most {near[0]:.2f} s before"
        yield held(words, near[0], judged.request.max_map_age, "s", near[2])


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
    """The map is at most `--max-map-age` old; of a baked field, the time from its moment."""
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
    yield lacking(
        sentence=f"the map is up to {most:.2f} s old, allowed {allowed:g} s, from {worst.start_s:.2f} to "
        f"{worst.end_s:.2f} s",
        value=most,
        threshold=allowed,
        unit="s",
        time_s=worst.worst_s,
        remedy="the cameras must cover the motion in time; --max-map-age says how old a map may be",
        count=len(known),
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


def map_error(judged: Judged) -> Iterator[Reason]:
    """With `--evidence`: the surface clearance less the bound on the map's error is at least 0.

    With a smaller clearance no contact was seen, but the map cannot exclude one: not
    evaluable, unless another measure fails. So is evidence that is too little for a bound.
    """
    found, surface = judged.replay.map_error, least_of(judged.replay.between["surface"])
    if found is None:
        if judged.request.require_evidence:
            yield lacking(sentence="not measured", remedy="give --evidence a camera that did not train the map")
        return
    if found.bound is None:
        yield lacking(
            sentence=f"not bounded: of {found.num_sets} held-out frame sets in the judged time {found.num_seen} show "
            "surface near the motion, too few for two independent stretches",
            who=found.source,
            remedy="judge a longer motion, or name another camera; verdict.evidence_reach says how near",
            count=found.num_seen,
        )
        return
    value = found.bound.bound
    if surface is None:
        return  # no distance at any state, which is said of them
    if surface >= value:
        yield held(bound_words(found.bound), surface - value, 0.0, "m", found.num_points)
        return
    yield lacking(
        sentence=f"the map may miss surface by {mm(value)} ({bound_words(found.bound)}), but the motion keeps only "
        f"{mm(surface)}; it missed most",
        value=surface - value,
        threshold=0.0,
        unit="m",
        time_s=found.time_s,
        place=found.place,
        who=found.source,
        cause="" if found.place is None else "at ({:.2f}, {:.2f}, {:.2f}) m".format(*found.place),
        remedy="a map that misses less needs more cameras, newer frames or a larger --max-splats",
        count=found.num_points,
    )


def bound_words(bound: ConformalBound) -> str:
    """The bound on the map's error, and what it rests on."""
    return (
        f"map error at most {mm(bound.bound)} with {100 * bound.confidence:.3g} % confidence from "
        f"{bound.num_stretches} stretches of held-out depth"
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


def belonging(judged: Judged) -> Iterator[Reason]:
    """Scene, log and robot belong together: digests, first frames, calibration, times, joints, links; files as
    written; splats that agree with their occupancy grid.
    """
    for mismatch in judged.inputs.mismatches:
        yield lacking(sentence=mismatch.sentence, remedy=mismatch.remedy)


def calibration(judged: Judged) -> Iterator[Reason]:
    """The cameras see the robot within 5 mm of where its joints put it."""
    figures = judged.inputs.scene.figures()
    residual, by_link = figures.get("self_mask_residual_mm"), figures.get("self_mask")
    if residual is None or not isinstance(by_link, dict):
        return
    value = 1e-3 * float(residual)
    if value <= MISPLACED:
        yield held(f"the robot is seen within {mm(value)}", value, MISPLACED, "m", len(by_link))
        return
    link, worst = max(by_link.items(), key=lambda item: abs(float(item[1]["median_mm"])))
    yield lacking(
        sentence=f"the cameras see {link} {mm(value)} {'behind' if worst['sign'] > 0 else 'before'} where its "
        f"joints put it, allowed {mm(MISPLACED)}",
        value=value,
        threshold=MISPLACED,
        unit="m",
        who=str(link),
        remedy="calibrate the cameras ('splatctrl check'), or correct URDF, joint zeros or depth scale",
        count=int(worst["num_pixels"]),
    )


def map_resolution(judged: Judged) -> Iterator[Reason]:
    """The map's voxels are at most 25 mm: what no splat stands for may be as large as one."""
    voxel = judged.inputs.scene.figures().get("voxel")
    if voxel is None or voxel <= COARSE_VOXEL:
        return
    yield lacking(
        sentence=f"the map has voxels of {mm(voxel)}, allowed {mm(COARSE_VOXEL)} beside a robot",
        value=float(voxel),
        threshold=COARSE_VOXEL,
        unit="m",
        remedy="reconstruct with --urdf, or with --set scene.scale=1",
    )


OF_EVIDENCE: tuple[Criterion[Judged], ...] = (
    Criterion(name="map error", find=map_error, broken=UNKNOWN),
    Criterion(name="evidence", find=belonging, broken=f"{UNKNOWN}; a changed file is refused (exit 4)"),
    Criterion(name="calibration", find=calibration, broken=UNKNOWN),
    Criterion(name="map resolution", find=map_resolution, broken=UNKNOWN),
    Criterion(name="judged time", find=judged_time, broken=f"{UNKNOWN}; `--start-time first-map` judges the rest"),
    Criterion(name="known space", find=known_space, broken=UNKNOWN),
    Criterion(name="evidence age", find=evidence_age, broken=UNKNOWN),
    Criterion(name="map age", find=map_age, broken=UNKNOWN),
    Criterion(name="clocks", find=clocks, broken=UNKNOWN),
)

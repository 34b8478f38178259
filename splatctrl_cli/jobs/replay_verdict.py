"""The verdict of a replay: every criterion of *safe*, with what it found, when, where and what to do about it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.control.explain import Event, EventKind
from splatctrl_cli.control.replay import Outcome as LoopOutcome
from splatctrl_cli.evaluate.conformal import ConformalBound
from splatctrl_cli.evaluate.gates import gate_reasons
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.jobs.replay_golden import Golden, golden_reason
from splatctrl_cli.jobs.replay_metrics import Metrics, first_time
from splatctrl_cli.jobs.replay_modes import Replay
from splatctrl_cli.jobs.replay_record import SLIGHT
from splatctrl_cli.jobs.replay_request import ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replay_states import LoggedStates

SAFE, MARGIN, CONTACT, LIMITS, CONTROL = "safe", "margin broken", "contact", "limits broken", "controller failed"
STATIC_CHANGE = 0.01  # [m] by which a fixed sphere must come nearer to count: splats move by less about a surface
MOUNTED = 0.03  # [m] the same of one that stands near its mount, whose map grows in the first frames
CLOCKS_APART = 0.05  # [s] beyond the estimate's own uncertainty: at 0.5 m/s an arm is then 25 mm elsewhere
UNSEEN = 0.5  # of the points about the arm: three cameras about a table leave 0.02 to 0.3
MISPLACED = 0.005  # [m] of the robot's own surface, in the median: 0.1 mm on a calibrated rig
TOO_MUCH = 1.01  # of a velocity or acceleration limit
ASKED = ("--require", "golden")  # criteria that the request itself asked for
SLOW = "log joint states more often"


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What the criteria look at."""

    request: ReplayRequest
    inputs: ReplayInputs
    logged: LoggedStates
    replay: Replay
    metrics: Metrics

    @property
    def threshold(self) -> float:
        """The margin [m], less what solver and rounding may leave."""
        return self.replay.margin - SLIGHT

    @property
    def num_states(self) -> int:
        """That were judged."""
        return len(self.replay.audit.stamp_ns)


def replay_verdict(judged: Judged, golden: Golden | None = None) -> Verdict:
    """The verdict on a replay: every criterion, each ``--require`` of its request, and the golden run where one is
    given.
    """
    replay, request = judged.replay, judged.request
    reasons: list[Reason] = []
    for criterion in CRITERIA:
        reasons += criterion(judged)
    reasons.sort(key=lambda reason: reason.label != CONTACT)  # by any measure, before what only broke a margin
    reasons += gate_reasons(
        request.require, judged.metrics, first_time=lambda name, holds: first_time(replay, name, holds)
    )
    if golden is not None:
        reasons.append(golden_reason(golden, replay, request.golden_tolerance))
    stamps = replay.audit.stamp_ns
    first, last = replay.start_time_s, replay.start_time_s + float(stamps[-1] - stamps[0]) * 1e-9
    motion = "driven" if replay.closed_loop else "logged"
    return verdict_of(
        "replay",
        reasons,
        scope=f"{motion} motion from {first:.2f} to {last:.2f} s of the log, {len(stamps)} states",
        passed=SAFE,
        notes=_notes(judged),
    )


def _clearance(judged: Judged) -> Iterator[Reason]:
    """The exact distance to the splats; of a grid the interpolated one, and the bound that interpolation cannot
    break: what only the bound breaks is a matter of the grid.
    """
    yield from _by_source(judged, "exact", "clearance")
    clearance = judged.replay.audit.clearance
    if "certified" in clearance:
        least, exact = (_least(clearance[name].distance) for name in ("certified", "exact"))
        if least is not None and exact is not None and least < judged.threshold <= exact:
            room, loss = exact - judged.threshold, exact - least
            voxel = judged.metrics.get("voxel") or 0.02
            yield Reason(
                criterion="certified clearance",
                outcome=Outcome.NOT_EVALUABLE,
                sentence=f"the grid is too coarse: its certified bound is {_mm(least)}, its interpolated value "
                f"{_mm(exact)}",
                value=least,
                threshold=judged.replay.margin,
                unit="m",
                remedy=f"bake again with --voxel at most {max(voxel * room / loss, 1e-3):.2g}, or give --scene",
                count=judged.num_states,
            )
        else:
            yield from _by_source(judged, "certified", "certified clearance")
    if judged.inputs.scene.has_people_margin:
        yield from _by_source(judged, "barrier", "clearance of people")
    if judged.replay.true_clearance is not None:
        yield from _by_source(judged, "true", "true clearance")


def _by_source(judged: Judged, source: str, criterion: str) -> Iterator[Reason]:
    """Contact, margin broken or kept, by one of the distances."""
    replay = judged.replay
    represented = _least(replay.between["represented"])
    if source == "exact" and represented is not None and represented >= judged.threshold:
        yield from _unrepresented(judged)
        return
    values = replay.true_clearance if source == "true" else replay.audit.clearance[source].distance
    least = _least(np.asarray(values))
    if least is None:
        return
    if least >= judged.threshold:
        yield _passed(criterion, f"at least {_mm(least)}", least, replay.margin, "m", judged.num_states)
        return
    kind = EventKind.IN_COLLISION if least < 0 else EventKind.BELOW_MARGIN
    events = _events(replay, kind, source)
    worst = min(events, key=lambda event: event.worst)
    states = sum(event.num_states for event in events)
    yield Reason(
        criterion=criterion,
        outcome=Outcome.FAILED,
        sentence=f"{worst.worst_name} is {_mm(abs(least))} {'deep in the scene' if least < 0 else 'from the scene'}, "
        f"margin {_mm(replay.margin)}, {states} states in {_counted(len(events), 'interval')}, worst",
        value=least,
        threshold=replay.margin,
        unit="m",
        time_s=worst.worst_s,
        place=None if worst.obstacle is None else worst.obstacle.position,
        who=worst.worst_name,
        cause="" if worst.obstacle is None else f"near {worst.obstacle}",
        count=judged.num_states,
        label=CONTACT if least < 0 else MARGIN,
    )


def _unrepresented(judged: Judged) -> Iterator[Reason]:
    """Kept by the splats; where the voxels without one break the margin the map does not suffice."""
    replay = judged.replay
    least = _least(replay.audit.clearance["exact"].distance)
    represented = _least(replay.between["represented"])
    assert least is not None
    if least >= judged.threshold:
        yield _passed("clearance", f"at least {_mm(least)}", least, replay.margin, "m", judged.num_states)
        return
    worst = min(_events(replay, EventKind.BELOW_MARGIN, "exact"), key=lambda event: event.worst)
    yield Reason(
        criterion="clearance",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"{worst.worst_name} is {_mm(least)} from space that is occupied and has no splat (the splats are "
        f"{_mm(represented or 0.0)} away), margin {_mm(replay.margin)}",
        value=least,
        threshold=replay.margin,
        unit="m",
        time_s=worst.worst_s,
        place=None if worst.obstacle is None else worst.obstacle.position,
        who=worst.worst_name,
        cause="" if worst.obstacle is None else f"near {worst.obstacle}",
        remedy="the map is starved: raise --max-splats",
        count=judged.num_states,
    )


def _surface(judged: Judged) -> Iterator[Reason]:
    """The clearance of the body, not of its spheres: less what they leave uncovered; and between the states."""
    replay, model = judged.replay, judged.replay.model
    clearance = replay.audit.clearance
    spheres = _least(clearance["certified" if "certified" in clearance else "exact"].distance)  # as `surface` is
    moving = np.asarray(model.moving_spheres)
    if np.isnan(model.sphere_deficit[moving]).any():
        yield Reason(
            criterion="surface clearance",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"how much of the robot its spheres cover is not known: {model.coverage_unknown}",
            remedy="give a URDF with collision geometry (--packages finds its meshes)",
        )
        return
    bare = _bare_moving_links(judged)
    if bare:
        yield Reason(
            criterion="surface clearance",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"no sphere on {', '.join(bare)}: nothing is known of their clearance",
            who=bare[0],
            remedy=f"fit a set that covers them: splatctrl robot spheres --urdf {judged.request.urdf}",
        )
    surface, between = _least(replay.between["surface"]), _least(replay.between["lower"])
    if spheres is None or surface is None or spheres < judged.threshold:
        return  # said of the spheres already
    if surface < judged.threshold:
        deficit = float(np.nanmax(model.sphere_deficit[moving]))
        yield Reason(
            criterion="surface clearance",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"the spheres keep {_mm(spheres)}, the surface {_mm(surface)} for certain: they leave up to "
            f"{_mm(deficit)} of it uncovered",
            value=surface,
            threshold=replay.margin,
            unit="m",
            time_s=_time_of_least(judged, replay.between["surface"]),
            remedy="use spheres that cover the robot: splatctrl robot spheres",
            count=judged.num_states,
        )
    elif between is not None and between < judged.threshold:
        yield Reason(
            criterion="clearance between states",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"the arm may have come within {_mm(between)} between two states",
            value=between,
            threshold=replay.margin,
            unit="m",
            time_s=_time_of_least(judged, replay.between["lower"]),
            remedy=SLOW,
            count=judged.num_states,
        )
    else:
        yield _passed("surface clearance", f"at least {_mm(surface)}", surface, replay.margin, "m", judged.num_states)


def _self(judged: Judged) -> Iterator[Reason]:
    """The arm against itself."""
    least = _least(judged.replay.audit.self_clearance)
    events = _events(judged.replay, EventKind.SELF_COLLISION)
    if least is None or not np.isfinite(least):
        return
    if not events:
        yield _passed("self-clearance", f"at least {_mm(least)}", least, 0.0, "m", judged.num_states)
        return
    worst = min(events, key=lambda event: event.worst)
    yield Reason(
        criterion="self-clearance",
        outcome=Outcome.FAILED,
        sentence=f"{worst.worst_name} are {_mm(-worst.worst)} deep in each other",
        value=worst.worst,
        threshold=0.0,
        unit="m",
        time_s=worst.worst_s,
        who=worst.worst_name,
        remedy="pairs that may touch are named by --srdf",
        count=judged.num_states,
        label=CONTACT,
    )


def _statics(judged: Judged) -> Iterator[Reason]:
    """Spheres that no joint moves: what stands at their mount is no news, what comes nearer is."""
    broken = {
        name: (first, least)
        for name, (first, least) in judged.replay.statics.items()
        if least < judged.threshold and least < first - (MOUNTED if first < 2 * judged.threshold else STATIC_CHANGE)
    }
    if broken:
        name, (first, least) = min(broken.items(), key=lambda item: item[1][1])
        yield Reason(
            criterion="static clearance",
            outcome=Outcome.FAILED,
            sentence=f"the scene comes within {_mm(least)} of {name}, which no joint moves (at first {_mm(first)})",
            value=least,
            threshold=judged.replay.margin,
            unit="m",
            who=name,
            count=len(judged.replay.statics),
            label=CONTACT if least < 0 else MARGIN,
        )


def _limits(judged: Judged) -> Iterator[Reason]:
    """Position, velocity and acceleration limits of the motion."""
    replay, tolerance = judged.replay, judged.request.config.control.limit_tolerance
    names = replay.model.joint_names
    margins = replay.audit.limit_margin
    least = _least(margins)
    if least is not None and least < -tolerance:
        worst = min(_events(replay, EventKind.OUTSIDE_LIMITS), key=lambda event: event.worst)
        yield Reason(
            criterion="position limits",
            outcome=Outcome.FAILED,
            sentence=f"{worst.worst_name} is {-least:.4f} rad or m outside its limits",
            value=least,
            threshold=0.0,
            unit="rad",
            time_s=worst.worst_s,
            who=worst.worst_name,
            remedy="check that the URDF is of this robot, and the units and wrapping of its joints",
            count=judged.num_states,
            label=LIMITS,
        )
    elif least is not None:
        yield _passed("position limits", f"at least {least:.3f} rad inside", least, 0.0, "rad", judged.num_states)
    for kind, column, what in (
        (EventKind.TOO_FAST, "velocity", "velocity limits"),
        (EventKind.TOO_SUDDEN, "acceleration", "acceleration limits"),
    ):
        values = replay.strain[column]
        most = float(np.max(values)) if len(values) else 0.0
        if most > TOO_MUCH:
            worst = max(_events(replay, kind), key=lambda event: event.worst)
            yield Reason(
                criterion=what,
                outcome=Outcome.FAILED,
                sentence=f"{worst.worst_name} reaches {most:.2f} times its limit",
                value=most,
                threshold=1.0,
                time_s=worst.worst_s,
                who=worst.worst_name,
                remedy="check the stamps and units of the states, and the URDF's limits",
                count=judged.num_states,
                label=LIMITS,
            )
        elif len(names) and (kind is EventKind.TOO_FAST or most > 0):
            yield _passed(what, f"at most {most:.2f} of the limit", most, 1.0, "", judged.num_states)


def _unknown(judged: Judged) -> Iterator[Reason]:
    """Space that no camera ever saw: where the arm's spheres are, and about them where the motion newly comes."""
    near = _near(judged, "unseen")
    if near is not None and near[0] > UNSEEN:
        yield Reason(
            criterion="known space",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"{100 * near[0]:.0f} % of the space about the arm that the motion comes to was never seen by a "
            f"camera, allowed {100 * UNSEEN:g} %",
            value=near[0],
            threshold=UNSEEN,
            time_s=near[1],
            remedy="add a camera that sees where the arm goes",
            count=near[2],
        )
    share, allowed = judged.metrics["unknown_share"], judged.request.max_unknown
    if share is None:
        yield Reason(
            criterion="known space", outcome=Outcome.NOT_EVALUABLE, sentence="what cameras saw is not recorded"
        )
        return
    if share <= allowed:
        yield _passed(
            "known space",
            f"{100 * share:.2g} % of sphere centres in unseen space",
            share,
            allowed,
            "",
            judged.num_states,
        )
        return
    first = int(np.argmax(judged.replay.audit.unknown_share > allowed))
    yield Reason(
        criterion="known space",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"{100 * share:.1f} % of the sphere centres lie in space no camera ever saw, allowed "
        f"{100 * allowed:g} %, first",
        value=share,
        threshold=allowed,
        time_s=_seconds(judged, first),
        remedy="add a camera, or give a larger --max-unknown",
        count=judged.num_states,
    )


def _age(judged: Judged) -> Iterator[Reason]:
    """How old the map was that a state was judged by, and the evidence about the arm."""
    near = _near(judged, "age")
    if near is not None and near[0] > judged.request.max_map_age:
        yield Reason(
            criterion="evidence age",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"the cameras last returned depth from about the arm {near[0]:.2f} s before, allowed "
            f"{judged.request.max_map_age:g} s",
            value=near[0],
            threshold=judged.request.max_map_age,
            unit="s",
            time_s=near[1],
            remedy="frames without depth renew nothing: check the cameras ('splatctrl check')",
            count=near[2],
        )
    ages, allowed = np.asarray(judged.replay.map_age_s), judged.request.max_map_age
    known = ages[np.isfinite(ages)]
    if not len(known):
        if judged.request.field is not None and judged.inputs.source.has_clock:
            yield Reason(
                criterion="map age",
                outcome=Outcome.NOT_EVALUABLE,
                sentence="the field does not say of what time it is",
                remedy="give --scene, or bake a reconstruction instead of bare splats",
                count=judged.num_states,
            )
        return
    most = float(known.max())
    if most <= allowed:
        yield _passed("map age", f"at most {most:.2f} s", most, allowed, "s", len(known))
        return
    worst = max(_events(judged.replay, EventKind.STALE_MAP), key=lambda event: event.worst)
    yield Reason(
        criterion="map age",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"the map is up to {most:.2f} s old, allowed {allowed:g} s, from {worst.start_s:.2f} to "
        f"{worst.end_s:.2f} s",
        value=most,
        threshold=allowed,
        unit="s",
        time_s=worst.worst_s,
        remedy="the cameras must cover the motion in time; --max-map-age says how old a map may be",
        count=len(known),
    )


def _near(judged: Judged, column: str) -> tuple[float, float, int] | None:
    """The largest value of what was known about the arm, when [s], and over how many states; None without one."""
    values = judged.replay.near[column]
    num = int(np.isfinite(values).sum())
    return (float(np.nanmax(values)), _seconds(judged, int(np.nanargmax(values))), num) if num else None


def _unjudged(judged: Judged) -> Iterator[Reason]:
    """Times of the motion for which nothing was measured: gaps, states without a distance, dropped states."""
    replay, config = judged.replay, judged.request.config.verdict
    stamps = replay.audit.stamp_ns
    blank = np.zeros(len(stamps), dtype=np.bool_)
    for of in replay.audit.clearance.values():
        blank |= np.isnan(of.distance)
    if blank.any():
        yield Reason(
            criterion="judged states",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"the path leaves known space: at {int(blank.sum())} of {len(stamps)} states a sphere is where "
            "the field has no distance, first",
            value=float(blank.mean()),
            threshold=config.unjudged,
            time_s=_seconds(judged, int(np.argmax(blank))),
            remedy="bake with field.unknown = free or obstacle, over a box that holds the motion",
            count=len(stamps),
        )
    unbounded = replay.between["unbounded"]
    duration = max(float(stamps[-1] - stamps[0]) * 1e-9, 1e-9)
    share = float(unbounded.sum()) / duration
    if share > config.unjudged:
        gaps = _events(replay, EventKind.NOT_BOUNDED)
        worst = max(gaps, key=lambda event: event.worst)
        yield Reason(
            criterion="judged time",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"{float(unbounded.sum()):.2f} s of {duration:.2f} s lie between states too far apart to bound "
            f"the motion ({_counted(int((unbounded > 0).sum()), 'gap')}, the longest {worst.worst:.2f} s, ending",
            value=share,
            threshold=config.unjudged,
            time_s=worst.worst_s,
            cause=f"expected at most {config.longest_interval:g} s)",
            remedy=SLOW,
            count=len(stamps),
        )
    dropped = judged.inputs.source.loss.conflicting_states
    if dropped > config.unjudged * (dropped + len(stamps)):
        yield Reason(
            criterion="judged states",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"{dropped} logged states were dropped: they repeat a stamp with other positions",
            value=float(dropped),
            threshold=config.unjudged,
            remedy="stamp every state with its own time, or give --stamps log",
            count=len(stamps),
        )
    yield from _lead_in(judged)


def _lead_in(judged: Judged) -> Iterator[Reason]:
    """States before the first map."""
    replay = judged.replay
    if not replay.lead_in_s > judged.request.config.verdict.lead_in:
        return
    yield Reason(
        criterion="judged time",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"the first {replay.lead_in_s:.2f} s ({replay.num_before_scene} states) come before the first map",
        value=replay.lead_in_s,
        threshold=judged.request.config.verdict.lead_in,
        unit="s",
        remedy="judge the rest alone with --start-time first-map",
        count=judged.num_states,
    )


def _controller(judged: Judged) -> Iterator[Reason]:
    """Closed loop: every step solved, the scene never came into the arm, the goal reached."""
    trace, metrics = judged.replay.closed_loop, judged.metrics
    if trace is None:
        return
    bad = {name: metrics[f"num_{name}"] or 0 for name in ("relaxed", "minimum_violation", "hold")}
    if sum(bad.values()):
        kinds = (EventKind.RELAXED, EventKind.MINIMUM_VIOLATION, EventKind.HOLD)
        first = min((e for kind in kinds for e in _events(judged.replay, kind)), key=lambda e: e.first_ns)
        found = ", ".join(f"{int(count)} {name.replace('_', ' ')}" for name, count in bad.items() if count)
        yield Reason(
            criterion="controller",
            outcome=Outcome.FAILED,
            sentence=f"its rows could not be kept at {found} of {len(trace.steps)} steps, first",
            value=float(sum(bad.values())),
            threshold=0.0,
            time_s=first.start_s,
            who=first.worst_name,
            cause="" if first.obstacle is None else f"near {first.obstacle}",
            count=len(trace.steps),
            label=CONTROL,
        )
    else:
        yield _passed("controller", f"all {len(trace.steps)} steps solved", 0.0, 0.0, "", len(trace.steps))
    hits = metrics["num_scene_hits"] or 0
    if hits:
        change = next(change for change in trace.scene_changes if change.is_hit)
        yield Reason(
            criterion="scene hits",
            outcome=Outcome.FAILED,
            sentence=f"the scene came into the arm {int(hits)} times, first",
            value=float(hits),
            threshold=0.0,
            time_s=float(change.stamp_ns - judged.replay.audit.stamp_ns[0]) * 1e-9,
            count=len(trace.scene_changes),
            label=CONTACT,
        )
    if judged.request.follow or judged.request.twist_topic is not None:
        return  # ends with the log
    reached = trace.outcome is LoopOutcome.GOAL_REACHED
    yield Reason(
        criterion="goal",
        outcome=Outcome.PASSED if reached else Outcome.FAILED,
        sentence="reached" if reached else f"not reached: {trace.outcome}",
        value=float(reached),
        threshold=1.0,
        count=len(trace.steps),
        label="goal not reached",
        remedy="" if reached else "--set control.max_detours=3 lets the planner find a way round",
    )


def _map_error(judged: Judged) -> Iterator[Reason]:
    """What the map itself may miss, as held-out depth bounds it: surface clearance less the bound is at least 0.

    A smaller clearance is no contact that was seen, but one that the map cannot exclude: not evaluable, unless
    another measure fails. So is evidence that is too little for a bound.
    """
    found, surface = judged.replay.map_error, _least(judged.replay.between["surface"])
    if found is None:
        if judged.request.require_evidence:
            yield Reason(
                criterion="map error",
                outcome=Outcome.NOT_EVALUABLE,
                sentence="not measured",
                remedy="give --evidence a camera that did not train the map",
            )
        return
    if found.bound is None:
        yield Reason(
            criterion="map error",
            outcome=Outcome.NOT_EVALUABLE,
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
        yield _passed("map error", _bound_words(found.bound), surface - value, 0.0, "m", found.num_points)
        return
    yield Reason(
        criterion="map error",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"the map may miss surface by {_mm(value)} ({_bound_words(found.bound)}), and keeps {_mm(surface)}; "
        "it missed so much",
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


def _clocks(judged: Judged) -> Iterator[Reason]:
    """The cameras' clock against the robot's."""
    clock = judged.logged.clock
    if clock is None or clock.offset_s is None or clock.uncertainty_s is None:
        return
    offset, uncertainty = float(clock.offset_s), float(clock.uncertainty_s)
    apart = abs(offset) - uncertainty
    if apart <= CLOCKS_APART:
        yield _passed(
            "clocks", f"{1e3 * abs(offset):.0f} ms apart", abs(offset), CLOCKS_APART, "s", clock.num_intervals
        )
        return
    yield Reason(
        criterion="clocks",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"the cameras' clock is {1e3 * abs(offset):.0f} ms {'ahead of' if offset > 0 else 'behind'} "
        f"the robot's (+- {1e3 * uncertainty:.0f} ms)",
        value=abs(offset),
        threshold=CLOCKS_APART,
        unit="s",
        remedy="synchronise the clocks, or shift one in the log",
        count=clock.num_intervals,
    )


def _evidence(judged: Judged) -> Iterator[Reason]:
    """Whether scene, log and robot belong together."""
    for mismatch in judged.inputs.mismatches:
        yield Reason(
            criterion="evidence",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=mismatch.sentence,
            remedy=mismatch.remedy,
        )


def _calibration(judged: Judged) -> Iterator[Reason]:
    """Whether the cameras see the robot where its joints put it: what is off there is off for everything."""
    figures = judged.inputs.scene.figures()
    residual, by_link = figures.get("self_mask_residual_mm"), figures.get("self_mask")
    if residual is None or not isinstance(by_link, dict):
        return
    value = 1e-3 * float(residual)
    if value <= MISPLACED:
        yield _passed("calibration", f"the robot is seen within {_mm(value)}", value, MISPLACED, "m", len(by_link))
        return
    link, worst = max(by_link.items(), key=lambda item: abs(float(item[1]["median_mm"])))
    yield Reason(
        criterion="calibration",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"the cameras see {link} {_mm(value)} {'behind' if worst['sign'] > 0 else 'before'} where its "
        f"joints put it, allowed {_mm(MISPLACED)}",
        value=value,
        threshold=MISPLACED,
        unit="m",
        who=str(link),
        remedy="calibrate the cameras ('splatctrl check'), or correct URDF, joint zeros or depth scale",
        count=int(worst["num_pixels"]),
    )


CRITERIA = (
    _clearance,
    _self,
    _statics,
    _limits,
    _controller,
    _surface,
    _map_error,
    _evidence,
    _calibration,
    _unjudged,
    _unknown,
    _age,
    _clocks,
)
"""By weight: of several failures the first one is in the sentence."""


def _notes(judged: Judged) -> tuple[str, ...]:
    found = judged.replay.map_error
    notes = ["map error not measured"] if found is None or found.bound is None else [_bound_words(found.bound)]
    close = [name for name, (first, _) in judged.replay.statics.items() if first < judged.threshold]
    if close:
        notes.append(f"{len(close)} fixed spheres stand within the margin of their surroundings")
    if judged.replay.num_before_scene and judged.replay.lead_in_s > 0:
        notes.append(f"{judged.replay.lead_in_s:.2f} s before the first map are left out")
    notes += _declared_notes(judged)
    inside = judged.inputs.scene.figures().get("inside_robot_points")
    if inside:
        notes.append(f"{inside} measured points lie inside the robot: contact, a carried object, or calibration")
    if judged.request.re_anchor is not None:
        notes.append("the arm is put back into the log's posture on the way: nothing is said between states")
    return tuple(notes)


def _declared_notes(judged: Judged) -> list[str]:
    """Every contact that was declared, and entries that nothing used."""
    declared, notes = judged.inputs.declared, []
    for index, entry in enumerate(declared.expected_contact):
        num = declared.num_uses.get(("expected_contact", index), 0)
        used = f"{num} times" if num else "warning: not used by any state"
        notes.append(f"contact of {entry.link} declared ({entry.reason}): {used}")
    for index, carried in enumerate(declared.carried):
        is_used = declared.num_uses.get(("carried", index)) or not judged.request.lockstep
        notes.append(f"{carried.link} carries a box" + ("" if is_used else ": warning: no pixel needed it"))
    return notes


def _bound_words(bound: ConformalBound) -> str:
    """The bound on the map's error, and what it rests on."""
    return (
        f"map error at most {_mm(bound.bound)} with {100 * bound.confidence:.3g} % confidence from "
        f"{bound.num_stretches} stretches of held-out depth"
    )


def _bare_moving_links(judged: Judged) -> list[str]:
    """Links with a body, moved by a joint, that have no sphere."""
    model = judged.replay.model
    if model.coverage is None:
        return []
    bodies = model.urdf.rigid_bodies()
    children = {child for _, child in model.urdf.parents}
    return [link for link in model.coverage.bare_links if bodies[link][0] in children]


def _events(replay: Replay, kind: EventKind, source: str = "") -> Sequence[Event]:
    return [event for event in replay.events if event.kind is kind and event.source == source]


def _passed(criterion: str, sentence: str, value: float, threshold: float, unit: str, count: int) -> Reason:
    return Reason(
        criterion=criterion,
        outcome=Outcome.PASSED,
        sentence=sentence,
        value=value,
        threshold=threshold,
        unit=unit,
        count=count,
    )


def _least(values: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> float | None:
    there = values[~np.isnan(values)]
    return float(there.min()) if len(there) else None


def _time_of_least(judged: Judged, values: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> float:
    return _seconds(judged, int(np.nanargmin(values)))


def _seconds(judged: Judged, index: int) -> float:
    """Of a state, since the first."""
    stamps = judged.replay.audit.stamp_ns
    return float(stamps[index] - stamps[0]) * 1e-9


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" + ("s" if number != 1 else "")


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"

"""Criteria of a replay's verdict: the motion against the scene, itself, its limits and its goal."""

from collections.abc import Iterator

import numpy as np

from splatctrl_cli.control.events import EventKind
from splatctrl_cli.control.replay import Outcome as LoopOutcome
from splatctrl_cli.evaluate.verdict import Outcome, Reason
from splatctrl_cli.jobs.replays.judged import (
    CONTACT,
    CONTROL,
    LIMITS,
    MARGIN,
    SLOW,
    Judged,
    counted,
    events_of,
    held,
    least_of,
    mm,
    time_of_least,
)

STATIC_CHANGE = 0.01  # [m] by which a fixed sphere must come nearer to count: splats move by less about a surface
MOUNTED = 0.03  # [m] the same of one that stands near its mount, whose map grows in the first frames
TOO_MUCH = 1.01  # of a velocity or acceleration limit


def clearance(judged: Judged) -> Iterator[Reason]:
    """The exact distance to the splats; of a grid the interpolated one, and the bound that interpolation cannot
    break: what only the bound breaks is a matter of the grid.
    """
    yield from _by_source(judged, "exact", "clearance")
    clearance = judged.replay.audit.clearance
    if "certified" in clearance:
        least, exact = (least_of(clearance[name].distance) for name in ("certified", "exact"))
        if least is not None and exact is not None and least < judged.threshold <= exact:
            room, loss = exact - judged.threshold, exact - least
            voxel = judged.metrics.get("voxel") or 0.02
            yield Reason(
                criterion="certified clearance",
                outcome=Outcome.NOT_EVALUABLE,
                sentence=f"the grid is too coarse: its certified bound is {mm(least)}, its interpolated value "
                f"{mm(exact)}",
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
    represented = least_of(replay.between["represented"])
    if source == "exact" and represented is not None and represented >= judged.threshold:
        yield from _unrepresented(judged)
        return
    values = replay.true_clearance if source == "true" else replay.audit.clearance[source].distance
    least = least_of(np.asarray(values))
    if least is None:
        return
    if least >= judged.threshold:
        yield held(criterion, f"at least {mm(least)}", least, replay.margin, "m", judged.num_states)
        return
    kind = EventKind.IN_COLLISION if least < 0 else EventKind.BELOW_MARGIN
    events = events_of(replay, kind, source)
    worst = min(events, key=lambda event: event.worst)
    states = sum(event.num_states for event in events)
    yield Reason(
        criterion=criterion,
        outcome=Outcome.FAILED,
        sentence=f"{worst.worst_name} is {mm(abs(least))} {'deep in the scene' if least < 0 else 'from the scene'}, "
        f"margin {mm(replay.margin)}, {states} states in {counted(len(events), 'interval')}, worst",
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
    least = least_of(replay.audit.clearance["exact"].distance)
    represented = least_of(replay.between["represented"])
    assert least is not None
    if least >= judged.threshold:
        yield held("clearance", f"at least {mm(least)}", least, replay.margin, "m", judged.num_states)
        return
    worst = min(events_of(replay, EventKind.BELOW_MARGIN, "exact"), key=lambda event: event.worst)
    yield Reason(
        criterion="clearance",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=f"{worst.worst_name} is {mm(least)} from space that is occupied and has no splat (the splats are "
        f"{mm(represented or 0.0)} away), margin {mm(replay.margin)}",
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


def surface_clearance(judged: Judged) -> Iterator[Reason]:
    """The clearance of the body, not of its spheres: less what they leave uncovered; and between the states."""
    replay, model = judged.replay, judged.replay.model
    clearance = replay.audit.clearance
    spheres = least_of(clearance["certified" if "certified" in clearance else "exact"].distance)  # as `surface` is
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
    surface, between = least_of(replay.between["surface"]), least_of(replay.between["lower"])
    if spheres is None or surface is None or spheres < judged.threshold:
        return  # said of the spheres already
    if surface < judged.threshold:
        deficit = float(np.nanmax(model.sphere_deficit[moving]))
        yield Reason(
            criterion="surface clearance",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"the spheres keep {mm(spheres)}, the surface {mm(surface)} for certain: they leave up to "
            f"{mm(deficit)} of it uncovered",
            value=surface,
            threshold=replay.margin,
            unit="m",
            time_s=time_of_least(judged, replay.between["surface"]),
            remedy="use spheres that cover the robot: splatctrl robot spheres",
            count=judged.num_states,
        )
    elif between is not None and between < judged.threshold:
        is_met = bool(replay.between["met"][int(np.nanargmin(replay.between["lower"]))])
        yield Reason(
            criterion="clearance between states",
            outcome=Outcome.NOT_EVALUABLE,
            sentence=f"on the straight way between two states the arm comes to at most {mm(between)}"
            if is_met
            else f"the arm may have come within {mm(between)} between two states",
            value=between,
            threshold=replay.margin,
            unit="m",
            time_s=time_of_least(judged, replay.between["lower"]),
            remedy=SLOW,
            count=judged.num_states,
        )
    else:
        yield held("surface clearance", f"at least {mm(surface)}", surface, replay.margin, "m", judged.num_states)


def _bare_moving_links(judged: Judged) -> list[str]:
    """Links with a body, moved by a joint, that have no sphere."""
    model = judged.replay.model
    if model.coverage is None:
        return []
    bodies = model.urdf.rigid_bodies()
    children = {child for _, child in model.urdf.parents}
    return [link for link in model.coverage.bare_links if bodies[link][0] in children]


def self_clearance(judged: Judged) -> Iterator[Reason]:
    """The arm against itself."""
    least = least_of(judged.replay.audit.self_clearance)
    events = events_of(judged.replay, EventKind.SELF_COLLISION)
    if least is None or not np.isfinite(least):
        return
    if not events:
        yield held("self-clearance", f"at least {mm(least)}", least, 0.0, "m", judged.num_states)
        return
    worst = min(events, key=lambda event: event.worst)
    yield Reason(
        criterion="self-clearance",
        outcome=Outcome.FAILED,
        sentence=f"{worst.worst_name} are {mm(-worst.worst)} deep in each other",
        value=worst.worst,
        threshold=0.0,
        unit="m",
        time_s=worst.worst_s,
        who=worst.worst_name,
        remedy="pairs that may touch are named by --srdf",
        count=judged.num_states,
        label=CONTACT,
    )


def static_clearance(judged: Judged) -> Iterator[Reason]:
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
            sentence=f"the scene comes within {mm(least)} of {name}, which no joint moves (at first {mm(first)})",
            value=least,
            threshold=judged.replay.margin,
            unit="m",
            who=name,
            count=len(judged.replay.statics),
            label=CONTACT if least < 0 else MARGIN,
        )


def motion_limits(judged: Judged) -> Iterator[Reason]:
    """Position, velocity and acceleration limits of the motion."""
    replay, tolerance = judged.replay, judged.request.config.control.limit_tolerance
    names = replay.model.joint_names
    margins = replay.audit.limit_margin
    least = least_of(margins)
    if least is not None and least < -tolerance:
        worst = min(events_of(replay, EventKind.OUTSIDE_LIMITS), key=lambda event: event.worst)
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
        yield held("position limits", f"at least {least:.3f} rad inside", least, 0.0, "rad", judged.num_states)
    for kind, column, what in (
        (EventKind.TOO_FAST, "velocity", "velocity limits"),
        (EventKind.TOO_SUDDEN, "acceleration", "acceleration limits"),
    ):
        values = replay.strain[column]
        most = float(np.max(values)) if len(values) else 0.0
        if most > TOO_MUCH:
            worst = max(events_of(replay, kind), key=lambda event: event.worst)
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
            yield held(what, f"at most {most:.2f} of the limit", most, 1.0, "", judged.num_states)


def controller(judged: Judged) -> Iterator[Reason]:
    """Closed loop: every step solved, the scene never came into the arm, the goal reached."""
    trace, metrics = judged.replay.closed_loop, judged.metrics
    if trace is None:
        return
    bad = {name: metrics[f"num_{name}"] or 0 for name in ("relaxed", "minimum_violation", "hold")}
    if sum(bad.values()):
        kinds = (EventKind.RELAXED, EventKind.MINIMUM_VIOLATION, EventKind.HOLD)
        first = min((e for kind in kinds for e in events_of(judged.replay, kind)), key=lambda e: e.first_ns)
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
        yield held("controller", f"all {len(trace.steps)} steps solved", 0.0, 0.0, "", len(trace.steps))
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

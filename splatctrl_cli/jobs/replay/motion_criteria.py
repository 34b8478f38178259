"""Criteria of a replay's motion: scene, self-collision, limits and goal."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from operator import attrgetter

import numpy as np

from splatctrl_cli.config.fixed import LIMIT_EXCEEDED, SLIGHTLY_UNDER
from splatctrl_cli.control.columns import Event, EventKind
from splatctrl_cli.evaluate.metrics import lowest
from splatctrl_cli.evaluate.verdict import Criterion, Outcome, Reason, failed, not_evaluable, passed_reason, plural
from splatctrl_cli.jobs.replay.criteria import (
    BROKEN,
    COMMANDED,
    CONTACT,
    LIMITS,
    MARGIN,
    SLOW,
    UNKNOWN,
    Bound,
    Judged,
    controller,
    events_of,
    goal,
    mm,
    scene_hits,
    worst_state,
)
from splatctrl_cli.jobs.replay.inputs import bare_moving_links, recorded_postures
from splatctrl_cli.robot.self_margins import least_gap


def clearance(judged: Judged) -> Iterator[Reason]:
    """Every moving link's surface (its spheres, if it has no mesh) keeps the margin from the splats."""
    represented = lowest(judged.replay.trace["clearance_splats"])
    is_starved = represented is not None and represented >= judged.threshold
    yield from _check_source(judged, "exact", represented if is_starved else None)


def certified_clearance(judged: Judged) -> Iterator[Reason]:
    """The grid's lower bound on distance keeps the margin; judged without splats."""
    if "certified" not in judged.replay.fields:
        return
    least, exact = (lowest(judged.replay.trace[f"clearance_{name}"]) for name in ("certified", "exact"))
    if least is None or exact is None or not least < judged.threshold <= exact:
        yield from _check_source(judged, "certified")
        return
    room, loss = exact - judged.threshold, exact - least
    voxel = judged.metrics.get("voxel") or 0.02
    yield not_evaluable(
        sentence=f"the grid is too coarse: its certified bound is {mm(least)}, its interpolated value {mm(exact)}, "
        f"margin {mm(judged.replay.margin)}",
        value=least,
        threshold=judged.replay.margin,
        unit="m",
        remedy=f"bake again with --voxel at most {max(voxel * room / loss, 1e-3):.2g}, or give --scene",
        count=judged.replay.num_states,
    )


def clearance_of_people(judged: Judged) -> Iterator[Reason]:
    """The arm keeps `control.human_margin` from people; judged if that exceeds the margin."""
    control = judged.request.config.control
    if control.human_margin > control.margin:
        yield from _check_source(judged, "barrier")


def true_clearance(judged: Judged) -> Iterator[Reason]:
    """The true clearance of every moving sphere keeps the margin; judged with `--truth`."""
    if "clearance_true" in judged.replay.trace:
        yield from _check_source(judged, "true")


def _check_source(judged: Judged, source: str, represented: float | None = None) -> Iterator[Reason]:
    """represented [m]: clearance to splats, if voxels without one alone break the margin."""
    replay = judged.replay
    least = lowest(replay.trace[f"clearance_{source}"])
    if least is None:
        return
    if least >= judged.threshold:
        yield passed_reason(f"at least {mm(least)}", least, replay.margin, "m", judged.replay.num_states)
        return
    is_contact = least < 0 and represented is None
    events = events_of(replay, EventKind.IN_COLLISION if is_contact else EventKind.BELOW_MARGIN, source)
    worst = min(events, key=lambda event: event.worst)
    if represented is not None:
        starved = not_evaluable(
            sentence=f"{worst.worst_name} is {mm(least)} from occupied space without a splat, margin "
            f"{mm(replay.margin)} (the nearest splat is {mm(represented)} away)",
            value=least,
            threshold=replay.margin,
            unit="m",
            remedy="the map is starved: raise --max-splats",
            count=judged.replay.num_states,
        )
        yield _locate(worst, starved)
        return
    states = sum(event.num_states for event in events)
    apart = f"penetrates the scene by {mm(-least)}" if least < 0 else f"is {mm(least)} from the scene"
    link, why = unlearned_link(judged) or ("", "")
    if link and worst.worst_name.startswith(f"{link}["):
        part = not_evaluable(
            sentence=f"{worst.worst_name} {apart}, margin {mm(replay.margin)}; the object is there from the first "
            f"state on and may be a part of {link}, which {why},",
            value=least,
            threshold=replay.margin,
            unit="m",
            remedy=f"record {link} moving by 100 mm in view of the cameras, or give --self-model",
            count=replay.num_states,
        )
        yield _locate(worst, part)
        return
    yield _locate(
        worst,
        failed(
            sentence=f"{worst.worst_name} {apart}, margin {mm(replay.margin)}, {states} states in "
            f"{plural(len(events), 'interval')}, worst",
            value=least,
            threshold=replay.margin,
            unit="m",
            count=judged.replay.num_states,
            label=CONTACT if least < 0 else MARGIN,
        ),
    )


def unlearned_link(judged: Judged) -> tuple[str, str] | None:
    """Unlearned link, and why it is, near which an object may be its part.

    The object breaks the margin in every logged state, or as a driven motion begins.
    """
    trace, learned = judged.replay.trace, judged.inputs.model.self_model
    if learned is None or "exact" not in judged.replay.fields:
        return None
    link = trace["nearest_exact"][0].rpartition("[")[0]
    distance = trace["clearance_exact"][: 1 if judged.replay.closed_loop else None]
    is_beside = distance.max() < judged.threshold
    return (link, learned.unknown[link]) if link in learned.unknown and is_beside else None


def _locate(event: Event, reason: Reason) -> Reason:
    there = event.obstacle
    return replace(
        reason,
        time_s=event.worst_s,
        who=event.worst_name,
        place=None if there is None else there.position,
        cause="" if there is None else f"near {there}",
    )


def self_clearance(judged: Judged) -> Iterator[Reason]:
    """No two links overlap.
    No moving link comes within the margin of a fixed one without joints, such as a table.
    The built-in controller drives no pair below `control.self_margin` and below the recorded gap. Gaps are of
    collision surfaces, or of spheres if these cannot be read.
    """
    trace = judged.replay.trace
    worst = worst_state(trace, trace["self_clearance"], who=trace["self_pair"])
    least = np.inf if worst is None or worst.value is None else worst.value
    if worst is not None and least < 0:
        yield replace(
            worst,
            outcome=Outcome.FAILED,
            sentence=f"{worst.who} overlap by {mm(-least)}",
            threshold=0.0,
            unit="m",
            remedy="name pairs that may touch with --srdf",
            label=CONTACT,
        )
    elif np.isfinite(least):
        yield (
            _check_fixture(judged)
            or _brought_together(judged)
            or passed_reason(f"at least {mm(least)}", least, 0.0, "m", judged.replay.num_states)
        )


def _check_fixture(judged: Judged) -> Reason | None:
    fixtures = [(gap, stamp, pair) for pair, (gap, stamp) in judged.replay.closest.items() if pair.is_fixture]
    gap, stamp, pair = min(fixtures, key=lambda one: one[0] - one[2].apart, default=(np.inf, 0, None))
    if pair is None or gap >= pair.apart - SLIGHTLY_UNDER:
        return None
    return failed(
        sentence=f"{' and '.join(pair.links)}, one of which stands still, are {mm(gap)} apart, margin "
        f"{mm(pair.apart)}",
        value=gap,
        threshold=pair.apart,
        unit="m",
        who=" and ".join(pair.links),
        time_s=float(stamp - int(judged.replay.trace.stamp_ns[0])) * 1e-9,
        remedy="name pairs that may touch with --srdf",
        count=judged.replay.num_states,
        label=MARGIN,
    )


def _brought_together(judged: Judged) -> Reason | None:
    inputs, replay = judged.inputs, judged.replay
    if replay.outside is not None:
        return None
    recorded = recorded_postures(inputs.states)
    for pair, (gap, stamp) in sorted(replay.closest.items(), key=lambda item: item[1][0] - item[0].apart):
        if pair.is_fixture or gap >= pair.apart - SLIGHTLY_UNDER:
            continue
        if gap < (before := least_gap(inputs.model, inputs.surfaces, pair, recorded)) - SLIGHTLY_UNDER:
            bound = f"at least {mm(before)}" if before < pair.apart else f"{mm(pair.apart)} or more"
            return failed(
                sentence=f"{' and '.join(pair.links)} were driven to {mm(gap)} apart, recorded {bound}: "
                f"spheres keep {mm(pair.margin or 0.0)} of the required {mm(replay.config.control.self_margin)}",
                value=gap,
                threshold=min(pair.apart, before),
                unit="m",
                remedy="fit finer spheres there (splatctrl robot spheres), or lower control.self_margin",
                count=judged.replay.num_states,
                label=MARGIN,
                time_s=float(stamp - int(replay.trace.stamp_ns[0])) * 1e-9,
                who=" and ".join(pair.links),
            )
    return None


def static_clearance(judged: Judged) -> Iterator[Reason]:
    """No new obstacle is within a fixed link's margin in two consecutive maps.
    New: at least 1 cm (3 cm at the mount) from earlier surfaces, in space seen free. Other surfaces cause a note.
    """
    broken = {
        name: (first, least)
        for name, (first, least) in judged.replay.statics.items()
        if least < min(judged.threshold, first)
    }
    if broken:
        name, (first, least) = min(broken.items(), key=lambda item: item[1][1])
        yield failed(
            sentence=f"the scene is {mm(least)} from {name}, which no joint moves, margin {mm(judged.replay.margin)} "
            f"({mm(first)} at first)",
            value=least,
            threshold=judged.replay.margin,
            unit="m",
            who=name,
            count=len(judged.replay.statics),
            label=CONTACT if least < 0 else MARGIN,
        )


over_limit = partial(Bound, outcome=Outcome.FAILED, label=LIMITS)
POSITION = over_limit(
    on="limit_margin",
    who="limit_joint",
    at_least=0.0,
    tolerance=attrgetter("request.config.control.limit_tolerance"),
    unit="rad",
    say="{who} is {negated:.4f} rad or m outside its limits",
    passed="at least {value:.3f} rad inside",
    remedy="check that the URDF is of this robot, and the units and wrapping of its joints",
)
VELOCITY, ACCELERATION = (
    over_limit(
        on=f"{name}_share",
        who=f"{name}_joint",
        at_most=1.0,
        tolerance=LIMIT_EXCEEDED - 1.0,
        say="{who} reaches {value:.2f} times its limit",
        passed="at most {percent:.0f} % of the limit",
        remedy="check the stamps and units of the states, and the URDF's limits",
    )
    for name in ("velocity", "acceleration")
)


def velocity_limits(judged: Judged) -> Iterator[Reason]:
    """Velocities and a user's commands exceed the URDF's limits by at most one percent."""
    yield from [*COMMANDED(judged)] or VELOCITY(judged)


def acceleration_limits(judged: Judged) -> Iterator[Reason]:
    """Accelerations exceed `control.max_acceleration`, where it is set, by at most one percent."""
    if judged.replay.trace["acceleration_share"].any():
        yield from ACCELERATION(judged)


def surface_clearance(judged: Judged) -> Iterator[Reason]:
    """The spheres' clearance, minus how far surface stands out of them, keeps the margin.
    Every moving link has a sphere.
    """
    model = judged.replay.model
    deficit = model.sphere_deficit[np.asarray(model.moving_spheres)]
    if np.isnan(deficit).any():
        yield not_evaluable(
            sentence=f"the coverage of the robot by its spheres is unknown: {model.coverage_unknown}",
            remedy="give a URDF with collision geometry (--packages finds its meshes)",
        )
        return
    if bare := bare_moving_links(judged.replay.model):
        yield not_evaluable(
            sentence=f"no sphere on {', '.join(bare)}: their clearance is unknown",
            who=bare[0],
            remedy=f"fit a set that covers them: splatctrl robot spheres --urdf {judged.inputs.model.urdf.path}",
        )
    spheres, surface, between = _body_clearance(judged)
    if surface is None:
        return
    if surface < judged.threshold:
        yield not_evaluable(
            sentence=f"the spheres keep {mm(spheres)}, but the surface may keep only {mm(surface)}, margin "
            f"{mm(judged.replay.margin)} (up to {mm(float(np.nanmax(deficit)))} of it lies outside them)",
            value=surface,
            threshold=judged.replay.margin,
            unit="m",
            time_s=judged.replay.trace.seconds(int(np.nanargmin(judged.replay.trace["clearance_surface"]))),
            remedy="use spheres that cover the robot: splatctrl robot spheres",
            count=judged.replay.num_states,
        )
    elif between is None or between >= judged.threshold:
        yield passed_reason(f"at least {mm(surface)}", surface, judged.replay.margin, "m", judged.replay.num_states)


def clearance_between_states(judged: Judged) -> Iterator[Reason]:
    """A lower bound between states keeps the margin; intervals that break it are halved."""
    model, trace = judged.replay.model, judged.replay.trace
    _, surface, between = _body_clearance(judged)
    if np.isnan(model.sphere_deficit[np.asarray(model.moving_spheres)]).any() or surface is None or between is None:
        return
    if between < judged.threshold <= surface:
        yield not_evaluable(
            sentence=f"on a straight path between two states the arm is at most {mm(between)} from the scene, margin "
            f"{mm(judged.replay.margin)}"
            if bool(trace["is_met"][int(np.nanargmin(trace["clearance_between"]))])
            else f"between two states the arm may have come within {mm(between)} of the scene, margin "
            f"{mm(judged.replay.margin)}",
            value=between,
            threshold=judged.replay.margin,
            unit="m",
            time_s=trace.seconds(int(np.nanargmin(trace["clearance_between"]))),
            remedy=SLOW,
            count=judged.replay.num_states,
        )


def _body_clearance(judged: Judged) -> tuple[float, float | None, float | None]:
    """Least clearance [m] of spheres, surface, and between states.

    The last two are None if unknown, or if the spheres, then NaN, break the margin.
    """
    trace, field = judged.replay.trace, "certified" if "certified" in judged.replay.fields else "exact"
    spheres = lowest(trace[f"clearance_{field}"])  # as `surface` is
    if spheres is None or spheres < judged.threshold:
        return np.nan, None, None
    return spheres, lowest(trace["clearance_surface"]), lowest(trace["clearance_between"])


OF_MOTION: tuple[Criterion[Judged], ...] = (
    Criterion(
        name="clearance",
        find=clearance,
        broken=f"{BROKEN}; {UNKNOWN} if only occupied voxels without a splat break it (raise `--max-splats`), or if "
        "an object that is always near a link that hardly moves may be part of it",
    ),
    Criterion(
        name="certified clearance",
        find=certified_clearance,
        broken=f"{UNKNOWN}, with the largest voxel that suffices; {BROKEN} if the interpolated value breaks it too",
    ),
    Criterion(name="clearance of people", find=clearance_of_people, broken=BROKEN),
    Criterion(name="true clearance", find=true_clearance, broken=BROKEN),
    Criterion(name="self-clearance", find=self_clearance, broken=f"{BROKEN} (contact, margin broken)"),
    Criterion(name="static clearance", find=static_clearance, broken=BROKEN),
    Criterion(
        name="position limits",
        find=POSITION,
        meaning="joints stay within the URDF's limits, with `control.limit_tolerance` for encoder noise",
        broken=BROKEN,
    ),
    Criterion(name="velocity limits", find=velocity_limits, broken=BROKEN),
    Criterion(name="acceleration limits", find=acceleration_limits, broken=BROKEN),
    Criterion(name="controller", find=controller, broken=BROKEN),
    Criterion(name="scene hits", find=scene_hits, broken=f"{BROKEN} (contact)"),
    Criterion(name="goal", find=goal, broken=BROKEN),
    Criterion(name="surface clearance", find=surface_clearance, broken=UNKNOWN),
    Criterion(name="clearance between states", find=clearance_between_states, broken=UNKNOWN),
)
"""By weight: of several failures the first one is in the sentence."""

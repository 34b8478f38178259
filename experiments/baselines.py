"""``--baseline``: the methods beside the closed loop, and the distances to people of a monitored standstill."""

import fnmatch
from collections.abc import Mapping

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.events import runs_of
from splatctrl_cli.control.replay import Outcome
from splatctrl_cli.control.standstill import (
    BoxZone,
    DistanceToPeople,
    Separation,
    StopZone,
    Zone,
    monitored_standstill,
    remembered,
    separation_of,
)
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.evaluate.metrics import DESCRIBES, GAP, Better, Scale
from splatctrl_cli.jobs.replays.compare import BIRRT, BIRRT_IK, QP_IK, check_comparable
from splatctrl_cli.jobs.replays.request import ReplayInputs, ReplayRequest
from splatctrl_cli.jobs.replays.result import Replay
from splatctrl_cli.records import Box, Float64
from splatctrl_cli.simulate.truth import distance_to

PEOPLE = ("human*", "person*")  # names of a truth's primitives
STOPPED = Scale(unit="s", better=Better.LOWER, absolute=0.05, relative=0.02)
FIGURES = {
    "completed": Scale(better=Better.HIGHER),
    "duration_s": STOPPED,
    "mean_human_distance": GAP,
    "min_human_distance": GAP,
    "num_stops": DESCRIBES,
    "longest_stop_s": STOPPED,
    "stopped_s": STOPPED,
}
STANDSTILL = "standstill"
BESIDE = ("closed_loop", STANDSTILL)
BASELINES = (STANDSTILL, BIRRT, BIRRT_IK, QP_IK)


def read_baselines(request: ReplayRequest) -> tuple[str, ...]:
    """The baselines, each once. Raises UsageError for another mode, or where one does not go with the goal."""
    names = tuple(dict.fromkeys(request.baseline))
    if names and request.mode != "closed-loop":
        raise UsageError("--baseline: expected --mode closed-loop to compare with", remedy="give it")
    check_comparable(request, names)
    return names


def read_zone(request: ReplayRequest) -> StopZone | None:
    """The zone of --zone or --zone-box, None without a standstill.

    Raises UsageError as `read_baselines`, or for values that do not make a zone.
    """
    if STANDSTILL not in read_baselines(request):
        return None
    try:
        stop, resume = (float(part) for part in request.zone.split(","))
    except ValueError:
        raise UsageError(f"--zone {request.zone}: expected STOP,RESUME [m]") from None
    zone = Zone(stop=stop, resume=resume)
    if request.zone_box is None:
        return zone
    return BoxZone(box=Box.from_text(request.zone_box), hysteresis=zone.resume - zone.stop)


def separations(
    request: ReplayRequest, zone: StopZone | None, inputs: ReplayInputs, replay: Replay, config: Config
) -> Mapping[str, Separation]:
    """The closed loop and the standstill beside people, from the same moment; empty without a standstill."""
    trace = replay.closed_loop
    if zone is None or trace is None:
        return {}

    people, control = _people(request, inputs, config.human.memory), config.control
    driven = separation_of(
        inputs.model,
        trace.stamp_ns,
        np.asarray(trace.position),
        np.array([step.velocity for step in trace.steps]),
        people,
        still=control.stall_speed,
        is_complete=trace.outcome is Outcome.GOAL_REACHED,
    )
    held = monitored_standstill(
        inputs.model,
        inputs.motion(),
        people,
        zone,
        start_ns=int(trace.stamp_ns[0]),
        period=control.period,
        max_wait=control.max_time,
        max_acceleration=control.stop_acceleration,
    )
    return dict(zip(BESIDE, (driven, held), strict=True))


def separation_figures(separation: Separation, period: float) -> dict[str, float | None]:
    """`FIGURES` of one motion; distances over the states at which a person is there, None where nobody ever is."""
    there = separation.distance[np.isfinite(separation.distance)]
    stops = [(end - first) * period for first, end in runs_of(separation.is_stopped)]
    values = (
        int(separation.is_complete),
        separation.duration_s,
        float(there.mean()) if len(there) else None,
        float(there.min()) if len(there) else None,
        len(stops),
        max(stops, default=0.0),
        sum(stops),
    )
    return dict(zip(FIGURES, values, strict=True))


def _people(request: ReplayRequest, inputs: ReplayInputs, memory: float) -> DistanceToPeople:
    """The people of the truth where it is given, else those that the scene labels human, for `memory` [s]."""
    scene = inputs.scene
    if inputs.truth is not None:
        names = [primitive.name for primitive in inputs.truth.primitives]
        wanted = request.human or PEOPLE
        chosen = [p for p in inputs.truth.primitives if any(fnmatch.fnmatch(p.name, name) for name in wanted)]
        if not chosen:
            raise NotEvaluableError(
                f"{inputs.truth.path}: expected a primitive named {' or '.join(wanted)}, got {', '.join(names)}",
                remedy="name one with --human",
            )
        return lambda points, stamp_ns: distance_to(chosen, points, stamp_ns)
    if request.human:
        raise UsageError(
            "--human: expected --truth to take it from", remedy="without it people are splats labelled so"
        )
    stamps = scene.stamps_ns or (int(inputs.states[0].stamp_ns),)
    if all(scene.at(stamp + scene.latency_ns).human is None for stamp in stamps):
        raise NotEvaluableError(
            "--baseline: expected splats labelled human, got none at any time",
            remedy="reconstruct from a log with masks of people, or give --truth and --human",
        )

    def distance(points: Float64, stamp_ns: int) -> Float64:
        human = scene.at(stamp_ns).human
        return np.full(len(points), np.inf) if human is None else human.query(points)[0]

    return remembered(distance, scene.age_s, memory)

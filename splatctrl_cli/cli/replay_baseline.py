"""``--baseline``: what else stands beside the closed loop, and the distances to people of a monitored standstill."""

import argparse
import fnmatch
from collections.abc import Mapping
from typing import TYPE_CHECKING

from splatctrl_cli.cli.replay_compare import BIRRT, BIRRT_IK, check_comparable
from splatctrl_cli.errors import NotEvaluableError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.cli.replay_modes import Replay, ReplayInputs
    from splatctrl_cli.config import Config
    from splatctrl_cli.control.standstill import DistanceToPeople, Separation, StopZone
    from splatctrl_cli.records import Float64

PEOPLE = ("human*", "person*")  # names of a truth's primitives
FIGURES = (
    *("completed", "duration_s", "mean_human_distance", "min_human_distance", "num_stops"),
    *("longest_stop_s", "stopped_s"),
)
STANDSTILL = "standstill"
BESIDE = ("closed_loop", STANDSTILL)
BASELINES = (STANDSTILL, BIRRT, BIRRT_IK)


def add_baseline(parser: argparse.ArgumentParser) -> None:
    """``--baseline``, ``--zone``, ``--zone-box``, ``--human``."""
    parser.add_argument(
        "--baseline",
        type=_baselines,
        action="extend",
        default=[],
        metavar="NAME,...",
        help="beside the closed loop (repeatable): standstill, the logged path held while a person is in the zone; "
        "birrt, a path planned in the scene known at the start, followed by the joints; birrt-ik, by the controller",
    )
    parser.add_argument(
        "--zone", default="0.5,0.6", metavar="STOP,RESUME", help="distances [m] of that zone (default: 0.5,0.6)"
    )
    parser.add_argument(
        "--zone-box",
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="a box [m] instead: stop while a person is in it, until nobody is within RESUME - STOP of it",
    )
    parser.add_argument(
        "--human",
        action="append",
        default=[],
        metavar="NAME",
        help="a primitive of --truth that counts as a person (repeatable; default: human*, person*)",
    )


def _baselines(text: str) -> list[str]:
    """Names joined by commas, for argparse."""
    names = text.split(",")
    for name in names:
        if name not in BASELINES:
            raise argparse.ArgumentTypeError(f"expected {', '.join(BASELINES)}, got {name!r}")
    return names


def read_baselines(args: argparse.Namespace) -> tuple[str, ...]:
    """The baselines, each once. Raises UsageError for another mode, or where one does not go with the goal."""
    names = tuple(dict.fromkeys(args.baseline))
    if names and args.mode != "closed-loop":
        raise UsageError("--baseline: expected --mode closed-loop to stand beside", remedy="give it")
    check_comparable(args, names)
    return names


def read_zone(args: argparse.Namespace) -> "StopZone | None":
    """The zone of --zone or --zone-box, None without a standstill.

    Raises UsageError as `read_baselines`, or for a zone that is none.
    """
    from splatctrl_cli.control.standstill import BoxZone, Zone
    from splatctrl_cli.records import Box

    if STANDSTILL not in read_baselines(args):
        return None
    try:
        stop, resume = (float(part) for part in args.zone.split(","))
    except ValueError:
        raise UsageError(f"--zone {args.zone}: expected STOP,RESUME [m]") from None
    zone = Zone(stop=stop, resume=resume)
    if args.zone_box is None:
        return zone
    return BoxZone(box=Box.from_text(args.zone_box), hysteresis=zone.resume - zone.stop)


def separations(
    args: argparse.Namespace, zone: "StopZone | None", inputs: "ReplayInputs", replay: "Replay", config: "Config"
) -> "Mapping[str, Separation]":
    """The closed loop and the standstill beside people, from the same moment; empty without a standstill."""
    from splatctrl_cli.cli.replay_modes import logged_motion
    from splatctrl_cli.control.replay import Outcome
    from splatctrl_cli.control.standstill import monitored_standstill, separation_of

    trace = replay.closed_loop
    if zone is None or trace is None:
        return {}
    import numpy as np

    people, control = _people(args, inputs, config.human.memory), config.control
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
        logged_motion(inputs),
        people,
        zone,
        start_ns=int(trace.stamp_ns[0]),
        period=control.period,
        max_wait=control.max_time,
        max_acceleration=control.stop_acceleration,
    )
    return dict(zip(BESIDE, (driven, held), strict=True))


def separation_figures(separation: "Separation", period: float) -> dict[str, float | None]:
    """`FIGURES` of one motion; distances over the states at which a person is there, None where nobody ever is."""
    import numpy as np

    from splatctrl_cli.control.explain import runs_of

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


def _people(args: argparse.Namespace, inputs: "ReplayInputs", memory: float) -> "DistanceToPeople":
    """The people of the truth where it is given, else those that the scene labels human, for `memory` [s]."""
    import numpy as np

    from splatctrl_cli.control.standstill import remembered

    scene = inputs.scene
    if inputs.truth is not None:
        from splatctrl_cli.simulate.truth import distance_to

        names = [primitive.name for primitive in inputs.truth.primitives]
        wanted = args.human or PEOPLE
        chosen = [p for p in inputs.truth.primitives if any(fnmatch.fnmatch(p.name, name) for name in wanted)]
        if not chosen:
            raise NotEvaluableError(
                f"{inputs.truth.path}: expected a primitive named {' or '.join(wanted)}, got {', '.join(names)}",
                remedy="name one with --human",
            )
        return lambda points, stamp_ns: distance_to(chosen, points, stamp_ns)
    if args.human:
        raise UsageError(
            "--human: expected --truth to take it from", remedy="without it people are splats labelled so"
        )
    stamps = scene.stamps_ns or (int(inputs.states[0].stamp_ns),)
    if all(scene.at(stamp + scene.latency_ns).human is None for stamp in stamps):
        raise NotEvaluableError(
            "--baseline: expected splats labelled human, got none at any time",
            remedy="reconstruct from a log with masks of people, or give --truth and --human",
        )

    def distance(points: "Float64", stamp_ns: int) -> "Float64":
        human = scene.at(stamp_ns).human
        return np.full(len(points), np.inf) if human is None else human.query(points)[0]

    return remembered(distance, scene.age_s, memory)

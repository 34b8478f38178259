"""Files of a replay: steps, events, summary and pictures."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.events import INTERVENTIONS, SHOWN, Event, EventKind, first_intervention
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.evaluate.worst_frames import Moment, Sight, draw_sight, sights_of, worst_moments
from splatctrl_cli.files.output import Stopwatch, finite, write_json, write_run
from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.request import Replay, ReplayInputs
from splatctrl_cli.records import Float64, FloatRows, RgbdFrame
from splatctrl_cli.report.replay_pictures import (
    clearance_picture,
    commands_picture,
    divergence_picture,
    evidence_picture,
    open_loop_picture,
)
from splatctrl_cli.robot.sphere_files import sphere_names

UNITS = {
    **dict.fromkeys(("below-margin", "in-collision", "between-states", "self-collision", "hold", "cannot-act"), "m"),
    **{"outside-limits": "rad", "stale-map": "s", "not-bounded": "s", "relaxed": "m/s", "row-broken": "m/s"},
}
_SPECIAL = re.compile('[,"\r\n]')

Columns = dict[str, list[object]]


def chunks_of(replay: Replay) -> Iterator[Columns]:
    """Columns of all states, BLOCK at a time, to bound memory."""
    return (columns_of(replay, slice(k, k + BLOCK)) for k in range(0, len(replay.audit.stamp_ns), BLOCK))


def columns_of(replay: Replay, rows: slice = slice(None)) -> Columns:
    first, last, _ = rows.indices(len(replay.audit.stamp_ns))
    audit, names = replay.audit.block(first, last), sphere_names(replay.model.sphere_set)
    columns: Columns = {
        "stamp_ns": audit.stamp_ns.tolist(),
        "time_s": ((audit.stamp_ns - replay.audit.stamp_ns[0]) * 1e-9).tolist(),
        **{f"q_{joint}": audit.position[:, j].tolist() for j, joint in enumerate(replay.model.joint_names)},
    }
    for name, clearance in audit.clearance.items():
        columns[f"clearance_{name}"] = clearance.distance.tolist()
        columns[f"nearest_{name}"] = [names[s] for s in clearance.sphere.tolist()]
    if replay.true_clearance is not None:
        columns["clearance_true"] = replay.true_clearance[rows].tolist()
    columns |= {
        "obstacle": list(replay.obstacles[rows]),
        "self_clearance": audit.self_clearance.tolist(),
        "limit_margin": audit.limit_margin.tolist(),
        "limit_joint": [replay.model.joint_names[j] for j in audit.limit_joint.tolist()],
        "unknown_share": audit.unknown_share.tolist(),
        "map_age_s": replay.map_age_s[rows].tolist(),
    }
    if len(replay.steps):
        columns |= _step_columns(replay, rows)
    if replay.open_loop is not None:
        columns |= _open_loop_columns(replay, rows)
    if replay.divergence is not None:
        apart = replay.divergence
        columns |= {
            "divergence_joints": apart.rows("joints")[rows].tolist(),
            "divergence_position": apart.rows("position")[rows].tolist(),
            "divergence_rotation_deg": np.degrees(apart.rows("rotation")[rows]).tolist(),
        }
    return columns


def _step_columns(replay: Replay, rows: slice) -> Columns:
    steps = replay.steps[rows]

    def each(value: Callable[[ControlStep], object]) -> list[object]:
        return ["" if step is None else value(step) for step in steps]

    return {
        **{
            f"v_{joint}": ["" if step is None else float(step.velocity[j]) for step in steps]
            for j, joint in enumerate(replay.model.joint_names)
        },
        "barrier_clearance": each(lambda step: step.clearance),
        "barrier_nearest": each(lambda step: step.nearest),
        "rung": each(lambda step: str(step.rung)),
        "scale": each(lambda step: step.scale),
        "slack": each(lambda step: max((row.slack for row in step.relaxed), default=0.0)),
        "relaxed": each(lambda step: " ".join(row.name for row in step.relaxed)),
        "intervening": each(lambda step: "; ".join(step.intervening)),
        "multipliers": each(lambda step: "; ".join(f"{row.multiplier:.4g}" for row in step.interventions)),
        "num_rows": each(lambda step: step.num_rows),
        "residual": each(lambda step: step.residual),
        "position_error": each(lambda step: float(np.linalg.norm(step.pose_error[:3]))),
        "rotation_error": each(lambda step: float(np.linalg.norm(step.pose_error[3:]))),
    }


def _open_loop_columns(replay: Replay, rows: slice) -> Columns:
    assert replay.open_loop is not None
    trace = replay.open_loop.block(*rows.indices(len(replay.audit.stamp_ns))[:2])
    difference, margins = trace.difference, trace.margins
    return {
        **{f"dv_{joint}": difference[:, j].tolist() for j, joint in enumerate(replay.model.joint_names)},
        "velocity_difference": np.linalg.norm(difference, axis=1).tolist(),
        "barrier_margin_logged": ["" if margin is None else margin.barrier for margin in margins],
        "barrier_row_logged": ["" if margin is None else margin.barrier_row for margin in margins],
        "velocity_margin_logged": ["" if margin is None else margin.limit for margin in margins],
        "velocity_row_logged": ["" if margin is None else margin.limit_row for margin in margins],
    }


def write_replay(
    folder: Path,
    replay: Replay,
    metrics: Metrics,
    verdict: Verdict,
    robot: Mapping[str, str],
    *,
    config: Config,
    inputs: Mapping[str, str],
    stopwatch: Stopwatch,
) -> None:
    """Write steps.csv, events.json, summary.json, pictures and run.json; robot: sentences by subject."""
    write_steps(folder / "steps.csv", chunks_of(replay))
    write_json(folder / "events.json", events_document(replay))
    write_json(folder / "summary.json", summary_of(replay, metrics, verdict, robot))
    with stopwatch.stage("picture"):
        draw_replay(folder, replay, np.asarray((replay.audit.stamp_ns - replay.audit.stamp_ns[0]) * 1e-9))
    write_run(
        folder,
        command="replay",
        config=config.as_dict(),
        inputs=inputs,
        metrics=metrics,
        stopwatch=stopwatch,
        verdict=verdict.as_dict(),
    )


def summary_of(replay: Replay, metrics: Metrics, verdict: Verdict, robot: Mapping[str, str]) -> dict[str, Any]:
    words = {
        "mode": replay.mode,
        "outcome": str(replay.closed_loop.outcome) if replay.closed_loop else f"{replay.mode}: every state",
        "margin": replay.margin,
        **robot,
        "units": "m, rad, s",
        "min_clearance": "the smallest exact distance from a moving sphere's surface to the splats",
    }
    if replay.outside is not None:
        words["controller"] = replay.outside.name
    return {"verdict": verdict.as_dict(), "when_and_why": when_and_why(replay), "about": words, "metrics": metrics}


def events_document(replay: Replay) -> dict[str, Any]:
    changes = () if replay.closed_loop is None else replay.closed_loop.scene_changes
    numbers = ("worst", "worst_s", "start_s", "end_s")
    return {
        "events": [
            asdict(event) | {"unit": UNITS.get(event.kind, "")} | {n: finite(getattr(event, n)) for n in numbers}
            for event in replay.events
        ],
        "static_violations": [asdict(violation) for violation in replay.static_violations],
        "scene_changes": [
            asdict(change) | {"is_hit": change.is_hit}
            for change in changes
            if abs(change.after - change.before) > 0.01
        ],
        "anchored": [] if replay.closed_loop is None else list(replay.closed_loop.anchored),
        "detours": [] if replay.closed_loop is None else list(replay.closed_loop.detours),
    }


def when_and_why(replay: Replay) -> list[str]:
    """The first intervention and the first event of each kind, with counts, as sentences."""
    lines = []
    if replay.steps and replay.outside is None:
        first = first_intervention(replay.events)
        lines.append("first intervention: none" if first is None else f"first intervention: {describe_event(first)}")
    troubles = [event for event in replay.events if event.kind not in INTERVENTIONS and event.source in SHOWN]
    for event in list({(event.kind, event.source): event for event in reversed(troubles)}.values())[::-1]:
        count = sum(other.kind == event.kind and other.source == event.source for other in troubles)
        told_once = describe_event(event, with_kind=False)
        lines.append(
            f"{event.kind}{SHOWN[event.source]}: {told_once}" + (f"; {count} such intervals" if count > 1 else "")
        )
    if replay.closed_loop is not None and replay.start_time_s > 0:
        lines.append(f"times count from the start, at {replay.start_time_s:.2f} s of the log")
    return lines or ["no event: no state is below the margin, outside its limits or in space that is not known"]


def describe_event(event: Event, *, with_kind: bool = True) -> str:
    unit = UNITS.get(event.kind, "")
    span = f"{event.start_s:.2f} to {event.end_s:.2f} s"
    more = f" and {event.num_names - 1} more" if event.num_names > 1 else ""
    near = "" if event.obstacle is None else f", near {event.obstacle}"
    is_row = event.kind in ("scene", "self", "limit")
    kind = f"{event.kind} row" if is_row else event.kind if with_kind else ""
    who = " ".join(filter(None, (kind, event.worst_name)))
    worst = f"{'multiplier ' if is_row else ''}{event.worst:.4g} {unit}".rstrip()
    return ", ".join(filter(None, (span, f"{who}{more}", f"worst {worst} at {event.worst_s:.2f} s{near}")))


def write_steps(path: Path, chunks: Iterable[Mapping[str, Sequence[object]]]) -> None:
    """Write chunks of equally long columns as one CSV.

    Floats have nine digits; NaN and infinity are empty.
    """
    with path.open("w", encoding="utf-8", newline="") as stream:
        for index, columns in enumerate(chunks):
            if index == 0:
                stream.write(",".join(map(_quote, columns)) + "\n")
            parts = [_format_cells(values) for values in columns.values()]
            row = ",".join(form for form, _ in parts) + "\n"
            stream.write("".join(map(row.__mod__, zip(*(cells for _, cells in parts), strict=True))))


def _format_cells(values: Sequence[object]) -> tuple[str, Sequence[object]]:
    kinds = set(map(type, values))
    if kinds == {float} and all(map(math.isfinite, values)):  # type: ignore[arg-type]
        return "%.9g", values
    if kinds == {int}:
        return "%d", values
    if kinds == {str}:
        known = {value: _quote(str(value)) for value in set(values)}
        return "%s", [known[value] for value in values]
    return "%s", [
        _quote(str(v)) if not isinstance(v, float) else f"{v:.9g}" if math.isfinite(v) else "" for v in values
    ]


def _quote(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text


NAMES = {"exact": "exact", "barrier": "barrier", "certified": "certified bound"}  # of the fields, in a caption
TITLES = {
    "audit": "Clearance of the logged motion",
    "open-loop": "Clearance of the logged motion",
    "closed-loop": "Clearance in closed loop",
}
ROWS = ("scene", "self", "limit")  # kinds of rows that shape a command


def draw_replay(folder: Path, replay: Replay, seconds: Float64) -> None:
    """Write the pictures the mode has; seconds (T,) since the first state."""
    curves: dict[str, FloatRows] = {**replay.audit.clearance}
    if replay.true_clearance is not None:
        curves["truth"] = replay.true_clearance
    happened = _intervals(replay, lambda event: event.kind not in INTERVENTIONS and event.source in SHOWN)
    title = TITLES[replay.mode]
    if replay.closed_loop is not None and replay.start_time_s > 0:
        title += f", from {replay.start_time_s:.2f} s of the log"
    clearance_picture(folder / "clearance.png", seconds, curves, replay.margin, title, happened)
    if np.isfinite(shares := replay.near["shares"]).any():
        evidence_picture(folder / "evidence.png", seconds, shares)
    if replay.kept_steps is not None:
        broken = frozenset({EventKind.ROW_BROKEN})
        kinds, rows = (INTERVENTIONS, ROWS) if replay.outside is None else (broken, tuple(broken))
        commands_picture(
            folder / "commands.png",
            seconds,
            replay.kept_steps.figures.rows("velocity"),
            replay.model.joint_names,
            replay.model.velocity_limit,
            _intervals(replay, lambda event: event.kind in kinds, at_least=rows),
            None if replay.open_loop is None else replay.open_loop.figures.rows("logged"),
        )
    if replay.open_loop is not None:
        open_loop_picture(
            folder / "open_loop.png",
            seconds,
            replay.open_loop.figures.rows("difference"),
            replay.model.joint_names,
            replay.open_loop.figures.rows("barrier"),
            [(event.start_s, event.end_s) for event in replay.events if event.kind in ROWS],
        )
    if replay.divergence is not None and np.isfinite(replay.divergence["joints"]).any():
        of = [replay.divergence[name] for name in ("joints", "position", "rotation")]
        divergence_picture(folder / "divergence.png", seconds, *of)


def _intervals(
    replay: Replay, is_shown: Callable[[Event], bool], *, at_least: Sequence[str] = ()
) -> dict[str, list[tuple[float, float]]]:
    """Spans [s] of shown events by kind and measure, with all of `at_least`."""
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in at_least}
    for event in replay.events:
        if is_shown(event):
            found.setdefault(f"{event.kind}{SHOWN.get(event.source, '')}", []).append((event.start_s, event.end_s))
    return found


def worst_sights(inputs: ReplayInputs, replay: Replay, num: int, frames: Iterable[RgbdFrame]) -> list[Sight | None]:
    """Images of the moments of least clearance, least first, by the truth if known.

    None where no camera has one. Frames after the last moment are not read.
    """
    audit = replay.audit
    least = np.asarray(audit.clearance["exact"])
    if replay.true_clearance is not None:
        least = np.fmin(least, np.asarray(replay.true_clearance))
    states = worst_moments(audit.stamp_ns, least, num)
    if not states or not inputs.source.has_clock:
        return []
    return sights_of([_moment(inputs, replay, state) for state in states], frames)


def draw_worst_frames(folder: Path, replay: Replay, sights: Sequence[Sight | None]) -> list[str]:
    """Write worst_1.png and so on; return notes on missing pictures."""
    seen = [sight for sight in sights if sight is not None]
    for number, (moment, frame) in enumerate(seen, start=1):
        first, *rest = moment.caption
        whose = "driven arm; the image shows the logged one" if replay.mode == "closed-loop" else "logged posture"
        caption = (
            f"worst {number}   {first}",
            *rest,
            f"{frame.camera}, taken {(moment.stamp_ns - frame.stamp_ns) * 1e-9:.2f} s before; spheres of the {whose}",
        )
        draw_sight(folder / f"worst_{number}.png", replace(moment, caption=caption), frame)
    if len(seen) < len(sights):
        return [f"worst frames: no camera image at or before {len(sights) - len(seen)} of {len(sights)} moments"]
    return []


def _moment(inputs: ReplayInputs, replay: Replay, state: int) -> Moment:
    audit, model = replay.audit, replay.model
    stamp, worst = int(audit.stamp_ns[state]), int(audit.figures["sphere exact"][state])
    centers = model.sphere_centers(np.asarray(audit.position[state]))
    (obstacle,) = inputs.scene.at(stamp).obstacles(np.ascontiguousarray(centers[[worst]]))
    figures = [f"{NAMES.get(name, name)} {100 * float(of[state]):.2f} cm" for name, of in audit.clearance.items()]
    if replay.true_clearance is not None:
        figures.append(f"truth {100 * float(replay.true_clearance[state]):.2f} cm")
    step = replay.steps[state] if replay.steps else None
    rung = "" if step is None else f"   step: {step.rung}" + (f", scaled by {step.scale:g}" if step.scale < 1 else "")
    seconds = (stamp - int(audit.stamp_ns[0])) * 1e-9
    return Moment(
        stamp_ns=stamp,
        centers=centers,
        radii=np.asarray(model.sphere_set.radii),
        is_moving=np.asarray(model.moving_spheres),
        worst=worst,
        obstacle=np.array(obstacle.position),
        caption=(
            f"{seconds:.2f} s   {sphere_names(model.sphere_set)[worst]}   clearance: {', '.join(figures)}{rung}",
            f"nearest: {obstacle}",
        ),
    )

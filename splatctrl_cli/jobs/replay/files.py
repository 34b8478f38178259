"""Files of a replay: steps, events, summary and pictures."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.columns import INTERVENTIONS, SHOWN, UNITS, Event, EventKind, first_intervention
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.evaluate.worst_frames import Moment, Sight, draw_sight, sights_of, worst_moments
from splatctrl_cli.files.output import Stopwatch, finite, write_json, write_run
from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.request import Replay, ReplayInputs
from splatctrl_cli.jobs.replay.separation import separation_document
from splatctrl_cli.records import FloatRows, RgbdFrame
from splatctrl_cli.report.replay_pictures import (
    clearance_picture,
    commands_picture,
    divergence_picture,
    evidence_picture,
    open_loop_picture,
)
from splatctrl_cli.robot.sphere_files import sphere_names

_SPECIAL = re.compile('[,"\r\n]')

COLUMNS = (  # of the trace in steps.csv, after stamps and clearances; a column per joint for rows (T, J)
    *("clearance_true", "obstacle", "self_clearance", "limit_margin", "limit_joint", "unknown_share", "map_age_s"),
    *("v", "barrier_clearance", "barrier_nearest", "rung", "scale", "slack", "relaxed", "intervening", "multipliers"),
    *("num_rows", "residual", "position_error", "rotation_error", "dv", "velocity_difference"),
    *("barrier_margin_logged", "barrier_row_logged", "velocity_margin_logged", "velocity_row_logged"),
    *("divergence_joints", "divergence_position", "divergence_rotation_deg"),
    *("separation", "protective_distance", "separation_margin", "separation_part", "S_h", "S_r", "S_s", "Z_d", "Z_r"),
    *("speed_scale", "time_to_contact", "stop_clearance"),
)
OF_STEP = (  # columns with empty cells where the controller had no step
    *("barrier_clearance", "scale", "slack", "residual", "position_error", "rotation_error"),
    *("barrier_margin_logged", "velocity_margin_logged"),
)
Cells = dict[str, list[object]]


def chunks_of(replay: Replay) -> Iterator[Cells]:
    """Columns of all states, BLOCK at a time, to bound memory."""
    return (columns_of(replay, slice(k, k + BLOCK)) for k in range(0, replay.num_states, BLOCK))


def columns_of(replay: Replay, rows: slice = slice(None)) -> Cells:
    trace, stamps = replay.trace, replay.trace.rows("stamp_ns")
    columns: Cells = {
        "stamp_ns": stamps[rows].tolist(),
        "time_s": ((stamps[rows] - stamps[0]) * 1e-9).tolist(),
    }
    by_field = [name for field in replay.fields for name in (f"clearance_{field}", f"nearest_{field}")]
    for name in ("q", *by_field, *(name for name in COLUMNS if name in trace)):
        if isinstance(values := trace.rows(name)[rows], list):
            columns[name] = values
        elif values.ndim == 1:
            columns[name] = ["" if name in OF_STEP and np.isnan(v) else v for v in values.tolist()]
        else:
            columns |= {f"{name}_{joint}": values[:, j].tolist() for j, joint in enumerate(replay.model.joint_names)}
    return columns


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
    if replay.separation is not None:
        write_json(folder / "separation.json", separation_document(replay, metrics))
    write_json(folder / "summary.json", summary_of(replay, metrics, verdict, robot))
    with stopwatch.stage("picture"):
        draw_replay(folder, replay)
    write_run(
        folder,
        command="replay",
        config=config.as_dict(),
        inputs=inputs,
        metrics={**metrics, "robot_base": replay.model.T_world_base.tolist()},
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
        "min_clearance": "the least distance from the surface of a moving link to the splats",
    }
    if replay.outside is not None:
        words["controller"] = replay.outside.name
    return {"verdict": verdict.as_dict(), "when_and_why": when_and_why(replay), "about": words, "metrics": metrics}


def events_document(replay: Replay) -> dict[str, Any]:
    numbers = ("worst", "worst_s", "start_s", "end_s")
    return {
        "events": [
            asdict(event) | {"unit": UNITS.get(event.kind, "")} | {n: finite(getattr(event, n)) for n in numbers}
            for event in replay.events
        ],
        "static_violations": [asdict(violation) for violation in replay.static_violations],
        "scene_changes": [
            asdict(change) | {"is_hit": change.is_hit}
            for change in replay.scene_changes
            if abs(change.after - change.before) > 0.01
        ],
        "anchored": [] if replay.closed_loop is None else list(replay.closed_loop.anchored),
        "detours": [] if replay.closed_loop is None else list(replay.closed_loop.detours),
    }


def when_and_why(replay: Replay) -> list[str]:
    """First intervention and the first event of each kind, with counts, as sentences."""
    lines = []
    if replay.mode != "audit" and replay.outside is None:
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
    return lines or ["no event: at every state, surfaces of the map are outside the margin, and limits hold"]


def describe_event(event: Event, *, with_kind: bool = True) -> str:
    unit = UNITS.get(event.kind, "")
    span = f"{event.start_s:.2f} to {event.end_s:.2f} s"
    more = f" and {event.num_names - 1} more" if event.num_names > 1 else ""
    near = "" if event.obstacle is None else f", near {event.obstacle}"
    is_row = event.kind in ROWS
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


def draw_replay(folder: Path, replay: Replay) -> None:
    """Write the mode's pictures over time [s] since the first state."""
    trace, names = replay.trace, replay.model.joint_names
    seconds = (trace.stamp_ns - trace.stamp_ns[0]) * 1e-9
    curves: dict[str, FloatRows] = {name: trace.rows(f"clearance_{name}") for name in replay.fields}
    if "clearance_true" in trace:
        curves["truth"] = trace.rows("clearance_true")
    happened = _intervals(replay, lambda event: event.kind not in INTERVENTIONS and event.source in SHOWN)
    is_late = replay.closed_loop is not None and replay.start_time_s > 0
    title = TITLES[replay.mode] + (f", from {replay.start_time_s:.2f} s of the log" if is_late else "")
    clearance_picture(folder / "clearance.png", seconds, curves, replay.margin, title, happened)
    if np.isfinite(shares := trace["class_shares"]).any():
        evidence_picture(folder / "evidence.png", seconds, shares)
    if replay.mode != "audit":
        broken = frozenset({EventKind.ROW_BROKEN})
        kinds, rows = (INTERVENTIONS, ROWS) if replay.outside is None else (broken, tuple(broken))
        commands_picture(
            folder / "commands.png",
            seconds,
            trace.rows("v"),
            names,
            replay.model.velocity_limit,
            _intervals(replay, lambda event: event.kind in kinds, at_least=rows),
            trace.rows("logged") if "logged" in trace else None,
        )
    if replay.mode == "open-loop":
        open_loop_picture(
            folder / "open_loop.png",
            seconds,
            trace.rows("dv"),
            names,
            trace.rows("barrier_margin_logged"),
            [(event.start_s, event.end_s) for event in replay.events if event.kind in ROWS],
        )
    if replay.mode == "closed-loop" and np.isfinite(trace["divergence_joints"]).any():
        of = [trace[f"divergence_{name}"] for name in ("joints", "position", "rotation")]
        divergence_picture(folder / "divergence.png", seconds, *of)


def _intervals(
    replay: Replay, is_shown: Callable[[Event], bool], *, at_least: Sequence[str] = ()
) -> dict[str, list[tuple[float, float]]]:
    """Spans [s] of shown events by kind and measure, with an entry for each of `at_least`."""
    intervals: dict[str, list[tuple[float, float]]] = {kind: [] for kind in at_least}
    for event in replay.events:
        if is_shown(event):
            intervals.setdefault(f"{event.kind}{SHOWN.get(event.source, '')}", []).append(
                (event.start_s, event.end_s)
            )
    return intervals


def worst_sights(inputs: ReplayInputs, replay: Replay, num: int, frames: Iterable[RgbdFrame]) -> list[Sight | None]:
    """Images of the moments of least clearance (map or truth), least first.

    None for a moment without an image. Frames after the last moment are not read.
    """
    trace = replay.trace
    least = np.fmin(trace["clearance_exact"], trace.get("clearance_true", np.nan))
    states = worst_moments(trace.stamp_ns, least, num)
    moments = [_moment(inputs, replay, state) for state in states if inputs.source.has_clock]
    return sights_of(moments, frames) if moments else []


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
    num_without = len(sights) - len(seen)
    note = f"worst frames: no camera image at or before {num_without} of {len(sights)} moments"
    return [note] if num_without else []


def _moment(inputs: ReplayInputs, replay: Replay, state: int) -> Moment:
    trace, model, names = replay.trace, replay.model, sphere_names(replay.model.sphere_set)
    stamp, sphere = int(trace.stamp_ns[state]), trace["nearest_exact"][state]
    worst, centers = names.index(sphere), model.sphere_centers(trace.rows("q")[state])
    (obstacle,) = inputs.scene.at(stamp).obstacles(np.ascontiguousarray(centers[[worst]]))
    of = {NAMES.get(field, field): f"clearance_{field}" for field in replay.fields}
    of |= {"truth": "clearance_true"} if "clearance_true" in trace else {}
    figures = [f"{name} {100 * float(trace.rows(column)[state]):.2f} cm" for name, column in of.items()]
    rung = trace["rung"][state] if "rung" in trace else ""
    scale = trace.rows("scale")[state] if rung else 1.0
    step = f"   step: {rung}" if rung else ""
    step += f", scaled by {scale:g}" if scale < 1 else ""
    return Moment(
        stamp_ns=stamp,
        centers=centers,
        radii=np.asarray(model.sphere_set.radii),
        is_moving=np.asarray(model.moving_spheres),
        worst=worst,
        obstacle=np.array(obstacle.position),
        caption=(
            f"{trace.seconds(state):.2f} s   {sphere}   clearance: {', '.join(figures)}{step}",
            f"nearest: {obstacle}",
        ),
    )

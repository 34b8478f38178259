"""What a replay leaves in its folder: steps, events, a summary, pictures."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.events import INTERVENTIONS, SHOWN, Event, first_intervention
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import Stopwatch, finite, write_json, write_run
from splatctrl_cli.files.spilled_rows import BLOCK
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.pictures import draw_replay
from splatctrl_cli.jobs.replay.result import Replay
from splatctrl_cli.records import Float64

UNITS = {
    **dict.fromkeys(("below-margin", "in-collision", "between-states", "self-collision", "hold", "cannot-act"), "m"),
    **{"outside-limits": "rad", "stale-map": "s", "not-bounded": "s", "relaxed": "m/s", "row-broken": "m/s"},
}
_SPECIAL = re.compile('[,"\r\n]')

Columns = dict[str, list[object]]

ALL = slice(None)


def chunks_of(replay: Replay) -> Iterator[Columns]:
    """`columns_of` all states, BLOCK at a time, so that a long log is never a table in memory."""
    for first in range(0, len(replay.audit.stamp_ns), BLOCK):
        yield columns_of(replay, slice(first, first + BLOCK))


def columns_of(replay: Replay, rows: slice = ALL) -> Columns:
    """Every column of a range of states, by name."""
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

    def velocity_of(joint: int) -> list[object]:
        return each(lambda step: float(step.velocity[joint]))

    return {
        **{f"v_{joint}": velocity_of(j) for j, joint in enumerate(replay.model.joint_names)},
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
    """Write steps.csv, events.json, summary.json, pictures and run.json; robot: what is said of it, by subject."""
    write_steps(folder / "steps.csv", chunks_of(replay))
    write_json(folder / "events.json", events_document(replay))
    write_json(folder / "summary.json", summary_of(replay, metrics, verdict, robot))
    with stopwatch.stage("picture"):
        draw_replay(folder, replay, seconds_of(replay))
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
    """The verdict, when and why, the metrics, and the words that go with them."""
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
    """events.json: what happened as intervals, what never moves, and where the scene changed under the arm."""
    changes = () if replay.closed_loop is None else replay.closed_loop.scene_changes
    return {
        "events": [_event_document(event) for event in replay.events],
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
    """The first intervention and the first trouble in a sentence each, and how often each kind of event came up."""
    lines = []
    if replay.steps and replay.outside is None:
        first = first_intervention(replay.events)
        lines.append("first intervention: none" if first is None else f"first intervention: {told(first)}")
    troubles = [event for event in replay.events if event.kind not in INTERVENTIONS and event.source in SHOWN]
    for event in list({(event.kind, event.source): event for event in reversed(troubles)}.values())[::-1]:
        count = sum(other.kind == event.kind and other.source == event.source for other in troubles)
        told_once = told(event, with_kind=False)
        lines.append(
            f"{event.kind}{SHOWN[event.source]}: {told_once}" + (f"; {count} such intervals" if count > 1 else "")
        )
    if replay.closed_loop is not None and replay.start_time_s > 0:
        lines.append(f"times count from the start, at {replay.start_time_s:.2f} s of the log")
    return lines or ["no event: no state is below the margin, outside its limits or in space that is not known"]


def told(event: Event, *, with_kind: bool = True) -> str:
    """An event as a sentence: when, what and who, by how much, and what was near."""
    unit = UNITS.get(event.kind, "")
    span = f"{event.start_s:.2f} to {event.end_s:.2f} s"
    more = f" and {event.num_names - 1} more" if event.num_names > 1 else ""
    near = "" if event.obstacle is None else f", near {event.obstacle}"
    is_row = event.kind in ("scene", "self", "limit")
    kind = f"{event.kind} row" if is_row else event.kind if with_kind else ""
    who = " ".join(filter(None, (kind, event.worst_name)))
    worst = f"{'multiplier ' if is_row else ''}{event.worst:.4g} {unit}".rstrip()
    return ", ".join(filter(None, (span, f"{who}{more}", f"worst {worst} at {event.worst_s:.2f} s{near}")))


def seconds_of(replay: Replay) -> Float64:
    """Seconds (T,) since the replay's first state."""
    return np.asarray((replay.audit.stamp_ns - replay.audit.stamp_ns[0]) * 1e-9)


def _event_document(event: Event) -> dict[str, Any]:
    numbers = {name: finite(getattr(event, name)) for name in ("worst", "worst_s", "start_s", "end_s")}
    return asdict(event) | {"unit": UNITS.get(event.kind, "")} | numbers


def write_steps(path: Path, chunks: Iterable[Mapping[str, Sequence[object]]]) -> None:
    """Write chunks of rows, each as equally long columns of the same names, as one CSV.

    Floats have nine digits; NaN and infinity are nothing.
    """
    with path.open("w", encoding="utf-8", newline="") as stream:
        for index, columns in enumerate(chunks):
            if index == 0:
                stream.write(",".join(map(_quoted, columns)) + "\n")
            parts = [_formatted(values) for values in columns.values()]
            row = ",".join(form for form, _ in parts) + "\n"
            stream.write("".join(map(row.__mod__, zip(*(cells for _, cells in parts), strict=True))))


def _formatted(values: Sequence[object]) -> tuple[str, Sequence[object]]:
    """How to format a column's cells, so that a row is formatted at once, and the cells."""
    kinds = set(map(type, values))
    if kinds == {float} and all(map(math.isfinite, values)):  # type: ignore[arg-type]
        return "%.9g", values
    if kinds == {int}:
        return "%d", values
    if kinds == {str}:
        known = {value: _quoted(str(value)) for value in set(values)}
        return "%s", [known[value] for value in values]
    return "%s", [_cell(value) for value in values]


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return _quoted(str(value))


def _quoted(text: str) -> str:
    """A cell as CSV has it: between quotes where it holds a comma, a quote or the end of a line."""
    return '"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text

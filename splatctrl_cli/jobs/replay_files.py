"""What a replay leaves in its folder: steps, events, a summary, pictures."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.config import Config
from splatctrl_cli.control.events import INTERVENTIONS, SHOWN, Event, first_intervention
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import Stopwatch, write_json, write_run
from splatctrl_cli.jobs import replay_compare
from splatctrl_cli.jobs.replay_columns import chunks_of
from splatctrl_cli.jobs.replay_draw import draw_replay
from splatctrl_cli.jobs.replay_metrics import Metrics
from splatctrl_cli.jobs.replay_modes import Replay
from splatctrl_cli.jobs.replay_robot import coverage_words
from splatctrl_cli.records import Float64
from splatctrl_cli.report.replay_output import write_steps

UNITS = {
    **dict.fromkeys(("below-margin", "in-collision", "between-states", "self-collision", "hold", "cannot-act"), "m"),
    **{"outside-limits": "rad", "stale-map": "s", "not-bounded": "s", "relaxed": "m/s"},
}


def write_replay(
    folder: Path,
    replay: "Replay",
    metrics: Metrics,
    verdict: Verdict,
    *,
    config: Config,
    inputs: Mapping[str, str],
    stopwatch: "Stopwatch",
) -> None:
    """Write steps.csv, events.json, summary.json, pictures and run.json."""
    write_steps(folder / "steps.csv", chunks_of(replay))
    write_json(folder / "events.json", events_document(replay))
    if replay.comparison.methods:
        write_json(folder / "methods.json", replay_compare.document_of(replay.comparison))
    write_json(
        folder / "summary.json", summary_of(replay, metrics, verdict, coverage_words(replay.model, config.control))
    )
    with stopwatch.stage("picture"):
        draw_replay(folder, replay, seconds_of(replay))
        replay_compare.draw_methods(folder, replay.comparison, replay.period, replay.margin)
    write_run(
        folder,
        command="replay",
        config=config.as_dict(),
        inputs=inputs,
        metrics=metrics,
        stopwatch=stopwatch,
        verdict=verdict.as_dict(),
    )


def summary_of(replay: Replay, metrics: Metrics, verdict: Verdict, coverage: str) -> dict[str, Any]:
    """The verdict, when and why, the metrics, and the words that go with them."""
    words = {
        "mode": replay.mode,
        "outcome": str(replay.closed_loop.outcome) if replay.closed_loop else f"{replay.mode}: every state",
        "margin": replay.margin,
        "coverage": coverage,
        "units": "m, rad, s",
        "min_clearance": "the smallest exact distance from a moving sphere's surface to the splats",
    }
    return {
        "verdict": verdict.as_dict(),
        "when_and_why": when_and_why(replay),
        "about": words,
        "metrics": metrics,
    }


def events_document(replay: "Replay") -> dict[str, Any]:
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


def when_and_why(replay: "Replay") -> list[str]:
    """The first intervention and the first trouble in a sentence each, and how often each kind of event came up."""
    lines = []
    if replay.steps:
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


def told(event: "Event", *, with_kind: bool = True) -> str:
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


def seconds_of(replay: "Replay") -> "Float64":
    """Seconds (T,) since the replay's first state."""
    return np.asarray((replay.audit.stamp_ns - replay.audit.stamp_ns[0]) * 1e-9)


def _event_document(event: "Event") -> dict[str, Any]:
    document = asdict(event) | {"unit": UNITS.get(event.kind, "")}
    for name in ("worst", "worst_s", "start_s", "end_s"):
        document[name] = finite(document[name])
    return document


def finite(value: float) -> float | None:
    """The value, None where JSON has none for it."""
    return value if math.isfinite(value) else None

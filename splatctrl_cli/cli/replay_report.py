"""What ``splatctrl replay`` says: metrics, tables, and the files of its output folder."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.common import table

if TYPE_CHECKING:
    from splatctrl_cli.config import Config
    from splatctrl_cli.control.audit import AuditTrace
    from splatctrl_cli.control.checks import StaticViolation
    from splatctrl_cli.control.replay import ReplayTrace
    from splatctrl_cli.evaluate.clearance import ClearanceAgreement
    from splatctrl_cli.io.output import Stopwatch
    from splatctrl_cli.records import Float64
    from splatctrl_cli.robot.model import RobotModel

Metrics = dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Replay:
    """One finished replay: the audit of its states, the closed loop that made them, and the truth where it is known.

    num_before_scene: logged states earlier than the first scene, left out; start_time_s: of the closed loop [s].
    """

    model: "RobotModel"
    margin: float
    audit: "AuditTrace"
    num_before_scene: int
    median_radius: float
    static_violations: "tuple[StaticViolation, ...]"
    closed_loop: "ReplayTrace | None" = None
    start_time_s: float = 0.0
    true_clearance: "Float64 | None" = None
    agreement: "Mapping[str, ClearanceAgreement]" = field(default_factory=dict)


def metrics_of(replay: Replay) -> Metrics:
    """Every figure that is printed, written and gated on, by name; None where there is no value."""
    import numpy as np

    from splatctrl_cli.evaluate.clearance import least

    audit = replay.audit
    exact = audit.clearance["exact"].distance
    metrics: Metrics = {
        "num_spheres": len(replay.model.sphere_set.radii),
        "num_bare_links": len(replay.model.bare_links),
        "num_states": len(audit.stamp_ns),
        "num_before_scene": replay.num_before_scene,
        "duration_s": float(audit.stamp_ns[-1] - audit.stamp_ns[0]) * 1e-9,
        "min_clearance": least(exact),
        **{f"min_clearance_{n}": least(c.distance) for n, c in audit.clearance.items() if n != "exact"},
        "min_clearance_true": None if replay.true_clearance is None else least(replay.true_clearance),
        "num_below_margin": int(np.sum(exact < replay.margin)),
        "num_in_collision": int(np.sum(exact < 0)),
        "min_self_clearance": least(audit.self_clearance),
        "min_limit_margin": least(audit.limit_margin),
        "unknown_share": float(np.mean(audit.unknown_share)),
        "num_without_distance": int(np.sum(np.any([np.isnan(c.distance) for c in audit.clearance.values()], axis=0))),
        "num_static_violations": len(replay.static_violations),
    }
    if replay.closed_loop is not None:
        metrics.update(_closed_loop_metrics(replay.closed_loop, replay.start_time_s))
    for name, agreement in replay.agreement.items():
        metrics[f"truth_num_compared_{name}"] = agreement.num_states
        metrics[f"truth_median_{name}"] = agreement.median
        metrics[f"truth_p95_{name}"] = agreement.p95
        metrics[f"truth_largest_{name}"] = agreement.largest
        metrics[f"truth_largest_over_{name}"] = agreement.largest_over
        metrics[f"truth_share_within_{name}"] = agreement.share_within
        metrics["truth_tolerance"] = agreement.tolerance
    return metrics


def _closed_loop_metrics(trace: "ReplayTrace", start_time_s: float) -> Metrics:
    import numpy as np

    from splatctrl_cli.control.ladder import Rung
    from splatctrl_cli.control.replay import Outcome, num_on_rung

    steps, last = trace.steps, trace.steps[-1]
    return {
        "goal_reached": int(trace.outcome is Outcome.GOAL_REACHED),
        "stalled": int(trace.outcome is Outcome.STALLED),
        "start_time_s": start_time_s,
        "num_steps": len(steps),
        "position_error": float(np.linalg.norm(last.pose_error[:3])),
        "rotation_error": float(np.linalg.norm(last.pose_error[3:])),
        "min_barrier_clearance": min(step.clearance for step in steps),
        "num_solved": num_on_rung(trace, Rung.SOLVED),
        "num_relaxed": num_on_rung(trace, Rung.RELAXED),
        "num_minimum_violation": num_on_rung(trace, Rung.MINIMUM_VIOLATION),
        "num_hold": num_on_rung(trace, Rung.HOLD),
        "num_refused": sum(step.num_refused for step in steps),
        "num_scene_hits": sum(change.is_hit for change in trace.scene_changes),
        "num_scaled_back": sum(step.scale < 1 for step in steps),
        "max_residual": _finite(max(step.residual for step in steps)),
    }


def write_replay(
    folder: Path,
    replay: Replay,
    metrics: Metrics,
    *,
    config: "Config",
    inputs: Mapping[str, str],
    stopwatch: "Stopwatch",
) -> None:
    """Write steps.csv, events.json, summary.json, clearance.png and run.json."""
    from splatctrl_cli.evaluate.pictures import clearance_picture
    from splatctrl_cli.io.output import write_json, write_run
    from splatctrl_cli.io.replay_output import write_steps

    columns = columns_of(replay)
    write_steps(folder / "steps.csv", columns)
    write_json(folder / "events.json", events_of(replay))
    write_json(folder / "summary.json", summary_of(replay, metrics))
    curves = {name: clearance.distance for name, clearance in replay.audit.clearance.items()}
    if replay.true_clearance is not None:
        curves["truth"] = replay.true_clearance
    title = "Clearance of the logged motion" if replay.closed_loop is None else "Clearance in closed loop"
    with stopwatch.stage("picture"):
        clearance_picture(folder / "clearance.png", _seconds(replay), curves, replay.margin, title)
    write_run(folder, command="replay", config=config.as_dict(), inputs=inputs, metrics=metrics, stopwatch=stopwatch)


def summary_of(replay: Replay, metrics: Metrics) -> dict[str, Any]:
    """The metrics and the words that go with them."""
    words = {
        "mode": "audit" if replay.closed_loop is None else "closed-loop",
        "outcome": "audited" if replay.closed_loop is None else str(replay.closed_loop.outcome),
        "margin": replay.margin,
        "units": "m, rad, s",
        "min_clearance": "the smallest exact distance from a moving sphere's surface to the splats",
    }
    return {"about": words, "metrics": metrics}


def columns_of(replay: Replay) -> dict[str, list[object]]:
    """The columns of steps.csv, one value per state."""
    from splatctrl_cli.control.arm import sphere_names

    audit, names = replay.audit, sphere_names(replay.model.sphere_set)
    columns: dict[str, list[object]] = {
        "stamp_ns": audit.stamp_ns.tolist(),
        "time_s": _seconds(replay).tolist(),
        **{f"q_{joint}": audit.position[:, j].tolist() for j, joint in enumerate(replay.model.joint_names)},
    }
    for name, clearance in audit.clearance.items():
        columns[f"clearance_{name}"] = clearance.distance.tolist()
        columns[f"nearest_{name}"] = [names[s] for s in clearance.sphere]
    if replay.true_clearance is not None:
        columns["clearance_true"] = replay.true_clearance.tolist()
    columns["self_clearance"] = audit.self_clearance.tolist()
    columns["limit_margin"] = audit.limit_margin.tolist()
    columns["limit_joint"] = [replay.model.joint_names[j] for j in audit.limit_joint]
    columns["unknown_share"] = audit.unknown_share.tolist()
    if replay.closed_loop is not None:
        columns.update(_step_columns(replay.closed_loop, replay.model.joint_names))
    return columns


def _step_columns(trace: "ReplayTrace", joint_names: tuple[str, ...]) -> dict[str, list[object]]:
    import numpy as np

    steps = trace.steps
    return {
        **{f"v_{joint}": [float(step.velocity[j]) for step in steps] for j, joint in enumerate(joint_names)},
        "barrier_clearance": [step.clearance for step in steps],
        "barrier_nearest": [step.nearest for step in steps],
        "rung": [str(step.rung) for step in steps],
        "scale": [step.scale for step in steps],
        "slack": [max((row.slack for row in step.relaxed), default=0.0) for step in steps],
        "relaxed": [" ".join(row.name for row in step.relaxed) for step in steps],
        "intervening": ["; ".join(step.intervening) for step in steps],
        "num_rows": [step.num_rows for step in steps],
        "residual": [step.residual for step in steps],
        "position_error": [float(np.linalg.norm(step.pose_error[:3])) for step in steps],
        "rotation_error": [float(np.linalg.norm(step.pose_error[3:])) for step in steps],
    }


def events_of(replay: Replay) -> dict[str, Any]:
    """What a person should look at: times below the margin, steps that were not plainly solved, still spheres."""
    import numpy as np

    from splatctrl_cli.control.arm import sphere_names
    from splatctrl_cli.control.ladder import Rung
    from splatctrl_cli.evaluate.clearance import intervals_below

    audit, names = replay.audit, sphere_names(replay.model.sphere_set)
    below = [
        {"field": name, **asdict(interval), "sphere": names[clearance.sphere[interval.state]]}
        for name, clearance in audit.clearance.items()
        for interval in intervals_below(audit.stamp_ns, clearance.distance, replay.margin)
    ]
    steps = () if replay.closed_loop is None else replay.closed_loop.steps
    changes = () if replay.closed_loop is None else replay.closed_loop.scene_changes
    return {
        "below_margin": below,
        "outside_limits": [
            {"state": int(i), "joint": replay.model.joint_names[audit.limit_joint[i]], "by": -float(margin)}
            for i, margin in enumerate(audit.limit_margin)
            if margin < 0
        ],
        "in_unknown_space": [
            {"state": int(i), "share": float(audit.unknown_share[i])} for i in np.flatnonzero(audit.unknown_share > 0)
        ],
        "static_violations": [asdict(violation) for violation in replay.static_violations],
        "scene_changes": [
            asdict(change) | {"is_hit": change.is_hit}
            for change in changes
            if abs(change.after - change.before) > 0.01
        ],
        "steps_not_plainly_solved": [
            {
                "step": index,
                "rung": str(step.rung),
                "scale": step.scale,
                "status": step.status,
                "relaxed": [asdict(row) for row in step.relaxed],
                "violated_fixed": list(step.violated_fixed),
            }
            for index, step in enumerate(steps)
            if step.rung is not Rung.SOLVED or step.scale < 1 or step.violated_fixed
        ],
    }


def lines_of(replay: Replay, metrics: Metrics, *, with_steps: bool) -> list[str]:
    """The table on stdout: the metrics, and a row per step on request."""
    lines = table(("replay", "value"), [(name, _shown(value)) for name, value in metrics.items()])
    if replay.static_violations:
        rows = [(violation.sphere, f"{violation.clearance:.4f}") for violation in replay.static_violations]
        lines += ["", "Spheres that no joint moves, within the margin:", *table(("sphere", "clearance"), rows)]
    if with_steps:
        columns = columns_of(replay)
        wanted = [name for name in columns if name != "stamp_ns" and not name.startswith(("q_", "v_"))]
        rows_of_steps = list(zip(*(columns[name] for name in wanted), strict=True))
        lines += ["", *table(wanted, [[_shown(value) for value in row] for row in rows_of_steps])]
    return lines


def _seconds(replay: Replay) -> "Float64":
    import numpy as np

    return np.asarray((replay.audit.stamp_ns - replay.audit.stamp_ns[0]) * 1e-9)


def _shown(value: object) -> str:
    if value is None or value == "":
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _finite(value: float) -> float | None:
    import math

    return value if math.isfinite(value) else None

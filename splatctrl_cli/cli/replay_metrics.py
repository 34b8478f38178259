"""Every figure of a replay, by a name that is known before the work, and when a figure first broke a bound."""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from splatctrl_cli.cli.replay_baseline import BESIDE, FIGURES, STANDSTILL, separation_figures
from splatctrl_cli.cli.replay_compare import figure_names, figures_of
from splatctrl_cli.cli.replay_twists import FIGURES as TWIST_FIGURES

if TYPE_CHECKING:
    from splatctrl_cli.cli.replay_modes import Replay
    from splatctrl_cli.control.step import ControlStep
    from splatctrl_cli.records import Bool, Float64

Metrics = dict[str, float | None]

_HEAD = (
    *("num_spheres", "num_bare_links", "coverage_deficit", "num_self_pairs", "num_states", "num_before_scene"),
    *("duration_s", "min_clearance"),
)
_TAIL = (
    *("min_clearance_true", "num_below_margin", "num_in_collision", "min_self_clearance", "min_limit_margin"),
    *("unknown_share", "num_without_distance", "num_static_violations", "max_map_age_s"),
)
_STEPS = (
    *("intervention_share", "intervention_share_scene", "intervention_share_self", "intervention_share_limit"),
    *("first_intervention_s", "min_barrier_clearance", "num_solved", "num_relaxed", "num_minimum_violation"),
    *("num_hold", "num_refused", "num_scaled_back", "max_residual"),
)
_OPEN_LOOP = (
    *("mean_velocity_difference", "p95_velocity_difference", "max_velocity_difference"),
    *("min_barrier_margin_logged", "num_barrier_broken_logged", "min_velocity_margin_logged"),
)
_CLOSED_LOOP = (
    *("goal_reached", "stalled", "num_goals_reached", "start_time_s", "num_steps", "position_error"),
    *("rotation_error", "num_scene_hits", "num_anchors", "max_divergence_joints", "max_divergence_position"),
    *("max_divergence_rotation_deg", "end_divergence_joints", "end_divergence_position"),
    "end_divergence_rotation_deg",
)
_TRUTH = ("num_compared", "median", "p95", "largest", "largest_over", "share_within")


def metric_names(
    mode: str, fields: Sequence[str], *, has_truth: bool, baselines: Sequence[str] = (), has_twists: bool = False
) -> tuple[str, ...]:
    """The names that `metrics_of` gives for a --mode and --baseline, with fields by name ("exact" first)."""
    names = [*_HEAD, *(f"min_clearance_{name}" for name in fields if name != "exact"), *_TAIL]
    names += [] if mode == "audit" else _STEPS
    names += {"audit": (), "open-loop": _OPEN_LOOP, "closed-loop": _CLOSED_LOOP}[mode]
    names += TWIST_FIGURES if has_twists else ()
    if STANDSTILL in baselines:
        names += [f"{motion}_{figure}" for motion in BESIDE for figure in FIGURES]
    names += figure_names(baselines, has_truth=has_truth)
    if has_truth:
        names += [*(f"truth_{figure}_{name}" for name in fields for figure in _TRUTH), "truth_tolerance"]
    return tuple(names)


def metrics_of(replay: "Replay") -> Metrics:
    """Every figure that is printed, written and gated on, by name; None where there is no value."""
    from splatctrl_cli.evaluate.clearance import least

    audit = replay.audit
    exact = audit.clearance["exact"].distance
    metrics: Metrics = {
        "num_spheres": len(replay.model.sphere_set.radii),
        "num_bare_links": len(replay.model.bare_links),
        "coverage_deficit": None if replay.model.coverage is None else replay.model.coverage.max_deficit,
        "num_self_pairs": len(replay.model.self_pairs()),
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
        "num_without_distance": int(np.sum(_is_blank(replay))),
        "num_static_violations": len(replay.static_violations),
        "max_map_age_s": _largest(replay.map_age_s),
    }
    if replay.steps:
        metrics |= _step_metrics(replay)
    if replay.open_loop is not None:
        metrics |= _open_loop_metrics(replay)
    if replay.closed_loop is not None:
        metrics |= _closed_loop_metrics(replay)
    metrics |= replay.twist_figures
    for motion, separation in replay.separations.items():
        figures = separation_figures(separation, replay.period)
        metrics |= {f"{motion}_{figure}": value for figure, value in figures.items()}
    metrics |= figures_of(replay.comparison)
    for name, agreement in replay.agreement.items():
        metrics[f"truth_num_compared_{name}"] = agreement.num_states
        metrics[f"truth_median_{name}"] = agreement.median
        metrics[f"truth_p95_{name}"] = agreement.p95
        metrics[f"truth_largest_{name}"] = agreement.largest
        metrics[f"truth_largest_over_{name}"] = agreement.largest_over
        metrics[f"truth_share_within_{name}"] = agreement.share_within
        metrics["truth_tolerance"] = agreement.tolerance
    return metrics


def first_time(replay: "Replay", metric: str, holds: Callable[[float], bool]) -> float | None:
    """The first time [s] at which a metric, taken over the states until then, does not hold; None where it is no
    figure of single states.
    """
    series = _running(replay, metric)
    if series is None:
        return None
    empty, values = series
    if not holds(empty):
        return None
    breaks = [not holds(float(value)) for value in values]
    if not any(breaks):
        return None
    stamps = replay.audit.stamp_ns
    return float(stamps[breaks.index(True)] - stamps[0]) * 1e-9


def _running(replay: "Replay", metric: str) -> "tuple[float, Float64] | None":
    """What a metric is before the first state, and over the states up to each (T,)."""
    audit, steps = replay.audit, replay.steps
    exact = audit.clearance["exact"].distance
    lows = {
        "min_clearance": exact,
        **{f"min_clearance_{name}": of.distance for name, of in audit.clearance.items() if name != "exact"},
        "min_clearance_true": replay.true_clearance,
        "min_self_clearance": audit.self_clearance,
        "min_limit_margin": audit.limit_margin,
        "min_barrier_clearance": _each(steps, lambda step: step.clearance) if steps else None,
    }
    if replay.open_loop is not None:
        margins = replay.open_loop.margins
        lows["min_barrier_margin_logged"] = np.array([np.nan if m is None else m.barrier for m in margins])
        lows["min_velocity_margin_logged"] = np.array([np.nan if m is None else m.limit for m in margins])
    low = lows.get(metric)
    if low is not None:
        return np.inf, np.fmin.accumulate(low)
    flags = _flags(replay)
    if metric in flags:
        return 0.0, np.cumsum(flags[metric]).astype(np.float64)
    highs = {"max_map_age_s": replay.map_age_s}
    if replay.divergence is not None:
        of = replay.divergence
        highs |= {
            "max_divergence_joints": of.joints,
            "max_divergence_position": of.position,
            "max_divergence_rotation_deg": np.degrees(of.rotation),
        }
    if replay.open_loop is not None:
        highs["max_velocity_difference"] = np.max(np.abs(replay.open_loop.difference), axis=1)
    return (-np.inf, np.fmax.accumulate(highs[metric])) if metric in highs else None


def _flags(replay: "Replay") -> "dict[str, Bool]":
    """The states (T,) that a count counts."""
    from splatctrl_cli.control.ladder import Rung

    exact = replay.audit.clearance["exact"].distance
    flags: dict[str, Bool] = {
        "num_below_margin": exact < replay.margin,
        "num_in_collision": exact < 0,
        "num_without_distance": _is_blank(replay),
    }
    if replay.steps:
        for rung in (Rung.RELAXED, Rung.MINIMUM_VIOLATION, Rung.HOLD):
            name = "num_" + rung.value.replace("-", "_")
            flags[name] = np.array([step is not None and step.rung is rung for step in replay.steps])
        flags["num_scaled_back"] = np.array([step is not None and step.scale < 1 for step in replay.steps])
    if replay.open_loop is not None:
        flags["num_barrier_broken_logged"] = np.array(
            [m is not None and m.barrier < 0 for m in replay.open_loop.margins]
        )
    return flags


def _step_metrics(replay: "Replay") -> Metrics:
    from splatctrl_cli.control.explain import first_intervention
    from splatctrl_cli.control.open_loop import is_shaped
    from splatctrl_cli.control.step import RowKind

    asked = [step for step in replay.steps if step is not None]
    first, flags = first_intervention(replay.events), _flags(replay)
    is_solved = [step.rung == "solved" for step in asked]
    return {
        "intervention_share": _share(is_shaped(step) for step in asked),
        **{f"intervention_share_{kind}": _share(is_shaped(step, kind) for step in asked) for kind in RowKind},
        "first_intervention_s": None if first is None else first.start_s,
        "min_barrier_clearance": min((step.clearance for step in asked), default=None),
        "num_solved": sum(is_solved),
        "num_relaxed": int(flags["num_relaxed"].sum()),
        "num_minimum_violation": int(flags["num_minimum_violation"].sum()),
        "num_hold": int(flags["num_hold"].sum()),
        "num_refused": sum(step.num_refused for step in asked),
        "num_scaled_back": int(flags["num_scaled_back"].sum()),
        "max_residual": _largest(np.array([step.residual for step in asked])),
    }


def _open_loop_metrics(replay: "Replay") -> Metrics:
    trace = replay.open_loop
    assert trace is not None
    size = np.linalg.norm(trace.difference, axis=1)
    size = size[np.isfinite(size)]
    margins = [margin for margin in trace.margins if margin is not None]
    return {
        "mean_velocity_difference": float(np.mean(size)) if len(size) else None,
        "p95_velocity_difference": float(np.percentile(size, 95)) if len(size) else None,
        "max_velocity_difference": _largest(np.max(np.abs(trace.difference), axis=1)),
        "min_barrier_margin_logged": min((margin.barrier for margin in margins), default=None),
        "num_barrier_broken_logged": sum(margin.barrier < 0 for margin in margins),
        "min_velocity_margin_logged": min((margin.limit for margin in margins), default=None),
    }


def _closed_loop_metrics(replay: "Replay") -> Metrics:
    from splatctrl_cli.control.replay import Outcome

    trace, of = replay.closed_loop, replay.divergence
    assert trace is not None
    assert of is not None
    last = trace.steps[-1]
    ends = {"joints": of.joints, "position": of.position, "rotation_deg": np.degrees(of.rotation)}
    return {
        "goal_reached": int(trace.outcome is Outcome.GOAL_REACHED),
        "stalled": int(trace.outcome is Outcome.STALLED),
        "num_goals_reached": trace.num_reached,
        "start_time_s": replay.start_time_s,
        "num_steps": len(trace.steps),
        "position_error": float(np.linalg.norm(last.pose_error[:3])),
        "rotation_error": float(np.linalg.norm(last.pose_error[3:])),
        "num_scene_hits": sum(change.is_hit for change in trace.scene_changes),
        "num_anchors": len(trace.anchored),
        **{f"max_divergence_{name}": _largest(values) for name, values in ends.items()},
        **{f"end_divergence_{name}": _last(values) for name, values in ends.items()},
    }


def _each(steps: "Sequence[ControlStep | None]", value: "Callable[[ControlStep], float]") -> "Float64":
    return np.array([np.nan if step is None else value(step) for step in steps])


def _is_blank(replay: "Replay") -> "Bool":
    return np.asarray(np.any([np.isnan(of.distance) for of in replay.audit.clearance.values()], axis=0))


def _share(facts: Iterable[bool]) -> float | None:
    listed = list(facts)
    return float(np.mean(listed)) if listed else None


def _largest(values: "Float64") -> float | None:
    """The largest value; None where one is infinite or none is there."""
    there = values[~np.isnan(values)]
    return float(np.max(there)) if len(there) and np.isfinite(there).all() else None


def _last(values: "Float64") -> float | None:
    there = values[np.isfinite(values)]
    return float(there[-1]) if len(there) else None

"""Every figure of a replay, by a name that is known before the work, and when a figure first broke a bound."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from splatctrl_cli.control.events import first_intervention
from splatctrl_cli.control.ladder import Rung
from splatctrl_cli.control.replay import Outcome
from splatctrl_cli.control.step import RowKind
from splatctrl_cli.evaluate.clearance import least
from splatctrl_cli.jobs.replays.compare import figure_names, figures_of
from splatctrl_cli.jobs.replays.goal import TWIST_FIGURES
from splatctrl_cli.jobs.replays.inputs import LOG_FIGURES
from splatctrl_cli.jobs.replays.people import BESIDE, FIGURES, STANDSTILL, separation_figures
from splatctrl_cli.jobs.replays.result import Replay
from splatctrl_cli.jobs.replays.store import RUNGS, Figures
from splatctrl_cli.records import Bool, Float64

Metrics = dict[str, float | None]

_HEAD = (
    *("num_spheres", "num_bare_links", "coverage_deficit", "num_self_pairs", "num_states", "num_before_scene"),
    *("duration_s", "min_clearance"),
)
_TAIL = (
    *("min_clearance_true", "num_below_margin", "num_in_collision", "min_self_clearance", "min_limit_margin"),
    *("max_velocity_share", "max_acceleration_share", "min_clearance_surface", "min_clearance_between", "unjudged_s"),
    *("min_clearance_splats", "max_unseen_share", "max_blind_share", "min_unanswered", "max_evidence_age_s"),
    *("unknown_share", "num_without_distance", "num_static_violations", "max_map_age_s"),
    *("map_error_bound", "map_error_blocks", "map_error_confidence"),
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
    *("rotation_error", "num_scene_hits", "num_anchors", "num_detours"),
    *("max_divergence_joints", "max_divergence_position"),
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
    names += LOG_FIGURES
    names += TWIST_FIGURES if has_twists else ()
    if STANDSTILL in baselines:
        names += [f"{motion}_{figure}" for motion in BESIDE for figure in FIGURES]
    names += figure_names(baselines, has_truth=has_truth)
    if has_truth:
        names += [*(f"truth_{figure}_{name}" for name in fields for figure in _TRUTH), "truth_tolerance"]
    return tuple(names)


def metrics_of(replay: Replay) -> Metrics:
    """Every figure that is printed, written and gated on, by name; None where there is no value."""
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
        "min_clearance_true": None if replay.true_clearance is None else least(np.asarray(replay.true_clearance)),
        "num_below_margin": int(np.sum(exact < replay.margin)),
        "num_in_collision": int(np.sum(exact < 0)),
        "min_self_clearance": least(audit.self_clearance),
        "min_limit_margin": least(audit.limit_margin),
        "max_velocity_share": _largest(replay.strain["velocity"]),
        "max_acceleration_share": _largest(replay.strain["acceleration"]),
        "min_clearance_surface": least(replay.between["surface"]),
        "min_clearance_between": least(replay.between["lower"]),
        "min_clearance_splats": least(replay.between["represented"]),
        "max_unseen_share": _largest(replay.near["unseen"]),
        "max_blind_share": _largest(replay.near["blind"]),
        "min_unanswered": least(replay.near["unanswered"]),
        "max_evidence_age_s": _largest(replay.near["age"]),
        "unjudged_s": float(replay.between["unbounded"].sum()) + replay.lead_in_s,
        "unknown_share": _mean(audit.unknown_share),
        "num_without_distance": int(np.sum(is_blank(replay))),
        "num_static_violations": len(replay.static_violations),
        "max_map_age_s": _largest(np.asarray(replay.map_age_s)),
        **_map_error(replay),
    }
    if replay.kept_steps is not None:
        metrics |= _step_metrics(replay, replay.kept_steps.figures)
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


def _map_error(replay: Replay) -> Metrics:
    """By held-out depth; None without, or where that is too little."""
    bound = None if replay.map_error is None else replay.map_error.bound
    return {
        "map_error_bound": None if bound is None else bound.bound,
        "map_error_blocks": None if bound is None else bound.num_stretches,
        "map_error_confidence": None if bound is None else bound.confidence,
    }


def first_time(replay: Replay, metric: str, holds: Callable[[float], bool]) -> float | None:
    """The first time [s] at which a metric, taken over the states until then, does not hold; None where it is no
    figure of single states.
    """
    series = _running(replay, metric)
    if series is None:
        return None
    empty, values = series
    if not holds(empty):
        return None
    stamps = replay.audit.stamp_ns
    first = next((index for index, value in enumerate(values) if not holds(float(value))), None)
    return None if first is None else float(stamps[first] - stamps[0]) * 1e-9


def _running(replay: Replay, metric: str) -> tuple[float, Float64] | None:
    """What a metric is before the first state, and over the states up to each (T,)."""
    low, high, flags = _lows(replay).get(metric), _highs(replay).get(metric), _flags(replay).get(metric)
    if low is not None:
        return np.inf, np.fmin.accumulate(low())
    if high is not None:
        return -np.inf, np.fmax.accumulate(high())
    return None if flags is None else (0.0, np.cumsum(flags()).astype(np.float64))


def _lows(replay: Replay) -> Mapping[str, Callable[[], Float64]]:
    """Reads the states' values (T,) of which a metric is the least."""
    audit, truth, steps, asked = replay.audit, replay.true_clearance, replay.kept_steps, replay.open_loop
    lows: dict[str, Callable[[], Float64]] = {
        f"min_clearance_{name}".removesuffix("_exact"): partial(getattr, of, "distance")
        for name, of in audit.clearance.items()
    }
    lows["min_self_clearance"] = lambda: audit.self_clearance
    lows["min_limit_margin"] = lambda: audit.limit_margin
    if truth is not None:
        lows["min_clearance_true"] = lambda: np.asarray(truth)
    if steps is not None:
        lows["min_barrier_clearance"] = lambda: steps.figures["clearance"]
    if asked is not None:
        lows["min_barrier_margin_logged"] = lambda: asked.figures["barrier"]
        lows["min_velocity_margin_logged"] = lambda: asked.figures["limit"]
    return lows


def _highs(replay: Replay) -> Mapping[str, Callable[[], Float64]]:
    """Reads the states' values (T,) of which a metric is the largest."""
    of, asked = replay.divergence, replay.open_loop
    highs: dict[str, Callable[[], Float64]] = {"max_map_age_s": lambda: np.asarray(replay.map_age_s)}
    if of is not None:
        highs["max_divergence_joints"] = lambda: of["joints"]
        highs["max_divergence_position"] = lambda: of["position"]
        highs["max_divergence_rotation_deg"] = lambda: np.degrees(of["rotation"])
    if asked is not None:
        highs["max_velocity_difference"] = lambda: asked.figures["largest"]
    return highs


def _flags(replay: Replay) -> Mapping[str, Callable[[], Bool]]:
    """Reads the states (T,) that a count counts."""
    exact, steps, asked = replay.audit.clearance["exact"], replay.kept_steps, replay.open_loop
    flags: dict[str, Callable[[], Bool]] = {
        "num_below_margin": lambda: exact.distance < replay.margin,
        "num_in_collision": lambda: exact.distance < 0,
        "num_without_distance": lambda: is_blank(replay),
    }
    if steps is not None:

        def is_on(rung: Rung) -> Bool:
            return np.asarray(steps.figures["rung"] == RUNGS.index(rung))

        for rung in (Rung.RELAXED, Rung.MINIMUM_VIOLATION, Rung.HOLD):
            flags["num_" + rung.value.replace("-", "_")] = partial(is_on, rung)
        flags["num_scaled_back"] = lambda: steps.figures["scale"] < 1
    if asked is not None:
        flags["num_barrier_broken_logged"] = lambda: asked.figures["barrier"] < 0
    return flags


def _step_metrics(replay: Replay, figures: Figures) -> Metrics:
    first, rung = first_intervention(replay.events), figures["rung"]
    return {
        "intervention_share": _mean(figures["shaped"]),
        **{f"intervention_share_{kind}": _mean(figures[f"shaped {kind}"]) for kind in RowKind},
        "first_intervention_s": None if first is None else first.start_s,
        "min_barrier_clearance": _least(figures["clearance"]),
        "num_solved": int(np.sum(rung == RUNGS.index(Rung.SOLVED))),
        "num_relaxed": int(np.sum(rung == RUNGS.index(Rung.RELAXED))),
        "num_minimum_violation": int(np.sum(rung == RUNGS.index(Rung.MINIMUM_VIOLATION))),
        "num_hold": int(np.sum(rung == RUNGS.index(Rung.HOLD))),
        "num_refused": int(np.nansum(figures["refused"])),
        "num_scaled_back": int(np.sum(figures["scale"] < 1)),
        "max_residual": _largest(figures["residual"]),
    }


def _open_loop_metrics(replay: Replay) -> Metrics:
    assert replay.open_loop is not None
    figures = replay.open_loop.figures
    size = figures["size"]
    size = size[np.isfinite(size)]
    return {
        "mean_velocity_difference": float(np.mean(size)) if len(size) else None,
        "p95_velocity_difference": float(np.percentile(size, 95)) if len(size) else None,
        "max_velocity_difference": _largest(figures["largest"]),
        "min_barrier_margin_logged": _least(figures["barrier"]),
        "num_barrier_broken_logged": int(np.sum(figures["barrier"] < 0)),
        "min_velocity_margin_logged": _least(figures["limit"]),
    }


def _closed_loop_metrics(replay: Replay) -> Metrics:
    trace, of = replay.closed_loop, replay.divergence
    assert trace is not None
    assert of is not None
    last = trace.steps[-1]
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
        "num_detours": len(trace.detours),
        "max_divergence_joints": _largest(of["joints"]),
        "max_divergence_position": _largest(of["position"]),
        "max_divergence_rotation_deg": _largest(np.degrees(of["rotation"])),
        "end_divergence_joints": _last(of["joints"]),
        "end_divergence_position": _last(of["position"]),
        "end_divergence_rotation_deg": _last(np.degrees(of["rotation"])),
    }


def is_blank(replay: Replay) -> Bool:
    """(T,) True where a field has no distance."""
    blank = np.zeros(len(replay.audit.stamp_ns), dtype=np.bool_)
    for of in replay.audit.clearance.values():
        blank |= np.isnan(of.distance)
    return blank


def _mean(values: Float64) -> float | None:
    """Over the states that have a value."""
    there = values[~np.isnan(values)]
    return float(np.mean(there)) if len(there) else None


def _least(values: Float64) -> float | None:
    """Over the states that have a value."""
    there = values[~np.isnan(values)]
    return float(np.min(there)) if len(there) else None


def _largest(values: Float64) -> float | None:
    """The largest value; None where one is infinite or none is there."""
    there = values[~np.isnan(values)]
    return float(np.max(there)) if len(there) and np.isfinite(there).all() else None


def _last(values: Float64) -> float | None:
    there = values[np.isfinite(values)]
    return float(there[-1]) if len(there) else None

"""Every figure of a replay, by a name that is known before the work: its value, what it rests on, and when it first
broke a bound.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from functools import partial
from operator import attrgetter

import numpy as np

from splatctrl_cli.config.fixed import MOTION_WINDOW
from splatctrl_cli.control.events import first_intervention
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTrace
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.evaluate.clearance_agreement import ClearanceAgreement
from splatctrl_cli.evaluate.metrics import (
    LARGEST,
    LAST,
    LEAST,
    LOWEST,
    MEAN,
    P95,
    TOTAL,
    Metric,
    counted,
    folded,
    known,
)
from splatctrl_cli.jobs.replays.compare import figure_names, figures_of
from splatctrl_cli.jobs.replays.goal import TWIST_FIGURES
from splatctrl_cli.jobs.replays.inputs import LOG_FIGURES, LoggedStates
from splatctrl_cli.jobs.replays.result import Replay
from splatctrl_cli.jobs.replays.standstill_baseline import BESIDE, FIGURES, STANDSTILL, separation_figures
from splatctrl_cli.jobs.replays.state_store import RUNGS
from splatctrl_cli.records import Bool, Float64

Metrics = dict[str, float | None]
Counts = dict[str, int]
Declared = tuple[Metric[Replay], ...]


def num_states(replay: Replay) -> int:
    """That were judged."""
    return len(replay.audit.stamp_ns)


def is_blank(replay: Replay) -> Bool:
    """(T,) True where a field has no distance."""
    blank = np.zeros(len(replay.audit.stamp_ns), dtype=np.bool_)
    for of in replay.audit.clearance.values():
        blank |= np.isnan(of.distance)
    return blank


def _single(
    name: str, value: Callable[[Replay], float | None], count: Callable[[Replay], int] = num_states
) -> Metric[Replay]:
    """A figure that is not made of a column."""
    return Metric(name=name, value=value, count=count)


def _clearance(field: str) -> Metric[Replay]:
    name = "min_clearance" if field == "exact" else f"min_clearance_{field}"
    return folded(name, LEAST, lambda replay: replay.audit.clearance[field].distance)


def _exact(replay: Replay) -> Float64:
    return replay.audit.clearance["exact"].distance


def _of(columns: str, name: str) -> Callable[[Replay], Float64]:
    """Reads a column of the replay's figures: `between`, `near`, `strain`, `divergence`, or those of a controller."""
    figures = attrgetter(columns)
    return lambda replay: figures(replay)[name]


def _intervals(replay: Replay) -> int:
    return num_states(replay) - 1


def _num_sudden(replay: Replay) -> int:
    """States that have an acceleration, where that has a limit."""
    since = replay.audit.stamp_ns - replay.audit.stamp_ns[0]
    return int(np.sum(since >= 2 * MOTION_WINDOW * 1e9)) if np.any(replay.config.control.max_acceleration) else 0


def _deficit(replay: Replay) -> float | None:
    return None if replay.model.coverage is None else replay.model.coverage.max_deficit


def _map_error(name: str, figure: str) -> Metric[Replay]:
    """By held-out depth; None without, or where that is too little."""

    def value(replay: Replay) -> float | None:
        bound = None if replay.map_error is None else replay.map_error.bound
        found: float | None = None if bound is None else getattr(bound, figure)
        return found

    return _single(name, value, lambda replay: 0 if replay.map_error is None else replay.map_error.num_seen)


OF_AUDIT: Declared = (
    _single("num_spheres", lambda replay: len(replay.model.sphere_set.radii)),
    _single("num_bare_links", lambda r: len(r.model.bare_links), lambda r: len(r.model.urdf.links)),
    _single("coverage_deficit", _deficit, lambda r: 0 if r.model.coverage is None else len(r.model.coverage.links)),
    _single("num_self_pairs", lambda replay: len(replay.model.self_pairs())),
    _single("num_states", num_states),
    _single("num_before_scene", lambda replay: replay.num_before_scene),
    _single("duration_s", lambda replay: float(replay.audit.stamp_ns[-1] - replay.audit.stamp_ns[0]) * 1e-9),
)
OF_STATES: Declared = (
    folded("min_clearance_true", LEAST, lambda r: np.asarray(() if r.true_clearance is None else r.true_clearance)),
    counted("num_below_margin", _exact, lambda replay, values: values < replay.margin),
    counted("num_in_collision", _exact, lambda _, values: values < 0),
    folded(
        "min_self_clearance",
        LEAST,
        lambda replay: replay.audit.self_clearance,
        lambda replay: num_states(replay) if len(replay.model.self_pairs()) else 0,
    ),
    folded("min_limit_margin", LEAST, lambda replay: replay.audit.limit_margin, num_states),
    folded("max_velocity_share", LARGEST, _of("strain", "velocity"), _intervals),
    folded("max_acceleration_share", LARGEST, _of("strain", "acceleration"), _num_sudden),
    folded("min_clearance_surface", LEAST, _of("between", "surface")),
    folded("min_clearance_between", LEAST, _of("between", "lower")),
    folded("min_clearance_splats", LEAST, _of("between", "represented")),
    folded("max_unseen_share", LARGEST, _of("near", "unseen")),
    folded("max_blind_share", LARGEST, _of("near", "blind")),
    folded("min_unanswered", LEAST, _of("near", "unanswered"), num_states),
    folded("max_evidence_age_s", LARGEST, _of("near", "age")),
    _single("unjudged_s", lambda r: float(r.between["unbounded"].sum()) + r.lead_in_s, _intervals),
    folded("unknown_share", MEAN, lambda replay: replay.audit.unknown_share),
    counted("num_without_distance", lambda r: is_blank(r).astype(np.float64), lambda _, values: values > 0),
    _single("num_static_violations", lambda r: len(r.static_violations), lambda r: len(r.statics)),
    folded("max_map_age_s", LARGEST, lambda replay: np.asarray(replay.map_age_s)),
    _map_error("map_error_bound", "bound"),
    _map_error("map_error_blocks", "num_stretches"),
    _map_error("map_error_confidence", "confidence"),
)


STEPS, ASKED = partial(_of, "kept_steps.figures"), partial(_of, "open_loop.figures")


def _rung(rung: Rung) -> Metric[Replay]:
    name = "num_" + rung.value.replace("-", "_")
    return counted(name, STEPS("rung"), lambda _, values: values == RUNGS.index(rung))


def _first_intervention(replay: Replay) -> float | None:
    first = first_intervention(replay.events)
    return None if first is None else first.start_s


OF_STEPS: Declared = (
    folded("intervention_share", MEAN, STEPS("shaped")),
    *(folded(f"intervention_share_{kind}", MEAN, STEPS(f"shaped {kind}")) for kind in RowKind),
    _single("first_intervention_s", _first_intervention),
    folded("min_barrier_clearance", LOWEST, STEPS("clearance")),
    *(_rung(rung) for rung in (Rung.SOLVED, Rung.RELAXED, Rung.MINIMUM_VIOLATION, Rung.HOLD)),
    folded("num_refused", TOTAL, STEPS("refused")),
    counted("num_scaled_back", STEPS("scale"), lambda _, values: values < 1),
    folded("max_residual", LARGEST, STEPS("residual")),
)
OF_OPEN_LOOP: Declared = (
    folded("mean_velocity_difference", MEAN, ASKED("size")),
    folded("p95_velocity_difference", P95, ASKED("size")),
    folded("max_velocity_difference", LARGEST, ASKED("largest")),
    folded("min_barrier_margin_logged", LOWEST, ASKED("barrier")),
    counted("num_barrier_broken_logged", ASKED("barrier"), lambda _, values: values < 0),
    folded("min_velocity_margin_logged", LOWEST, ASKED("limit")),
)


def _trace(name: str, value: Callable[[ReplayTrace], float]) -> Metric[Replay]:
    """A figure of the closed loop."""

    def of_trace(replay: Replay) -> float:
        assert replay.closed_loop is not None
        return value(replay.closed_loop)

    return _single(name, of_trace)


def _rotation_deg(replay: Replay) -> Float64:
    return np.degrees(_of("divergence", "rotation")(replay))


OF_CLOSED_LOOP: Declared = (
    _trace("goal_reached", lambda trace: int(trace.outcome is Outcome.GOAL_REACHED)),
    _trace("stalled", lambda trace: int(trace.outcome is Outcome.STALLED)),
    _trace("num_goals_reached", lambda trace: trace.num_reached),
    _single("start_time_s", lambda replay: replay.start_time_s),
    _trace("num_steps", lambda trace: len(trace.steps)),
    _trace("position_error", lambda trace: float(np.linalg.norm(trace.steps[-1].pose_error[:3]))),
    _trace("rotation_error", lambda trace: float(np.linalg.norm(trace.steps[-1].pose_error[3:]))),
    _trace("num_scene_hits", lambda trace: sum(change.is_hit for change in trace.scene_changes)),
    _trace("num_anchors", lambda trace: len(trace.anchored)),
    _trace("num_detours", lambda trace: len(trace.detours)),
    *(
        folded(f"{prefix}_divergence_{name}", fold, column, num_states)
        for prefix, fold in (("max", LARGEST), ("end", LAST))
        for name, column in (
            ("joints", _of("divergence", "joints")),
            ("position", _of("divergence", "position")),
            ("rotation_deg", _rotation_deg),
        )
    ),
)
OF_MODE: dict[str, Declared] = {
    "audit": (),
    "open-loop": (*OF_STEPS, *OF_OPEN_LOOP),
    "closed-loop": (*OF_STEPS, *OF_CLOSED_LOOP),
}
TRUTH = tuple(("num_compared" if f.name == "num_states" else f.name) for f in fields(ClearanceAgreement))


def _declared(mode: str, of_fields: Sequence[str]) -> Declared:
    """The metrics of a --mode with fields by name ("exact" first)."""
    return (*OF_AUDIT, *map(_clearance, of_fields), *OF_STATES, *OF_MODE[mode])


def _declared_of(replay: Replay) -> Declared:
    return _declared(replay.mode, tuple(replay.audit.clearance))


def metric_names(
    mode: str, of_fields: Sequence[str], *, has_truth: bool, baselines: Sequence[str] = (), has_twists: bool = False
) -> tuple[str, ...]:
    """The names that `metrics_of` and the log's own figures have for a --mode and --baseline."""
    names = [metric.name for metric in _declared(mode, of_fields)]
    names += LOG_FIGURES
    names += TWIST_FIGURES if has_twists else ()
    if STANDSTILL in baselines:
        names += [f"{motion}_{figure}" for motion in BESIDE for figure in FIGURES]
    names += figure_names(baselines, has_truth=has_truth)
    if has_truth:
        names += [*(f"truth_{of}_{name}" for name in of_fields for of in TRUTH if of != "tolerance")]
        names += ["truth_tolerance"]
    return tuple(names)


def metrics_of(replay: Replay) -> Metrics:
    """Every figure that is printed, written and gated on, by name; None where there is no value."""
    metrics: Metrics = {metric.name: metric.value(replay) for metric in _declared_of(replay)}
    metrics |= replay.twist_figures
    for motion, separation in replay.separations.items():
        figures = separation_figures(separation, replay.period)
        metrics |= {f"{motion}_{figure}": value for figure, value in figures.items()}
    metrics |= figures_of(replay.comparison)
    for name, agreement in replay.agreement.items():
        found = dict(zip(TRUTH, asdict(agreement).values(), strict=True))
        tolerance = found.pop("tolerance")
        metrics |= {f"truth_{figure}_{name}": value for figure, value in found.items()}
        metrics["truth_tolerance"] = tolerance
    return metrics


def counts_of(replay: Replay, logged: LoggedStates, metrics: Metrics) -> Counts:
    """How many states, intervals, spheres or points each metric rests on; where nothing else is known of it, the
    states that were judged.
    """
    found = dict.fromkeys(metrics, num_states(replay))
    found |= {metric.name: metric.count(replay) for metric in _declared_of(replay)}
    for motion, separation in replay.separations.items():
        there = known(separation.distance)
        found |= {f"{motion}_{name}_human_distance": there for name in ("min", "mean")}
    for method in replay.comparison.methods:
        if method not in replay.comparison.figures:
            found |= {name: 0 for name in metrics if name.startswith(f"{method}_min_")}
    for field, agreement in replay.agreement.items():
        names = (name for name in TRUTH if name not in {"num_compared", "tolerance"})
        found |= {f"truth_{name}_{field}": agreement.num_states for name in names}
    return {name: (found | logged.counts())[name] for name in metrics}


def first_time(replay: Replay, metric: str, holds: Callable[[float], bool]) -> float | None:
    """The first time [s] at which a metric, taken over the states until then, does not hold; None where it is no
    figure of single states.
    """
    running = next((of.running for of in _declared_of(replay) if of.name == metric), None)
    if running is None:
        return None
    start, values = running(replay)
    if not holds(start):
        return None
    stamps = replay.audit.stamp_ns
    first = next((index for index, value in enumerate(values) if not holds(float(value))), None)
    return None if first is None else float(stamps[first] - stamps[0]) * 1e-9

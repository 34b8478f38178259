"""Figures of a replay by predefined names: value, sample count, first failure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.columns import RUNGS, first_intervention
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import Outcome, ReplayTrace
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.evaluate.metrics import (
    AGE,
    BAD_SHARE,
    DESCRIBES,
    ERROR,
    FAULTS,
    GAP,
    GOOD_SHARE,
    LARGEST,
    LAST,
    LEAST,
    LENGTH,
    LOWEST,
    MEAN,
    NUMBER,
    P95,
    TIME,
    TOTAL,
    Better,
    Fold,
    Scale,
)
from splatctrl_cli.jobs.replay.goal import TWIST_FIGURES
from splatctrl_cli.jobs.replay.inputs import LOG_FIGURES, LoggedStates
from splatctrl_cli.jobs.replay.request import Replay
from splatctrl_cli.records import Bool, Float64
from splatctrl_cli.voxels import EvidenceClass

Metrics = dict[str, float | None]
num_states: Callable[[Replay], int] = attrgetter("num_states")


@dataclass(frozen=True, kw_only=True)
class Measure:
    """Figure of a replay: its value, and its number of states, links or points.

    running: the value before the first state, and values (T,) up to each state; None if not of states. column: of
    ``steps.csv`` that shows the figure, or empty; pick: the row there: "least", "largest", or a word.
    """

    name: str
    value: Callable[[Replay], float | None]
    count: Callable[[Replay], int] = num_states
    scale: Scale = DESCRIBES
    running: Callable[[Replay], tuple[float, Float64]] | None = None
    column: str = ""
    pick: str = ""


def _of(
    column: str,
    name: str,
    fold: Fold,
    scale: Scale = DESCRIBES,
    *,
    part: int | None = None,
    where: Callable[[Replay, Float64], Bool] | None = None,
    count: Callable[[Replay], int] | None = None,
    shown: str = "",
) -> Measure:
    """A fold of a column (T,) of the trace, or of one `part` of it.

    where: fold 1 where this is true, else 0. count: by default the states with a value. shown: column of
    ``steps.csv``.
    """

    def values(replay: Replay) -> Float64:
        whole = replay.trace.get(column, np.empty(0))
        own = whole if part is None else whole[:, part]
        return own if where is None else np.where(np.isnan(own), np.nan, where(replay, own))

    accumulate = fold.accumulate
    return Measure(
        name=name,
        value=lambda replay: fold.of(values(replay)),
        count=count or (lambda replay: int(np.sum(~np.isnan(values(replay))))),
        running=None if accumulate is None else lambda replay: (fold.start, accumulate(values(replay))),
        scale=scale,
        column=shown,
        pick=fold.pick,
    )


Declared = tuple[Measure, ...]


def _clearance(field: str) -> Measure:
    column = f"clearance_{field}"
    return _of(column, "min_clearance" if field == "exact" else f"min_{column}", LEAST, GAP, shown=column)


def _num_sudden(replay: Replay) -> int:
    since = replay.trace.stamp_ns - replay.trace.stamp_ns[0]
    return (
        int(np.sum(since >= 2 * fixed.MOTION_WINDOW * 1e9)) if np.any(replay.config.control.max_acceleration) else 0
    )


def _map_error(name: str, figure: str, scale: Scale) -> Measure:
    return Measure(
        name=name,
        value=lambda r: getattr(r.map_error.bound, figure) if r.map_error and r.map_error.bound else None,
        count=lambda r: r.map_error.num_seen if r.map_error else 0,
        scale=scale,
    )


LIMIT = Scale(unit="rad", better=Better.HIGHER, absolute=1e-3)  # or m, of a prismatic joint
SPEED = Scale(unit="rad/s", better=Better.LOWER, absolute=1e-3, relative=0.02)
SLACK = Scale(unit="m/s", better=Better.HIGHER, absolute=1e-3, relative=0.02)  # or rad/s, by the row
AT_GOAL = Scale(unit="m", better=Better.LOWER, absolute=ControlConfig().goal_position)  # within it, it is reached
TURNED = Scale(unit="rad", better=Better.LOWER, absolute=ControlConfig().goal_rotation)
LATER = Scale(unit="s", better=Better.HIGHER, absolute=0.01)
FULFILLED = Scale(better=Better.HIGHER)  # of 0 or 1, and of counts
NEAREST = "clearance_exact"
OF_AUDIT: Declared = (
    Measure(name="num_spheres", value=lambda replay: len(replay.model.sphere_set.radii)),
    Measure(
        name="num_bare_links",
        value=lambda replay: len(replay.model.bare_links),
        count=lambda replay: len(replay.model.urdf.links),
        scale=FAULTS,
    ),
    Measure(
        name="coverage_deficit",
        value=lambda r: None if r.model.coverage is None else r.model.coverage.max_deficit,
        count=lambda r: 0 if r.model.coverage is None else len(r.model.coverage.links),
        scale=ERROR,
    ),
    Measure(name="num_self_pairs", value=lambda replay: len(replay.model.self_pairs())),
    Measure(name="num_states", value=num_states),
    Measure(name="num_before_scene", value=lambda replay: replay.num_before_scene, scale=FAULTS),
    Measure(name="duration_s", value=lambda replay: replay.trace.seconds(-1), scale=TIME),
)
OF_STATES: Declared = (
    _clearance("true"),
    _of(NEAREST, "num_below_margin", NUMBER, FAULTS, where=lambda replay, d: d < replay.margin, shown=NEAREST),
    _of(NEAREST, "num_in_collision", NUMBER, FAULTS, where=lambda _, d: d < 0, shown=NEAREST),
    _of(
        "self_clearance",
        "min_self_clearance",
        LEAST,
        GAP,
        count=lambda replay: int(np.isfinite(replay.trace["self_clearance"]).sum()),
        shown="self_clearance",
    ),
    _of("limit_margin", "min_limit_margin", LEAST, LIMIT, shown="limit_margin"),
    _of("velocity_share", "max_velocity_share", LARGEST, BAD_SHARE, count=lambda replay: replay.num_states - 1),
    _of("acceleration_share", "max_acceleration_share", LARGEST, BAD_SHARE, count=_num_sudden),
    _of("clearance_surface", "min_clearance_surface", LEAST, GAP, shown=NEAREST),
    _of("clearance_between", "min_clearance_between", LEAST, GAP, shown=NEAREST),
    _of("clearance_splats", "min_clearance_splats", LEAST, GAP, shown=NEAREST),
    _of("unseen", "max_unseen_share", LARGEST, BAD_SHARE),
    _of("assumed", "max_assumed_share", LARGEST, BAD_SHARE),
    _of("unseen_path", "min_unseen_path", LEAST, GAP, count=num_states),
    _of("blind_to_surface", "min_blind_to_surface", LEAST, GAP, count=num_states),
    *(
        figure
        for kind in EvidenceClass
        for figure in (
            _of("class_shares", f"max_share_{kind.name.lower()}", LARGEST, BAD_SHARE, part=kind),
            _of(
                "class_distance",
                f"min_distance_{kind.name.lower()}",
                LEAST,
                GAP,
                part=kind,
                count=num_states,
            ),
        )
    ),
    _of("evidence_age", "max_evidence_age_s", LARGEST, AGE),
    Measure(
        name="unjudged_s",
        value=lambda r: float(r.trace["unbounded_s"].sum()) + r.lead_in_s,
        count=lambda replay: replay.num_states - 1,
        scale=AGE,
    ),
    _of("unknown_share", "unknown_share", MEAN, BAD_SHARE, shown="unknown_share"),
    _of("is_blank", "num_without_distance", NUMBER, FAULTS),
    Measure(
        name="num_static_violations",
        value=lambda replay: len(replay.static_violations),
        count=lambda replay: len(replay.statics),
        scale=Scale(better=Better.LOWER, absolute=2, relative=0.05),
    ),
    _of("map_age_s", "max_map_age_s", LARGEST, AGE, shown="map_age_s"),
    _map_error("map_error_bound", "bound", ERROR),
    _map_error("map_error_blocks", "num_blocks", DESCRIBES),
    _map_error("map_error_confidence", "confidence", GOOD_SHARE),
)


def _rung(rung: Rung) -> Measure:
    name, number = "num_" + rung.value.replace("-", "_"), RUNGS.index(rung)
    scale = Scale(better=Better.HIGHER, relative=0.05) if rung is Rung.SOLVED else FAULTS
    measure = _of("rung_number", name, NUMBER, scale, where=lambda _, rungs: rungs == number, shown="rung")
    return replace(measure, pick=rung.value)


OF_STEPS: Declared = (
    _of("shaped", "intervention_share", MEAN),
    *(_of(f"shaped_{kind}", f"intervention_share_{kind}", MEAN) for kind in RowKind),
    Measure(
        name="first_intervention_s",
        value=lambda replay: getattr(first_intervention(replay.events), "start_s", None),
        scale=TIME,
    ),
    _of("barrier_clearance", "min_barrier_clearance", LOWEST, GAP, shown="barrier_clearance"),
    *(_rung(rung) for rung in (Rung.SOLVED, Rung.RELAXED, Rung.MINIMUM_VIOLATION, Rung.HOLD)),
    _of("num_refused", "num_refused", TOTAL, FAULTS),
    _of("scale", "num_scaled_back", NUMBER, FAULTS, where=lambda _, scales: scales < 1, shown="scale"),
    _of("residual", "max_residual", LARGEST, Scale(better=Better.LOWER, absolute=1e-6), shown="residual"),
)
DIFFERENCE, BARRIER, VELOCITY = "velocity_difference", "barrier_margin_logged", "velocity_margin_logged"
OF_OPEN_LOOP: Declared = (
    _of(DIFFERENCE, "mean_velocity_difference", MEAN, SPEED, shown=DIFFERENCE),
    _of(DIFFERENCE, "p95_velocity_difference", P95, SPEED, shown=DIFFERENCE),
    _of("largest_difference", "max_velocity_difference", LARGEST, SPEED, shown=DIFFERENCE),
    _of(BARRIER, "min_barrier_margin_logged", LOWEST, SLACK, shown=BARRIER),
    _of(BARRIER, "num_barrier_broken_logged", NUMBER, FAULTS, where=lambda _, room: room < 0, shown=BARRIER),
    _of(VELOCITY, "min_velocity_margin_logged", LOWEST, SLACK, shown=VELOCITY),
)


def _trace(name: str, value: Callable[[ReplayTrace], float], scale: Scale = DESCRIBES) -> Measure:
    return Measure(
        name=name, value=lambda replay: value(replay.closed_loop) if replay.closed_loop else None, scale=scale
    )


OF_CLOSED_LOOP: Declared = (
    _trace("goal_reached", lambda trace: int(trace.outcome is Outcome.GOAL_REACHED), FULFILLED),
    _trace("stalled", lambda trace: int(trace.outcome is Outcome.STALLED), FAULTS),
    _trace("num_goals_reached", lambda trace: trace.num_reached, FULFILLED),
    Measure(name="start_time_s", value=attrgetter("start_time_s"), scale=TIME),
    _trace("num_steps", lambda trace: len(trace.steps)),
    _of("position_error", "position_error", LAST, AT_GOAL),
    _of("rotation_error", "rotation_error", LAST, TURNED),
    Measure(name="num_scene_hits", value=lambda r: sum(change.is_hit for change in r.scene_changes), scale=FAULTS),
    _trace("num_anchors", lambda trace: len(trace.anchored)),
    _trace("num_detours", lambda trace: len(trace.detours)),
    *(
        _of(column, f"{prefix}_{column}", fold, Scale(unit=unit), count=num_states, shown=column)
        for prefix, fold in (("max", LARGEST), ("end", LAST))
        for column, unit in (
            ("divergence_joints", "rad"),
            ("divergence_position", "m"),
            ("divergence_rotation_deg", "degrees"),
        )
    ),
)
OF_MODE: dict[str, Declared] = {
    "audit": (),
    "open-loop": (*OF_STEPS, *OF_OPEN_LOOP),
    "closed-loop": (*OF_STEPS, *OF_CLOSED_LOOP),
}
SEPARATION: Declared = (
    _of("separation_margin", "separation_margin_min", LEAST, GAP, shown="separation_margin"),
    Measure(
        name="time_below_separation",
        value=lambda replay: float(replay.trace["below_s"].sum()),
        running=lambda replay: (0.0, np.cumsum(replay.trace["below_s"])),
        scale=AGE,
        column="separation_margin",
        pick="least",
    ),
    _of("speed_scale", "speed_scale_min", LEAST, Scale(better=Better.HIGHER, absolute=0.01), shown="speed_scale"),
    _of("time_to_contact", "time_to_contact_min", LEAST, LATER, shown="time_to_contact"),
    _of("stop_clearance", "stop_clearance_min", LEAST, GAP, shown="stop_clearance"),
)
AGREEMENT = {
    **dict.fromkeys(("median", "p95", "largest", "largest_over"), ERROR),
    "share_within": GOOD_SHARE,
    "num_compared": DESCRIBES,
}  # scales of clearance_agreement's figures, except its tolerance


def _list_metrics(mode: str, of_fields: Sequence[str], *, has_separation: bool) -> Declared:
    separation = SEPARATION if has_separation else ()
    return (*OF_AUDIT, *map(_clearance, of_fields), *OF_STATES, *OF_MODE[mode], *separation)


def _metrics_of(replay: Replay) -> Declared:
    return _list_metrics(replay.mode, replay.fields, has_separation=replay.separation is not None)


def metric_scales(
    mode: str, of_fields: Sequence[str], *, has_truth: bool, has_twists: bool = False, has_separation: bool = False
) -> dict[str, Scale]:
    """Comparison scales of `metrics_of` and of the log's own figures, by name."""
    of_states = {
        metric.name: metric.scale for metric in _list_metrics(mode, of_fields, has_separation=has_separation)
    }
    scales = of_states | LOG_FIGURES | (TWIST_FIGURES if has_twists else {})
    if has_truth:
        scales |= {f"truth_{figure}_{name}": scale for name in of_fields for figure, scale in AGREEMENT.items()}
        scales["truth_tolerance"] = LENGTH
    return scales


def shown_metrics(mode: str, of_fields: Sequence[str]) -> dict[str, Measure]:
    """Figures that a column of ``steps.csv`` shows, by name."""
    return {metric.name: metric for metric in _list_metrics(mode, of_fields, has_separation=True) if metric.column}


def metrics_of(replay: Replay) -> Metrics:
    """Every printed, written and gated figure by name; None without a value."""
    metrics: Metrics = {metric.name: metric.value(replay) for metric in _metrics_of(replay)}
    metrics |= replay.twist_figures
    for name, agreement in replay.agreement.items():
        metrics |= {f"truth_{figure}_{name}": agreement[figure] for figure in agreement if figure != "tolerance"}
        metrics["truth_tolerance"] = agreement["tolerance"]
    return metrics


def counts_of(replay: Replay, logged: LoggedStates, metrics: Metrics) -> dict[str, int]:
    """Number of states, intervals, spheres or points behind each metric, by default judged states."""
    counts = dict.fromkeys(metrics, replay.num_states)
    counts |= {metric.name: metric.count(replay) for metric in _metrics_of(replay)}
    for field, agreement in replay.agreement.items():
        compared = int(agreement["num_compared"] or 0)
        counts |= {f"truth_{name}_{field}": compared for name in AGREEMENT if name != "num_compared"}
    return {name: (counts | logged.counts())[name] for name in metrics}


def first_time(replay: Replay, metric: str, holds: Callable[[float], bool]) -> float | None:
    """First time [s] at which a metric over the states so far does not hold.

    None also for metrics that are not of states.
    """
    measure = next((of for of in _metrics_of(replay) if of.name == metric), None)
    if measure is None or measure.running is None:
        return None
    start, values = measure.running(replay)
    broken = (index for index, value in enumerate(values) if not holds(float(value)))
    first = next(broken, None) if holds(start) else None
    return None if first is None else replay.trace.seconds(first)

"""Metrics of a replay by predefined names: value, sample count, first failure."""

from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.events import first_intervention
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
    P95,
    TIME,
    TOTAL,
    Better,
    Metric,
    Scale,
    Shown,
    counted,
    folded,
)
from splatctrl_cli.jobs.replay.goal import TWIST_FIGURES
from splatctrl_cli.jobs.replay.inputs import LOG_FIGURES, LoggedStates
from splatctrl_cli.jobs.replay.request import Replay
from splatctrl_cli.jobs.replay.state_store import RUNGS
from splatctrl_cli.records import Bool, Float64
from splatctrl_cli.voxels import EvidenceClass

Metrics = dict[str, float | None]
Declared = tuple[Metric[Replay], ...]
num_states: Callable[[Replay], int] = attrgetter("num_states")


def is_blank(replay: Replay) -> Bool:
    """(T,) True where a field has no distance."""
    return np.asarray(np.any([np.isnan(np.asarray(of)) for of in replay.audit.clearance.values()], axis=0))


def _single(
    name: str,
    value: Callable[[Replay], float | None],
    count: Callable[[Replay], int] = num_states,
    scale: Scale = DESCRIBES,
) -> Metric[Replay]:
    return Metric(name=name, value=value, count=count, scale=scale)


def _clearance(field: str) -> Metric[Replay]:
    name = "min_clearance" if field == "exact" else f"min_clearance_{field}"
    return folded(
        name, LEAST, AUDIT(f"distance {field}"), scale=GAP, shown=Shown(column=f"clearance_{field}", pick="least")
    )


def _column(columns: str, name: str, part: int | None = None) -> Callable[[Replay], Float64]:
    figures = attrgetter(columns)
    return lambda replay: figures(replay)[name] if part is None else figures(replay)[name][:, part]


def _num_sudden(replay: Replay) -> int:
    since = replay.audit.stamp_ns - replay.audit.stamp_ns[0]
    return (
        int(np.sum(since >= 2 * fixed.MOTION_WINDOW * 1e9)) if np.any(replay.config.control.max_acceleration) else 0
    )


def _map_error(name: str, figure: str, scale: Scale) -> Metric[Replay]:
    return _single(
        name,
        lambda r: getattr(r.map_error.bound, figure) if r.map_error and r.map_error.bound else None,
        lambda r: r.map_error.num_seen if r.map_error else 0,
        scale,
    )


def _intervals(replay: Replay) -> int:
    return num_states(replay) - 1


LIMIT = Scale(unit="rad", better=Better.HIGHER, absolute=1e-3)  # or m, of a prismatic joint
SPEED = Scale(unit="rad/s", better=Better.LOWER, absolute=1e-3, relative=0.02)
SLACK = Scale(unit="m/s", better=Better.HIGHER, absolute=1e-3, relative=0.02)  # or rad/s, by the row
AT_GOAL = Scale(unit="m", better=Better.LOWER, absolute=ControlConfig().goal_position)  # within it, it is reached
TURNED = Scale(unit="rad", better=Better.LOWER, absolute=ControlConfig().goal_rotation)
FULFILLED = Scale(better=Better.HIGHER)  # of 0 or 1, and of counts
NEAREST = Shown(column="clearance_exact", pick="least")
AUDIT = partial(_column, "audit.figures")
OF_AUDIT: Declared = (
    _single("num_spheres", lambda replay: len(replay.model.sphere_set.radii)),
    _single("num_bare_links", lambda r: len(r.model.bare_links), lambda r: len(r.model.urdf.links), FAULTS),
    _single(
        "coverage_deficit",
        lambda r: None if r.model.coverage is None else r.model.coverage.max_deficit,
        lambda r: 0 if r.model.coverage is None else len(r.model.coverage.links),
        ERROR,
    ),
    _single("num_self_pairs", lambda replay: len(replay.model.self_pairs())),
    _single("num_states", num_states),
    _single("num_before_scene", lambda replay: replay.num_before_scene, scale=FAULTS),
    _single(
        "duration_s", lambda replay: float(replay.audit.stamp_ns[-1] - replay.audit.stamp_ns[0]) * 1e-9, scale=TIME
    ),
)
OF_STATES: Declared = (
    folded(
        "min_clearance_true",
        LEAST,
        lambda r: np.asarray(() if r.true_clearance is None else r.true_clearance),
        scale=GAP,
        shown=Shown(column="clearance_true", pick="least"),
    ),
    counted(
        "num_below_margin", AUDIT("distance exact"), lambda replay, values: values < replay.margin, shown=NEAREST
    ),
    counted("num_in_collision", AUDIT("distance exact"), lambda _, values: values < 0, shown=NEAREST),
    folded(
        "min_self_clearance",
        LEAST,
        AUDIT("self_clearance"),
        lambda replay: int(np.isfinite(replay.audit.figures["self_clearance"]).sum()),
        scale=GAP,
        shown=Shown(column="self_clearance", pick="least"),
    ),
    folded(
        "min_limit_margin",
        LEAST,
        AUDIT("limit_margin"),
        num_states,
        scale=LIMIT,
        shown=Shown(column="limit_margin", pick="least"),
    ),
    folded("max_velocity_share", LARGEST, _column("strain", "velocity"), _intervals, scale=BAD_SHARE),
    folded("max_acceleration_share", LARGEST, _column("strain", "acceleration"), _num_sudden, scale=BAD_SHARE),
    folded("min_clearance_surface", LEAST, _column("between", "surface"), scale=GAP, shown=NEAREST),
    folded("min_clearance_between", LEAST, _column("between", "lower"), scale=GAP, shown=NEAREST),
    folded("min_clearance_splats", LEAST, _column("between", "represented"), scale=GAP, shown=NEAREST),
    folded("max_unseen_share", LARGEST, _column("near", "unseen"), scale=BAD_SHARE),
    folded("max_assumed_share", LARGEST, _column("near", "assumed"), scale=BAD_SHARE),
    folded("min_unseen_to_surface", LEAST, _column("near", "unseen_to_surface"), num_states, scale=GAP),
    folded("min_blind_to_surface", LEAST, _column("near", "blind_to_surface"), num_states, scale=GAP),
    *(
        figure
        for kind in EvidenceClass
        for figure in (
            folded(f"max_share_{kind.name.lower()}", LARGEST, _column("near", "shares", kind), scale=BAD_SHARE),
            folded(
                f"min_distance_{kind.name.lower()}", LEAST, _column("near", "nearest", kind), num_states, scale=GAP
            ),
        )
    ),
    folded("max_evidence_age_s", LARGEST, _column("near", "age"), scale=AGE),
    _single("unjudged_s", lambda r: float(r.between["unbounded"].sum()) + r.lead_in_s, _intervals, AGE),
    folded(
        "unknown_share",
        MEAN,
        AUDIT("unknown_share"),
        scale=BAD_SHARE,
        shown=Shown(column="unknown_share", pick="largest"),
    ),
    counted("num_without_distance", lambda r: is_blank(r).astype(np.float64), lambda _, values: values > 0),
    _single(
        "num_static_violations",
        lambda r: len(r.static_violations),
        lambda r: len(r.statics),
        Scale(better=Better.LOWER, absolute=2, relative=0.05),
    ),
    folded(
        "max_map_age_s",
        LARGEST,
        lambda replay: np.asarray(replay.map_age_s),
        scale=AGE,
        shown=Shown(column="map_age_s", pick="largest"),
    ),
    _map_error("map_error_bound", "bound", ERROR),
    _map_error("map_error_blocks", "num_stretches", DESCRIBES),
    _map_error("map_error_confidence", "confidence", GOOD_SHARE),
)


LARGEST_DIFFERENCE, LEAST_SLACK = (
    Shown(column="velocity_difference", pick="largest"),
    Shown(column="barrier_margin_logged", pick="least"),
)
STEPS, ASKED = partial(_column, "kept_steps.figures"), partial(_column, "open_loop.figures")


def _rung(rung: Rung) -> Metric[Replay]:
    name, shown = "num_" + rung.value.replace("-", "_"), Shown(column="rung", pick=rung.value)
    return counted(
        name,
        STEPS("rung"),
        lambda _, values: values == RUNGS.index(rung),
        scale=Scale(better=Better.HIGHER, relative=0.05) if rung is Rung.SOLVED else FAULTS,
        shown=shown,
    )


OF_STEPS: Declared = (
    folded("intervention_share", MEAN, STEPS("shaped")),
    *(folded(f"intervention_share_{kind}", MEAN, STEPS(f"shaped {kind}")) for kind in RowKind),
    _single("first_intervention_s", lambda r: getattr(first_intervention(r.events), "start_s", None), scale=TIME),
    folded(
        "min_barrier_clearance",
        LOWEST,
        STEPS("clearance"),
        scale=GAP,
        shown=Shown(column="barrier_clearance", pick="least"),
    ),
    *(_rung(rung) for rung in (Rung.SOLVED, Rung.RELAXED, Rung.MINIMUM_VIOLATION, Rung.HOLD)),
    folded("num_refused", TOTAL, STEPS("refused"), scale=FAULTS),
    counted(
        "num_scaled_back", STEPS("scale"), lambda _, values: values < 1, shown=Shown(column="scale", pick="least")
    ),
    folded(
        "max_residual",
        LARGEST,
        STEPS("residual"),
        scale=Scale(better=Better.LOWER, absolute=1e-6),
        shown=Shown(column="residual", pick="largest"),
    ),
)
OF_OPEN_LOOP: Declared = (
    folded("mean_velocity_difference", MEAN, ASKED("size"), scale=SPEED, shown=LARGEST_DIFFERENCE),
    folded("p95_velocity_difference", P95, ASKED("size"), scale=SPEED, shown=LARGEST_DIFFERENCE),
    folded("max_velocity_difference", LARGEST, ASKED("largest"), scale=SPEED, shown=LARGEST_DIFFERENCE),
    folded("min_barrier_margin_logged", LOWEST, ASKED("barrier"), scale=SLACK, shown=LEAST_SLACK),
    counted("num_barrier_broken_logged", ASKED("barrier"), lambda _, values: values < 0, shown=LEAST_SLACK),
    folded(
        "min_velocity_margin_logged",
        LOWEST,
        ASKED("limit"),
        scale=SLACK,
        shown=Shown(column="velocity_margin_logged", pick="least"),
    ),
)


def _trace(name: str, value: Callable[[ReplayTrace], float], scale: Scale = DESCRIBES) -> Metric[Replay]:
    return _single(name, lambda replay: value(replay.closed_loop) if replay.closed_loop else None, scale=scale)


OF_CLOSED_LOOP: Declared = (
    _trace("goal_reached", lambda trace: int(trace.outcome is Outcome.GOAL_REACHED), FULFILLED),
    _trace("stalled", lambda trace: int(trace.outcome is Outcome.STALLED), FAULTS),
    _trace("num_goals_reached", lambda trace: trace.num_reached, FULFILLED),
    _single("start_time_s", lambda replay: replay.start_time_s, scale=TIME),
    _trace("num_steps", lambda trace: len(trace.steps)),
    _trace("position_error", lambda trace: float(np.linalg.norm(trace.steps[-1].pose_error[:3])), AT_GOAL),
    _trace("rotation_error", lambda trace: float(np.linalg.norm(trace.steps[-1].pose_error[3:])), TURNED),
    _trace("num_scene_hits", lambda trace: sum(change.is_hit for change in trace.scene_changes), FAULTS),
    _trace("num_anchors", lambda trace: len(trace.anchored)),
    _trace("num_detours", lambda trace: len(trace.detours)),
    *(
        folded(
            f"{prefix}_divergence_{name}",
            fold,
            column,
            num_states,
            scale=Scale(unit=unit),
            shown=Shown(column=f"divergence_{name}", pick="largest"),
        )
        for prefix, fold in (("max", LARGEST), ("end", LAST))
        for name, unit, column in (
            ("joints", "rad", _column("divergence", "joints")),
            ("position", "m", _column("divergence", "position")),
            ("rotation_deg", "degrees", lambda replay: np.degrees(_column("divergence", "rotation")(replay))),
        )
    ),
)
OF_MODE: dict[str, Declared] = {
    "audit": (),
    "open-loop": (*OF_STEPS, *OF_OPEN_LOOP),
    "closed-loop": (*OF_STEPS, *OF_CLOSED_LOOP),
}
AGREEMENT = {
    **dict.fromkeys(("median", "p95", "largest", "largest_over"), ERROR),
    "share_within": GOOD_SHARE,
    "num_compared": DESCRIBES,
}  # scales of clearance_agreement's figures, except its tolerance


def _list_metrics(mode: str, of_fields: Sequence[str]) -> Declared:
    return (*OF_AUDIT, *map(_clearance, of_fields), *OF_STATES, *OF_MODE[mode])


def metric_scales(
    mode: str, of_fields: Sequence[str], *, has_truth: bool, has_twists: bool = False
) -> dict[str, Scale]:
    """Comparison scales of `metrics_of` and of the log's own figures, by name."""
    of_states = {metric.name: metric.scale for metric in _list_metrics(mode, of_fields)}
    scales = of_states | LOG_FIGURES | (TWIST_FIGURES if has_twists else {})
    if has_truth:
        scales |= {f"truth_{figure}_{name}": scale for name in of_fields for figure, scale in AGREEMENT.items()}
        scales["truth_tolerance"] = LENGTH
    return scales


def shown_metrics(mode: str, of_fields: Sequence[str]) -> dict[str, Shown]:
    return {metric.name: metric.shown for metric in _list_metrics(mode, of_fields) if metric.shown is not None}


def metrics_of(replay: Replay) -> Metrics:
    """Every printed, written and gated figure by name; None without a value."""
    metrics: Metrics = {
        metric.name: metric.value(replay) for metric in _list_metrics(replay.mode, tuple(replay.audit.clearance))
    }
    metrics |= replay.twist_figures
    for name, agreement in replay.agreement.items():
        metrics |= {f"truth_{figure}_{name}": agreement[figure] for figure in agreement if figure != "tolerance"}
        metrics["truth_tolerance"] = agreement["tolerance"]
    return metrics


def counts_of(replay: Replay, logged: LoggedStates, metrics: Metrics) -> dict[str, int]:
    """Number of states, intervals, spheres or points behind each metric, by default the judged states."""
    found = dict.fromkeys(metrics, num_states(replay))
    found |= {
        metric.name: metric.count(replay) for metric in _list_metrics(replay.mode, tuple(replay.audit.clearance))
    }
    for field, agreement in replay.agreement.items():
        compared = int(agreement["num_compared"] or 0)
        found |= {f"truth_{name}_{field}": compared for name in AGREEMENT if name != "num_compared"}
    return {name: (found | logged.counts())[name] for name in metrics}


def first_time(replay: Replay, metric: str, holds: Callable[[float], bool]) -> float | None:
    """First time [s] at which a metric over the states so far does not hold.

    None for metrics that are not of single states.
    """
    running = next(
        (of.running for of in _list_metrics(replay.mode, tuple(replay.audit.clearance)) if of.name == metric), None
    )
    start, values = (np.nan, ()) if running is None else running(replay)
    if running is None or not holds(start):
        return None
    stamps = replay.audit.stamp_ns
    times = (float(stamps[index] - stamps[0]) * 1e-9 for index, value in enumerate(values) if not holds(float(value)))
    return next(times, None)

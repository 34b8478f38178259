"""Named columns of audited states and of a controller's steps."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from splatctrl_cli.control.audit import AuditTrace
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.records import Float64, Index

NamedColumns = Mapping[str, Any]
"""Columns by name: arrays (T, ...) with NaN for no value, or T words or tuples of words, empty for none."""

RUNGS = tuple(Rung)


def names_at(names: Sequence[str], index: Index) -> list[str]:
    """Names (T,) by index (T,); empty for -1."""
    return [names[i] if i >= 0 else "" for i in index.tolist()]


def audit_columns(
    part: AuditTrace, spheres: Sequence[str], joints: Sequence[str], pairs: Sequence[str]
) -> NamedColumns:
    """Columns of audited states; q: position (T, J); is_blank: 1 where a field has no distance."""
    blank = np.any([np.isnan(nearest.distance) for nearest in part.clearance.values()], axis=0)
    columns: dict[str, Any] = {"stamp_ns": part.stamp_ns, "q": part.position, "is_blank": blank}
    for field, nearest in part.clearance.items():
        columns[f"clearance_{field}"] = nearest.distance
        columns[f"nearest_{field}"] = names_at(spheres, nearest.sphere)
    return columns | {
        "self_clearance": part.self_clearance,
        "self_pair": names_at(pairs, part.self_pair),
        "limit_margin": part.limit_margin,
        "limit_joint": names_at(joints, part.limit_joint),
        "unknown_share": part.unknown_share,
    }


def is_shaped(step: ControlStep | None, kind: RowKind | None = None) -> bool:
    """True if a row (of a kind) shapes the command.

    Without a kind, any fallback or scaling counts, too. False for external controllers.
    """
    if step is None or step.rung is Rung.OUTSIDE:
        return False
    if kind is not None:
        return any(row.kind is kind for row in step.interventions)
    return bool(step.interventions) or step.scale < 1 or step.rung is not Rung.SOLVED


def step_columns(steps: Sequence[ControlStep | None], num_joints: int) -> NamedColumns:
    """Columns of a controller's steps, None where it had none.

    v (T, J) [rad/s]: velocity. rung_number: in RUNGS. position_error [m], rotation_error [rad]. shaped: as
    `is_shaped`, NaN for an external controller. multiplier: largest of a kind. who_*: rows, the largest first.
    """

    def number(value: Callable[[ControlStep], float]) -> Float64:
        return np.array([np.nan if step is None else value(step) for step in steps], dtype=np.float64)

    def words(value: Callable[[ControlStep], Any]) -> list[Any]:
        return ["" if step is None else value(step) for step in steps]

    def shaped(step: ControlStep, kind: RowKind | None = None) -> float:
        return np.nan if step.rung is Rung.OUTSIDE else float(is_shaped(step, kind))

    blank = np.full(num_joints, np.nan)
    columns = {
        "v": np.array([blank if step is None else step.velocity for step in steps]),
        "barrier_clearance": number(lambda step: step.clearance),
        "barrier_nearest": words(lambda step: step.nearest),
        "rung": words(lambda step: str(step.rung)),
        "rung_number": number(lambda step: RUNGS.index(step.rung)),
        "scale": number(lambda step: step.scale),
        "slack": number(lambda step: max((row.slack for row in step.relaxed), default=0.0)),
        "relaxed_near": number(lambda step: any(row.is_near for row in step.relaxed)),
        "relaxed": words(lambda step: " ".join(row.name for row in step.relaxed)),
        "who_relaxed": words(
            lambda step: tuple(row.name for row in sorted(step.relaxed, key=lambda row: -row.slack))
        ),
        "intervening": words(lambda step: "; ".join(step.intervening)),
        "multipliers": words(lambda step: "; ".join(f"{row.multiplier:.4g}" for row in step.interventions)),
        "num_rows": words(lambda step: step.num_rows),
        "num_refused": number(lambda step: step.num_refused),
        "residual": number(lambda step: step.residual),
        "position_error": number(lambda step: float(np.linalg.norm(step.pose_error[:3]))),
        "rotation_error": number(lambda step: float(np.linalg.norm(step.pose_error[3:]))),
        "fixed_distance": number(lambda step: step.fixed_distance),
        "who_fixed": words(lambda step: step.violated_fixed),
        "shaped": number(shaped),
    }
    for kind in RowKind:
        own = [[] if step is None else [row for row in step.interventions if row.kind is kind] for step in steps]
        columns[f"shaped_{kind}"] = number(partial(shaped, kind=kind))
        columns[f"multiplier_{kind}"] = np.array([max((row.multiplier for row in rows), default=0.0) for rows in own])
        columns[f"who_{kind}"] = [
            tuple(row.name for row in sorted(rows, key=lambda row: -row.multiplier)) for rows in own
        ]
    return columns

"""The columns of a replay's steps.csv, one value per state."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.step import ControlStep

if TYPE_CHECKING:
    from splatctrl_cli.jobs.replay_modes import Replay

Columns = dict[str, list[object]]

CHUNK = 4096  # states
ALL = slice(None)


def chunks_of(replay: "Replay") -> Iterator[Columns]:
    """`columns_of` all states, CHUNK at a time, so that a long log is never a table in memory."""
    for first in range(0, len(replay.audit.stamp_ns), CHUNK):
        yield columns_of(replay, slice(first, first + CHUNK))


def columns_of(replay: "Replay", rows: slice = ALL) -> Columns:
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
    columns["obstacle"] = list(replay.obstacles[rows])
    columns["self_clearance"] = audit.self_clearance.tolist()
    columns["limit_margin"] = audit.limit_margin.tolist()
    columns["limit_joint"] = [replay.model.joint_names[j] for j in audit.limit_joint.tolist()]
    columns["unknown_share"] = audit.unknown_share.tolist()
    columns["map_age_s"] = replay.map_age_s[rows].tolist()
    if len(replay.steps):
        columns |= _step_columns(replay, rows)
    if replay.open_loop is not None:
        columns |= _open_loop_columns(replay, rows)
    if replay.divergence is not None:
        columns["divergence_joints"] = replay.divergence.joints[rows].tolist()
        columns["divergence_position"] = replay.divergence.position[rows].tolist()
        columns["divergence_rotation_deg"] = np.degrees(replay.divergence.rotation[rows]).tolist()
    return columns


def _step_columns(replay: "Replay", rows: slice) -> Columns:
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


def _open_loop_columns(replay: "Replay", rows: slice) -> Columns:
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

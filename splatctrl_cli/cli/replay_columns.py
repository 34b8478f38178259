"""The columns of a replay's steps.csv, one value per state."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from splatctrl_cli.cli.replay_report import seconds_of
from splatctrl_cli.control.arm import sphere_names
from splatctrl_cli.control.step import ControlStep

if TYPE_CHECKING:
    from splatctrl_cli.cli.replay_modes import Replay

Columns = dict[str, list[object]]


def columns_of(replay: "Replay") -> Columns:
    """Every column, by name."""
    audit, names = replay.audit, sphere_names(replay.model.sphere_set)
    columns: Columns = {
        "stamp_ns": audit.stamp_ns.tolist(),
        "time_s": seconds_of(replay).tolist(),
        **{f"q_{joint}": audit.position[:, j].tolist() for j, joint in enumerate(replay.model.joint_names)},
    }
    for name, clearance in audit.clearance.items():
        columns[f"clearance_{name}"] = clearance.distance.tolist()
        columns[f"nearest_{name}"] = [names[s] for s in clearance.sphere]
    if replay.true_clearance is not None:
        columns["clearance_true"] = replay.true_clearance.tolist()
    columns["obstacle"] = ["" if obstacle is None else str(obstacle) for obstacle in replay.obstacles]
    columns["self_clearance"] = audit.self_clearance.tolist()
    columns["limit_margin"] = audit.limit_margin.tolist()
    columns["limit_joint"] = [replay.model.joint_names[j] for j in audit.limit_joint]
    columns["unknown_share"] = audit.unknown_share.tolist()
    columns["map_age_s"] = replay.map_age_s.tolist()
    if replay.steps:
        columns |= _step_columns(replay)
    if replay.open_loop is not None:
        columns |= _open_loop_columns(replay)
    if replay.divergence is not None:
        columns["divergence_joints"] = replay.divergence.joints.tolist()
        columns["divergence_position"] = replay.divergence.position.tolist()
        columns["divergence_rotation_deg"] = np.degrees(replay.divergence.rotation).tolist()
    return columns


def _step_columns(replay: "Replay") -> Columns:
    def each(value: Callable[[ControlStep], object]) -> list[object]:
        return ["" if step is None else value(step) for step in replay.steps]

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


def _open_loop_columns(replay: "Replay") -> Columns:
    trace = replay.open_loop
    assert trace is not None
    difference, margins = trace.difference, trace.margins
    return {
        **{f"dv_{joint}": difference[:, j].tolist() for j, joint in enumerate(replay.model.joint_names)},
        "velocity_difference": np.linalg.norm(difference, axis=1).tolist(),
        "barrier_margin_logged": ["" if margin is None else margin.barrier for margin in margins],
        "barrier_row_logged": ["" if margin is None else margin.barrier_row for margin in margins],
        "velocity_margin_logged": ["" if margin is None else margin.limit for margin in margins],
        "velocity_row_logged": ["" if margin is None else margin.limit_row for margin in margins],
    }

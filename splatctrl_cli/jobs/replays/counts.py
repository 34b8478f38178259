"""How many states, intervals, spheres or points each figure of a replay rests on."""

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.motion_limits import WINDOW
from splatctrl_cli.jobs.replays.inputs import LoggedStates
from splatctrl_cli.jobs.replays.metrics import Metrics
from splatctrl_cli.jobs.replays.result import Replay
from splatctrl_cli.records import Float64

Counts = dict[str, int]

_OF_STEPS = {
    "shaped": (
        "intervention_share",
        "intervention_share_scene",
        "intervention_share_self",
        "intervention_share_limit",
    ),
    "clearance": ("min_barrier_clearance",),
    "rung": ("num_solved", "num_relaxed", "num_minimum_violation", "num_hold"),
    "refused": ("num_refused",),
    "scale": ("num_scaled_back",),
    "residual": ("max_residual",),
}
_OF_OPEN_LOOP = {
    "size": ("mean_velocity_difference", "p95_velocity_difference"),
    "largest": ("max_velocity_difference",),
    "barrier": ("min_barrier_margin_logged", "num_barrier_broken_logged"),
    "limit": ("min_velocity_margin_logged",),
}
"""Metrics by the column that they fold."""


def counts_of(replay: Replay, logged: LoggedStates, metrics: Metrics, config: ControlConfig) -> Counts:
    """Of every metric; where nothing else is known of it, the states that were judged."""
    found = dict.fromkeys(metrics, len(replay.audit.stamp_ns)) | _of_robot(replay) | _of_states(replay, config)
    if replay.kept_steps is not None:
        figures = replay.kept_steps.figures
        found |= {name: _known(figures[column]) for column, names in _OF_STEPS.items() for name in names}
    if replay.open_loop is not None:
        figures = replay.open_loop.figures
        found |= {name: _known(figures[column]) for column, names in _OF_OPEN_LOOP.items() for name in names}
    for motion, separation in replay.separations.items():
        there = _known(separation.distance)
        found |= {f"{motion}_{name}_human_distance": there for name in ("min", "mean")}
    for method in replay.comparison.methods:
        if method not in replay.comparison.figures:
            found |= {name: 0 for name in metrics if name.startswith(f"{method}_min_")}
    for field, agreement in replay.agreement.items():
        names = ("median", "p95", "largest", "largest_over", "share_within")
        found |= {f"truth_{name}_{field}": agreement.num_states for name in names}
    clock = logged.clock
    found |= dict.fromkeys(("clock_offset_s", "clock_uncertainty_s"), 0 if clock is None else clock.num_intervals)
    num_poses = 0 if logged.poses is None else logged.poses.num_poses
    found |= {name: num_poses for name in metrics if name.startswith("max_pose_")}
    return {name: found[name] for name in metrics}


def _of_robot(replay: Replay) -> Counts:
    model = replay.model
    covered = 0 if model.coverage is None else len(model.coverage.links)
    return {
        "num_bare_links": len(model.urdf.links),
        "coverage_deficit": covered,
        "min_self_clearance": len(replay.audit.stamp_ns) if len(model.self_pairs()) else 0,
        "num_static_violations": len(replay.statics),
    }


def _of_states(replay: Replay, config: ControlConfig) -> Counts:
    audit, truth, error = replay.audit, replay.true_clearance, replay.map_error
    stamps = audit.stamp_ns
    seen = _known(audit.clearance["exact"].distance)
    sudden = int(np.sum(stamps - stamps[0] >= 2 * WINDOW * 1e9))
    return {
        **{f"min_clearance_{name}": _known(of.distance) for name, of in audit.clearance.items()},
        **dict.fromkeys(("min_clearance", "num_below_margin", "num_in_collision"), seen),
        "min_clearance_true": 0 if truth is None else _known(np.asarray(truth)),
        "max_velocity_share": len(stamps) - 1,
        "max_acceleration_share": sudden if np.any(config.max_acceleration) else 0,
        "min_clearance_surface": _known(replay.between["surface"]),
        "min_clearance_between": _known(replay.between["lower"]),
        "min_clearance_splats": _known(replay.between["represented"]),
        "unjudged_s": len(stamps) - 1,
        "max_unseen_share": _known(replay.near["unseen"]),
        "max_blind_share": _known(replay.near["blind"]),
        "max_evidence_age_s": _known(replay.near["age"]),
        "unknown_share": _known(audit.unknown_share),
        "max_map_age_s": _known(np.asarray(replay.map_age_s)),
        **dict.fromkeys(
            ("map_error_bound", "map_error_blocks", "map_error_confidence"), 0 if error is None else error.num_seen
        ),
    }


def _known(values: Float64) -> int:
    return int(np.sum(~np.isnan(values)))

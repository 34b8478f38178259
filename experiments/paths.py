"""Paths of straight edges in joint space (IV): lengths, the proved clearance along a path, and its final approach.

W waypoints, J joints, K samples.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from splatctrl_cli import InputError
from splatctrl_cli.blocks import (
    Clearance,
    ControlConfig,
    Float64,
    PlannerConfig,
    RobotModel,
    check_edges,
    fixed,
    goal_postures,
    pose_error,
)

MAX_PIECES = 200_000  # of a path, when its clearance is proved
ROUNDING = 1e-9  # [m] taken off every clearance: far above the rounding of the distances
APPROACH_STEP = 0.04  # [m] between postures of a straight approach to a goal
APPROACH_TURN = 0.5  # [rad] of a joint between two of them, at most


@dataclass(frozen=True, kw_only=True)
class PathClearance:
    """The least clearance of a path lies in [lower, upper] [m]; upper is the clearance of one of its postures."""

    lower: float
    upper: float
    num_checks: int


def joint_length(waypoints: Float64) -> float:
    """Length [rad] of a path (W, J) in joint space."""
    return float(np.sum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1)))


def effector_length(model: RobotModel, postures: Float64, frame: str) -> tuple[float, float]:
    """Return the length [m] and the turn [degrees] of a frame's path over postures (K, J)."""
    poses = [model.frame_pose(q, frame) for q in postures]
    steps = [pose_error(a, b) for a, b in pairwise(poses)]
    moved, turned = (sum(float(np.linalg.norm(step[part])) for step in steps) for part in (slice(3), slice(3, 6)))
    return moved, float(np.degrees(turned))


def least_clearance(clearance: Clearance, waypoints: Float64, *, tolerance: float = 1e-3) -> PathClearance:
    """The least clearance of the whole path, not only at samples, to a tolerance [m].

    Over half an interval no row loses more than half of what it can lose over the whole: the bound of conservative
    advancement, here as branch and bound. Raises InputError if the tolerance needs too many pieces.
    """
    motion = np.diff(waypoints, axis=0)
    speeds = np.maximum(clearance.speeds(motion), fixed.STILL_ROW)
    edge, low, high = np.arange(len(motion)), np.zeros(len(motion)), np.ones(len(motion))
    upper, num_checks = float(np.min(clearance.at(waypoints))), len(waypoints)
    lower = upper
    while len(edge):
        if num_checks > MAX_PIECES:
            raise InputError(f"tolerance: expected one that {MAX_PIECES} pieces reach, got {tolerance:g} m")
        middle = (low + high) / 2
        rows = clearance.rows(waypoints[edge] + middle[:, None] * motion[edge]) - ROUNDING
        num_checks += len(edge)
        upper = min(upper, float(np.min(rows)))
        bound = np.min(rows - (high - low)[:, None] / 2 * speeds[edge], axis=1)
        is_open = bound < upper - tolerance
        lower = min(lower, float(np.min(bound[~is_open], initial=np.inf)))
        edge, low, middle, high = edge[is_open], low[is_open], middle[is_open], high[is_open]
        edge, low, high = np.concatenate([edge, edge]), np.concatenate([low, middle]), np.concatenate([middle, high])
    return PathClearance(lower=lower, upper=upper, num_checks=num_checks)


def approach_to(
    room: Clearance, goal: Float64, *, frame: str, length: float, planner: PlannerConfig, control: ControlConfig
) -> Float64:
    """Postures (W, J) straight along the z axis of a goal's (J,) frame.

    They start up to `length` [m] before it, as far as postures and edges are free.
    """
    model, way = room.model, [goal]
    T_world_goal = model.frame_pose(goal, frame)
    for back in np.arange(APPROACH_STEP, length + 1e-9, APPROACH_STEP):
        T = T_world_goal.copy()
        T[:3, 3] -= back * T[:3, 2]
        q = goal_postures(model, frame, T, way[0][None], control, at_most=1)
        if not len(q) or np.max(np.abs(q - way[0])) > APPROACH_TURN:
            break
        is_free = check_edges(room, q, way[0][None], contact=planner.contact).is_free[0]
        if not is_free or room.at(q)[0] < planner.contact:
            break
        way.insert(0, q[0])
    return np.array(way)

"""Postures that bring a frame to a pose: damped least squares from several guesses.

G postures, K guesses, J joints.
"""

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.target import pose_error
from splatctrl_cli.records import Float64

MAX_STEPS = 30  # of a guess: with 100, a fifth more guesses end at the pose, in 2.6 times the time
DAMPING = 1e-4  # of the squared Jacobian's diagonal, as it begins; grows where a step does not help
LONGEST = 0.3  # [rad] of a step, in any joint
SHARE = 0.1  # of the goal's tolerances that a posture keeps to
DISTINCT = 0.05  # [rad] that two postures differ by at least, in some joint


def goal_postures(
    model: ArmModel, frame: str, T_world_goal: Float64, guesses: Float64, config: ControlConfig, *, at_most: int
) -> Float64:
    """(G, J) postures within the limits that bring `frame` to a pose (4, 4), distinct, in the order of the guesses.

    They keep to a tenth of the goal's tolerances; G is at most `at_most`, and 0 where no guess (K, J) leads there.
    """
    found: list[Float64] = []
    for guess in guesses:
        q = _solved(model, frame, T_world_goal, guess, config)
        if q is not None and all(np.max(np.abs(q - other)) > DISTINCT for other in found):
            found.append(q)
        if len(found) == at_most:
            break
    return np.array(found).reshape(-1, len(model.lower))


def _solved(
    model: ArmModel, frame: str, T_world_goal: Float64, guess: Float64, config: ControlConfig
) -> Float64 | None:
    """Levenberg's method, every step cut off at the limits; None where it comes to no end."""
    scale = 1.0 / np.repeat([SHARE * config.goal_position, SHARE * config.goal_rotation], 3)
    q, damping = np.clip(guess, model.lower, model.upper), DAMPING
    error = scale * pose_error(model.frame_pose(q, frame), T_world_goal)
    for _ in range(MAX_STEPS):
        if max(np.linalg.norm(error[:3]), np.linalg.norm(error[3:])) <= 1.0:
            return q
        J = scale[:, None] * model.frame_jacobian(q, frame)
        square = J.T @ J
        step = np.linalg.solve(square + damping * np.trace(square) * np.eye(len(q)), J.T @ error)
        step *= min(1.0, LONGEST / max(float(np.max(np.abs(step))), 1e-12))
        following = np.clip(q + step, model.lower, model.upper)
        next_error = scale * pose_error(model.frame_pose(following, frame), T_world_goal)
        if np.linalg.norm(next_error) < np.linalg.norm(error):
            q, error, damping = following, next_error, max(damping / 10, 1e-9)
        else:
            damping *= 10
        if damping > 1e3:
            return None
    return None

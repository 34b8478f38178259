"""Tasks of the QP: each returns (H, c) of a cost ``1/2 v' H v + c' v`` over joint velocities v (J,)."""

import numpy as np

from splatctrl_cli.records import Float64

Cost = tuple[Float64, Float64]


def eliminated_weight(weight_task: Float64, weight_kinematics: Float64) -> Float64:
    """The weight (6,) that is left when the end-effector velocity and its slack are eliminated from III-E.

    ``min over d of (e - d)' Q (e - d) + d' R d`` is ``e' W e`` with ``W = (Q^-1 + R^-1)^-1``; Q, R diagonal (6,).
    """
    return np.asarray(1.0 / (1.0 / weight_task + 1.0 / weight_kinematics))


def velocity_task(jacobian: Float64, velocity: Float64, weight: Float64) -> Cost:
    """The cost ``(u - J v)' W (u - J v)`` of missing the end-effector velocity u (III-E, first term).

    jacobian (6, J); velocity u (6,) [m/s, rad/s], world; weight (6,), the diagonal of W.
    """
    weighted = jacobian.T * weight
    return 2.0 * weighted @ jacobian, -2.0 * weighted @ velocity


def posture_task(velocity: Float64, weight: float) -> Cost:
    """The cost ``weight |v - velocity|^2`` of straying from a joint velocity (J,) [rad/s].

    Towards home it is the home bias of III-E, which also makes the QP of a redundant arm strictly convex; from the
    last velocity it is the smoothness.
    """
    return 2.0 * weight * np.eye(len(velocity)), -2.0 * weight * velocity

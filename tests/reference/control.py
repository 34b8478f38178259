"""III-E as printed, in float64: the QP with the end-effector velocity and its slack still in it."""

import numpy as np

from splatctrl_cli.control.qp import QuadraticProgram
from splatctrl_cli.records import Float64


def literal_program(
    jacobian: Float64,
    velocity: Float64,
    Q: Float64,
    R: Float64,
    posture: tuple[Float64, float],
    rows: tuple[Float64, Float64],
    slack: tuple[float, float],
) -> QuadraticProgram:
    """Variables (v, xdot, delta_x, s): minimise the printed cost under ``xdot = J v + delta_x`` and the given rows.

    posture = (velocity, weight); rows = (G, h) over v, every row with its own slack s >= 0 of cost (L1, L2).
    The box of joint velocities is +-2. The equality is written as two inequalities.
    """
    num_joints, num_rows = jacobian.shape[1], len(rows[1])
    V = num_joints + 12 + num_rows
    H, c = np.zeros((V, V)), np.zeros(V)
    v, x, d = slice(0, num_joints), slice(num_joints, num_joints + 6), slice(num_joints + 6, num_joints + 12)
    s = slice(num_joints + 12, V)
    H[x, x], c[x] = 2 * np.diag(Q), -2 * Q * velocity
    H[d, d] = 2 * np.diag(R)
    H[v, v], c[v] = 2 * posture[1] * np.eye(num_joints), -2 * posture[1] * posture[0]
    H[s, s], c[s] = 2 * slack[1] * np.eye(num_rows), slack[0]
    E = np.zeros((6, V))
    E[:, x], E[:, v], E[:, d] = np.eye(6), -jacobian, -np.eye(6)
    G = np.zeros((num_rows, V))
    G[:, v], G[:, s] = rows[0], -np.eye(num_rows)
    positive, box = np.zeros((num_rows, V)), np.zeros((num_joints, V))
    positive[:, s], box[:, v] = -np.eye(num_rows), np.eye(num_joints)
    return QuadraticProgram(
        H=H,
        c=c,
        G=np.vstack([E, -E, G, positive, box, -box]),
        h=np.concatenate([np.zeros(12), rows[1], np.zeros(num_rows), np.full(2 * num_joints, 2.0)]),
    )


def braking_room(speed: float, gain: float, acceleration: float, period: float) -> float:
    """The room [m] that a speed [m/s] needs: v / alpha up to a / alpha; beyond that also the way of braking to it at
    a, and one period of what is above it.
    """
    knee = acceleration / gain
    if speed <= knee:
        return speed / gain
    return knee / gain + (speed**2 - knee**2) / (2 * acceleration) + (speed - knee) * period


def fr3_velocity_range(q: Float64) -> tuple[Float64, Float64]:
    """The published velocity limits of the Franka Research 3's seven joints at q, one line per joint as published."""

    def up(most: float, offset: float, slope: float, room: float) -> float:
        return min(most, max(0.0, -offset + float(np.sqrt(max(0.0, slope * room)))))

    highest = [
        up(2.62, 0.30, 12.0, 2.75010 - q[0]),
        up(2.62, 0.20, 5.17, 1.79180 - q[1]),
        up(2.62, 0.20, 7.00, 2.90650 - q[2]),
        up(2.62, 0.30, 8.00, -0.1458 - q[3]),
        up(5.26, 0.35, 34.0, 2.81010 - q[4]),
        up(4.18, 0.35, 11.0, 4.52050 - q[5]),
        up(5.26, 0.35, 34.0, 3.01960 - q[6]),
    ]
    lowest = [
        -up(2.62, 0.30, 12.0, 2.750100 + q[0]),
        -up(2.62, 0.20, 5.17, 1.791800 + q[1]),
        -up(2.62, 0.20, 7.00, 2.906500 + q[2]),
        -up(2.62, 0.30, 8.00, 3.048100 + q[3]),
        -up(5.26, 0.35, 34.0, 2.810100 + q[4]),
        -up(4.18, 0.35, 11.0, -0.54092 + q[5]),
        -up(5.26, 0.35, 34.0, 3.019600 + q[6]),
    ]
    return np.array(lowest), np.array(highest)

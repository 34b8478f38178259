"""A controller for `splatctrl replay --controller reach:Reach`: proportional, and within the clearance rows."""

import numpy as np

from splatctrl_cli import ControllerInput, ControllerStart

GAIN = 2.0  # [1/s]
FASTEST = 0.25  # [m/s, rad/s] of the frame
DAMPING = 0.05
ROUNDS = 200


class Reach:
    def __init__(self, start: ControllerStart) -> None:
        self.limit = start.velocity_limit

    def step(self, now: ControllerInput) -> np.ndarray:
        J, twist = now.jacobian, GAIN * now.error
        twist = twist * min(1.0, FASTEST / max(np.linalg.norm(twist), 1e-9))
        if now.goal_twist is not None:  # the goal moves
            twist = twist + now.goal_twist
        velocity = J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), twist)
        rows = [row for row in now.rows() if row.G.any()]
        G, h = np.array([row.G for row in rows]), np.array([row.h for row in rows])
        length = np.linalg.norm(G, axis=1)
        for _ in range(ROUNDS):  # onto the row that is broken most, until none is
            excess = (G @ velocity - h) / length
            worst = np.argmax(excess)
            if excess[worst] <= 0:
                break
            velocity = velocity - excess[worst] * G[worst] / length[worst]
        return np.clip(velocity, -self.limit, self.limit)

"""Velocity limits of recorded motions, at any duration."""

import numpy as np

from splatctrl_cli.simulate.recording import JOINT_RATE, Recording

DURATIONS = (0.5, 1.0, 1.5, 2.0, 7.0)  # [s]


def assert_keeps_limits(recording: Recording) -> None:
    """Recorded velocities, and steps between recorded positions, are within the limits, and the arm moves."""
    states = list(recording.joint_states())
    velocity = np.array([state.velocity for state in states])
    steps = JOINT_RATE * np.diff([state.position for state in states], axis=0)
    limit = recording.robot.velocity_limit * (1 + 1e-9)
    assert np.all(np.abs(velocity) <= limit) and np.all(np.abs(steps) <= limit)
    assert np.abs(steps).max() > 0.05

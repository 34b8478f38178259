"""Joint position and velocity limits, merged into one box of joint velocities that is never empty."""

import numpy as np

from splatctrl_cli.records import Float64

Rows = tuple[Float64, Float64]


def velocity_box(
    q: Float64, lower: Float64, upper: Float64, velocity_limit: Float64, gain: float
) -> tuple[Float64, Float64]:
    """Lowest and highest joint velocity (J,), (J,) [rad/s] allowed at q.

    III-E: ``v <= alpha (q_max - q)``, ``v >= -alpha (q - q_min)``, ``|v| <= v_max``, alpha the gain [1/s]. Both
    position rows are clipped into the velocity range, so the box is not empty where q lies outside its limits:
    there it asks for the way back, at the velocity limit when far.
    """
    highest = np.clip(gain * (upper - q), -velocity_limit, velocity_limit)
    lowest = np.clip(-gain * (q - lower), -velocity_limit, velocity_limit)
    return lowest, highest


def box_rows(lowest: Float64, highest: Float64) -> Rows:
    """The box as rows ``G v <= h``: J upper rows, then J lower rows."""
    identity = np.eye(len(lowest))
    return np.vstack([identity, -identity]), np.concatenate([highest, -lowest])

"""Approach speeds from which an arm that cannot stop at once still stops in time."""

import numpy as np

from splatctrl_cli.records import Float64


def braking_speed(room: Float64, gain: float, deceleration: Float64, period: float) -> Float64:
    """The highest speed (M,) at which a room (M,) may be used up, so that a later step need never brake harder.

    Up to ``v = a / alpha`` the linear bound ``alpha r`` itself asks for no more than the deceleration a (M,), inf
    where there is no limit. Faster, the room must hold the way to that speed at a, and one period more:

        r(v) = a / alpha^2 + (v^2 - a^2 / alpha^2) / (2 a) + (v - a / alpha) dt,

    which is continuous at a / alpha. Along it ``r(v - a dt) <= r(v) - v dt``: after a step at v the room that is left
    allows v - a dt. Never above ``alpha r``, so what that bound guarantees holds; the same where r < 0.
    """
    linear = gain * room
    knee = deceleration / gain
    is_fast = linear > knee
    if not np.any(is_fast):
        return np.asarray(linear)
    r, a = room[is_fast], deceleration[is_fast]
    speed = np.asarray(linear, dtype=np.float64).copy()
    reach = 2.0 * r - a / gain**2 + 2.0 * a * period / gain + a * period**2
    speed[is_fast] = np.sqrt(a * reach) - a * period
    return speed


def brought_to_rest(last_velocity: Float64, change: Float64) -> Float64:
    """The velocity (J,) nearest to zero that is no farther than `change` (J,) from the last one."""
    return np.asarray(np.clip(0.0, last_velocity - change, last_velocity + change))

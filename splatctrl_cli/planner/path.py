"""A path of straight edges in joint space, and its timing.

W waypoints, J joints, K samples.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import FRAME_SPACING
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Float64


def resampled(waypoints: Float64, spacing: float) -> Float64:
    """Postures (K, J) on the path, at most `spacing` [rad] apart, every waypoint among them."""
    rows = [waypoints[:1]]
    for a, b in pairwise(waypoints):
        num = max(int(np.ceil(np.linalg.norm(b - a) / spacing)), 1)
        rows.append(a + np.arange(1, num + 1)[:, None] / num * (b - a))
    return np.concatenate(rows)


@dataclass(frozen=True, kw_only=True)
class TimedPath:
    """A path (W, J) with a clock: trapezoids of speed, at rest at every waypoint, so the straight edges are kept.

    start_time (W,) [s] at each waypoint; top_speed, acceleration (W - 1,) of the share of each edge, per s and s^2.
    """

    waypoints: Float64
    start_time: Float64
    top_speed: Float64
    acceleration: Float64

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return float(self.start_time[-1])

    def at(self, time: NDArray[np.floating] | float) -> tuple[Float64, Float64]:
        """Position and velocity (K, J) at times (K,) [s]; at rest before the start and after the end."""
        clock = np.clip(np.atleast_1d(np.asarray(time, dtype=np.float64)), 0.0, self.duration)
        edge = np.clip(np.searchsorted(self.start_time, clock, side="right") - 1, 0, len(self.top_speed) - 1)
        speed, gain = self.top_speed[edge], self.acceleration[edge]
        since, left = clock - self.start_time[edge], self.start_time[edge + 1] - clock
        ramp = speed / gain
        is_late = left < ramp
        share = np.where(since < ramp, gain * since**2 / 2, speed * (since - ramp / 2))
        share = np.where(is_late & (left <= since), 1.0 - gain * left**2 / 2, share)
        rate = np.minimum(speed, gain * np.minimum(since, left))
        motion = self.waypoints[edge + 1] - self.waypoints[edge]
        return self.waypoints[edge] + share[:, None] * motion, rate[:, None] * motion


def effector_rates(
    model: ArmModel, waypoints: Float64, frame: str, *, max_linear: float, max_angular: float
) -> Float64:
    """(W - 1,) shares of each edge per second at which a frame keeps to speeds [m/s] and [rad/s], at samples
    `FRAME_SPACING` apart; infinite where an edge does not move it.
    """
    rates = np.full(len(waypoints) - 1, np.inf)
    for edge, ends in enumerate(pairwise(waypoints)):
        for q in resampled(np.array(ends), FRAME_SPACING):
            twist = model.frame_jacobian(q, frame) @ (ends[1] - ends[0])
            for part, limit in ((twist[:3], max_linear), (twist[3:], max_angular)):
                speed = float(np.linalg.norm(part))
                rates[edge] = min(rates[edge], limit / speed if speed > 0 else np.inf)
    return rates


def timed(
    waypoints: Float64, velocity_limit: Float64, max_acceleration: float, *, max_rate: Float64 | None = None
) -> TimedPath:
    """The fastest trapezoids within velocity_limit (J,) [rad/s] and max_acceleration [rad/s^2], and where it is given
    within max_rate (W - 1,), the share of each edge per second.

    Raises InputError for fewer than two waypoints or limits that are not above zero.
    """
    if len(waypoints) < 2:
        raise InputError(f"path: expected at least 2 waypoints, got {len(waypoints)}")
    if not (np.min(velocity_limit) > 0 and max_acceleration > 0):
        raise InputError("path: expected velocity and acceleration limits above 0")
    motion = np.abs(np.diff(waypoints, axis=0))
    is_long = np.max(motion, axis=1) > 0
    motion, is_new = motion[is_long], np.r_[True, is_long]
    speed = np.min(velocity_limit / np.maximum(motion, 1e-12), axis=1)
    if max_rate is not None:
        speed = np.minimum(speed, max_rate[is_long])
    acceleration = max_acceleration / np.max(motion, axis=1)
    speed = np.minimum(speed, np.sqrt(acceleration))  # a short edge is a triangle
    seconds = 1.0 / speed + speed / acceleration
    return TimedPath(
        waypoints=waypoints[is_new],
        start_time=np.r_[0.0, np.cumsum(seconds)],
        top_speed=speed,
        acceleration=acceleration,
    )

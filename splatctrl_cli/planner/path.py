"""A path of straight edges in joint space: its lengths, the clearance proved along it, and its timing.

W waypoints, J joints, K samples; a place on the path is the number of waypoints passed, with a fraction.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import FRAME_SPACING, STILL_ROW
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.goals import rotation_vector
from splatctrl_cli.errors import InputError
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.edges import ROUNDING
from splatctrl_cli.records import Float64

MAX_PIECES = 200_000  # of a path, when its clearance is proved


@dataclass(frozen=True, kw_only=True)
class PathClearance:
    """The least clearance of a whole path lies in [lower, upper] [m]; upper is that of a posture of the path."""

    lower: float
    upper: float
    num_checks: int


def joint_length(waypoints: Float64) -> float:
    """Length [rad] of a path (W, J) in joint space."""
    return float(np.sum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1)))


def effector_length(model: ArmModel, postures: Float64, frame: str) -> tuple[float, float]:
    """How far a frame goes [m] and turns [degrees] over postures (K, J), from each to the next."""
    poses = [model.frame_pose(q, frame) for q in postures]
    moved = sum(float(np.linalg.norm(b[:3, 3] - a[:3, 3])) for a, b in pairwise(poses))
    turned = sum(float(np.linalg.norm(rotation_vector(b[:3, :3] @ a[:3, :3].T))) for a, b in pairwise(poses))
    return moved, float(np.degrees(turned))


def resampled(waypoints: Float64, spacing: float) -> Float64:
    """Postures (K, J) on the path, at most `spacing` [rad] apart, every waypoint among them."""
    rows = [waypoints[:1]]
    for a, b in pairwise(waypoints):
        num = max(int(np.ceil(np.linalg.norm(b - a) / spacing)), 1)
        rows.append(a + np.arange(1, num + 1)[:, None] / num * (b - a))
    return np.concatenate(rows)


def least_clearance(clearance: Clearance, waypoints: Float64, *, tolerance: float = 1e-3) -> PathClearance:
    """The least clearance of the path, everywhere on it and not only at samples, to a tolerance [m].

    Over half an interval no row loses more than half of what it can lose over the whole: the bound of conservative
    advancement, here as branch and bound. Raises InputError where the tolerance asks for too many pieces.
    """
    motion = np.diff(waypoints, axis=0)
    speeds = np.maximum(clearance.speeds(motion), STILL_ROW)
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

"""Joint position, velocity and acceleration limits, merged into one box of joint velocities that is never empty; and
whether a motion keeps them, from its positions, a block at a time.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.config.fixed import ENCODER, MOTION_WINDOW
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64, Index, Stamps

Rows = tuple[Float64, Float64]
FR3 = "fr3"
# Highest: min(v_max, max(0, sqrt(max(0, k (q_upper - q))) - v_0)); lowest: the same of q - q_lower, negative. The
# numbers are those of Franka's control parameters and of libfranka (include/franka/rate_limiting.h,
# computeUpperLimitsJointVelocity and computeLowerLimitsJointVelocity), without its tolerance of 1e-3 rad/s.
FR3_JOINTS = (  # v_max [rad/s], v_0 [rad/s], k [rad/s^2], q_lower [rad], q_upper [rad]
    (2.62, 0.30, 12.0, -2.7501, 2.7501),
    (2.62, 0.20, 5.17, -1.7918, 1.7918),
    (2.62, 0.20, 7.00, -2.9065, 2.9065),
    (2.62, 0.30, 8.00, -3.0481, -0.1458),
    (5.26, 0.35, 34.0, -2.8101, 2.8101),
    (4.18, 0.35, 11.0, 0.54092, 4.5205),
    (5.26, 0.35, 34.0, -3.0196, 3.0196),
)


@dataclass(frozen=True, kw_only=True)
class VelocityLimits:
    """The velocity limits of J joints by position: most (J,) [rad/s] everywhere; near a position limit
    ``sqrt(slope (limit - q)) - offset`` with slope (J,) [rad/s^2], offset (J,) [rad/s]; lower, upper (J,) [rad].
    """

    most: Float64
    offset: Float64
    slope: Float64
    lower: Float64
    upper: Float64

    def at(self, q: Float64) -> tuple[Float64, Float64]:
        """Lowest and highest velocity (J,), (J,) [rad/s] at q (J,): zero lies between them."""
        return -self._towards(q - self.lower), self._towards(self.upper - q)

    def _towards(self, room: Float64) -> Float64:
        speed = np.sqrt(np.maximum(self.slope * room, 0.0)) - self.offset
        return np.minimum(self.most, np.maximum(speed, 0.0))


def fr3_limits(joint_names: Sequence[str]) -> VelocityLimits:
    """The limits of the FR3's joints, which are known by the ends of their names.

    Raises UsageError for a joint of another name, or one named twice.
    """
    found = [re.search(r"(?:^|_)joint([1-7])$", name) for name in joint_names]
    numbers = [0 if match is None else int(match.group(1)) for match in found]
    odd = [name for name, n in zip(joint_names, numbers, strict=True) if n == 0 or numbers.count(n) > 1]
    if odd:
        raise UsageError(
            f"control.velocity_limits = fr3: expected names that end in joint1 to joint7, got {', '.join(odd)}",
            remedy="lock the others (--lock), or set control.velocity_limits = urdf",
        )
    table = np.array([FR3_JOINTS[number - 1] for number in numbers]).T
    return VelocityLimits(most=table[0], offset=table[1], slope=table[2], lower=table[3], upper=table[4])


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


@dataclass(frozen=True, kw_only=True)
class JointLimits:
    """The limits of J joints: lower, upper [rad], velocity [rad/s], acceleration [rad/s^2] (None: no limit).

    gain [1/s] is that of the position limits, period [s] how long a velocity is held; by_position: velocity limits
    that hold beside `velocity` and depend on the position.
    """

    lower: Float64
    upper: Float64
    velocity: Float64
    gain: float
    period: float
    acceleration: Float64 | None = None
    by_position: VelocityLimits | None = None

    @classmethod
    def of(cls, model: ArmModel, config: ControlConfig) -> "JointLimits":
        """The limits of an arm as the configuration has them. Raises UsageError for an acceleration below 0, or one
        per joint for another number of joints.
        """
        return cls(
            lower=model.lower,
            upper=model.upper,
            velocity=model.velocity_limit,
            gain=config.barrier_gain,
            period=config.period,
            acceleration=_acceleration(config.max_acceleration, model.joint_names),
            by_position=fr3_limits(model.joint_names) if config.velocity_limits == FR3 else None,
        )

    def box(self, q: Float64, last_velocity: Float64 | None = None) -> tuple[Float64, Float64]:
        """Lowest and highest joint velocity (J,), (J,) [rad/s] allowed at q after a last velocity (None: not known,
        so that no acceleration counts).

        The acceleration gives way where it cannot be kept together with velocity and position, to the velocity within
        those two that is nearest to it: so the box is not empty. From a state that this box led to it never has to,
        unless the limits by position ask for more.
        """
        lowest, highest = velocity_box(
            q, self.lower, self.upper, self.velocity, self.gain, acceleration=self.acceleration, period=self.period
        )
        if self.by_position is not None:
            slowest, fastest = self.by_position.at(q)
            lowest, highest = np.clip(lowest, slowest, fastest), np.clip(highest, slowest, fastest)
        if self.acceleration is None or last_velocity is None:
            return lowest, highest
        change = self.acceleration * self.period
        return (np.clip(last_velocity - change, lowest, highest), np.clip(last_velocity + change, lowest, highest))

    def rest(self, last_velocity: Float64 | None) -> Float64:
        """What holding still is (J,) [rad/s]: zero, or the nearest to it that the acceleration allows."""
        if self.acceleration is None or last_velocity is None:
            return np.zeros(len(self.lower))
        return brought_to_rest(last_velocity, self.acceleration * self.period)


def velocity_box(
    q: Float64,
    lower: Float64,
    upper: Float64,
    velocity_limit: Float64,
    gain: float,
    *,
    acceleration: Float64 | None = None,
    period: float = 0.0,
) -> tuple[Float64, Float64]:
    """Lowest and highest joint velocity (J,), (J,) [rad/s] allowed at q.

    III-E: ``v <= alpha (q_max - q)``, ``v >= -alpha (q - q_min)``, ``|v| <= v_max``, alpha the gain [1/s]; where an
    acceleration (J,) [rad/s^2] is given, `braking_speed` of the same room. Both position rows are clipped into the
    velocity range, so the box is not empty where q lies outside its limits: there it asks for the way back, at the
    velocity limit when far.
    """
    above, below = upper - q, q - lower
    if acceleration is None:
        fastest_up, fastest_down = gain * above, gain * below
    else:
        fastest_up = braking_speed(above, gain, acceleration, period)
        fastest_down = braking_speed(below, gain, acceleration, period)
    highest = np.clip(fastest_up, -velocity_limit, velocity_limit)
    lowest = np.clip(-fastest_down, -velocity_limit, velocity_limit)
    return lowest, highest


def box_rows(lowest: Float64, highest: Float64) -> Rows:
    """The box as rows ``G v <= h``: J upper rows, then J lower rows."""
    identity = np.eye(len(lowest))
    return np.vstack([identity, -identity]), np.concatenate([highest, -lowest])


def _acceleration(value: float | tuple[float, ...], joints: Sequence[str]) -> Float64 | None:
    """One acceleration per joint (J,) [rad/s^2], None where there is no limit."""
    each = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if len(each) not in (1, len(joints)):
        raise UsageError(
            f"control.max_acceleration: expected one number or {len(joints)}, one for each joint, got {len(each)}",
            remedy=f"in the order {', '.join(joints)}",
        )
    if np.all(each == 0):
        return None
    return np.broadcast_to(each, (len(joints),)).copy()


@dataclass(frozen=True, kw_only=True)
class Strain:
    """Of T states: the largest velocity (T,) as a share of its joint's limit, at joint (T,); likewise acceleration,
    0 throughout where there is no limit.
    """

    velocity: Float64
    velocity_joint: Index
    acceleration: Float64
    acceleration_joint: Index


class MotionLimits:
    """Velocities from the last state, and from `MOTION_WINDOW` earlier, each less what the encoder may be off;
    accelerations from three places `MOTION_WINDOW` apart. A sample is of the time before it.
    """

    def __init__(self, velocity_limit: Float64, acceleration_limit: Float64 | None) -> None:
        """velocity_limit (J,) [1/s], acceleration_limit (J,) [1/s^2] or None."""
        self._velocity, self._acceleration = velocity_limit, acceleration_limit
        self._stamps: Stamps = np.zeros(0, np.int64)
        self._positions: Float64 = np.zeros((0, len(velocity_limit)))

    def add(self, stamps: Stamps, positions: Float64) -> Strain:
        """The next states: stamps (T,) [ns], positions (T, J)."""
        num = len(stamps)
        all_stamps = np.concatenate([self._stamps, stamps])
        everything = np.concatenate([self._positions, positions])
        first = len(all_stamps) - num
        share = np.zeros((num, positions.shape[1]))
        window = np.int64(MOTION_WINDOW * 1e9)
        last = np.arange(first, first + num) - 1
        for before in (last, np.minimum(last, np.searchsorted(all_stamps, stamps - window, "right") - 1)):
            has = np.flatnonzero(before >= 0)
            seconds = (stamps[has] - all_stamps[before[has]]) * 1e-9
            moved = np.maximum(np.abs(positions[has] - everything[before[has]]) - 2 * ENCODER, 0.0)
            speed = moved / np.maximum(seconds, 1e-9)[:, None]
            share[has] = np.maximum(share[has], speed / self._velocity)
        sudden = np.zeros_like(share)
        if self._acceleration is not None:
            sudden = self._accelerations(stamps, all_stamps, everything) / self._acceleration
        oldest = max(int(np.searchsorted(all_stamps, stamps[-1] - 2 * window, "right")) - 1, 0)
        self._stamps, self._positions = all_stamps[oldest:], everything[oldest:]
        rows = np.arange(num)
        fastest, hardest = share.argmax(axis=1), sudden.argmax(axis=1)
        return Strain(
            velocity=share[rows, fastest],
            velocity_joint=fastest.astype(np.int64),
            acceleration=sudden[rows, hardest],
            acceleration_joint=hardest.astype(np.int64),
        )

    def _accelerations(self, stamps: Stamps, all_stamps: Stamps, everything: Float64) -> Float64:
        """(T, J) [1/s^2], less what the encoder may be off; 0 where the motion is not old enough."""
        seconds = (all_stamps - all_stamps[0]) * 1e-9
        now = (stamps - all_stamps[0]) * 1e-9
        found = np.zeros((len(stamps), everything.shape[1]))
        old = now >= 2 * MOTION_WINDOW
        for joint in range(everything.shape[1]):
            at = [np.interp(now[old] - k * MOTION_WINDOW, seconds, everything[:, joint]) for k in range(3)]
            second = np.abs(at[0] - 2 * at[1] + at[2]) - 4 * ENCODER
            found[old, joint] = np.maximum(second, 0.0) / MOTION_WINDOW**2
        return found

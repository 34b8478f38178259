"""Joint position, velocity and acceleration limits, merged into one box of joint velocities that is never empty."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.braking import braking_speed, brought_to_rest
from splatctrl_cli.control.velocity_limits import FR3, VelocityLimits, fr3_limits
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64

Rows = tuple[Float64, Float64]


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
        return (
            np.clip(last_velocity - change, lowest, highest),
            np.clip(last_velocity + change, lowest, highest),
        )

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

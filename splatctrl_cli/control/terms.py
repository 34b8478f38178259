"""Terms of the QP of III-E over joint velocities, and the box of joint limits.

A further term is a function from state to cost ``(H, c)``, or a `BarrierTerm` with rows ``G v - s <= h``.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property, partial

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.goals import Guide
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.records import Bool, Columns, Float64, Index, Integers, Stamps
from splatctrl_cli.robot.model import RobotModel

Rows = tuple[Float64, Float64]
FR3 = "fr3"
# Highest: min(v_max, max(0, sqrt(max(0, k (q_upper - q))) - v_0)); lowest: the same of q - q_lower, negative. The
# numbers come from Franka's control parameters and libfranka (include/franka/rate_limiting.h,
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


VelocityLimits = Callable[[Float64], tuple[Float64, Float64]]
"""q (J,) [rad] -> lowest and highest velocity (J,), (J,) [rad/s] there; zero lies between them."""


def fr3_limits(joint_names: Sequence[str]) -> VelocityLimits:
    """Velocity limits of the FR3's joints by position, matched by the ends of their names.

    Raises UsageError for other names or duplicates.
    """
    matches = [re.search(r"(?:^|_)joint([1-7])$", name) for name in joint_names]
    numbers = [0 if match is None else int(match.group(1)) for match in matches]
    odd = [name for name, n in zip(joint_names, numbers, strict=True) if n == 0 or numbers.count(n) > 1]
    refuse_if(
        odd,
        f"control.velocity_limits = fr3: expected names that end in joint1 to joint7, got {', '.join(odd)}",
        remedy="lock the others (--lock), or set control.velocity_limits = urdf",
        error=UsageError,
    )
    most, offset, slope, lower, upper = np.array([FR3_JOINTS[number - 1] for number in numbers]).T

    def limit(q: Float64) -> tuple[Float64, Float64]:
        speeds = (np.sqrt(np.maximum(slope * room, 0.0)) - offset for room in (q - lower, upper - q))
        down, up = (np.minimum(most, np.maximum(speed, 0.0)) for speed in speeds)
        return -down, up

    return limit


def braking_speed(room: Float64, gain: float, deceleration: Float64, period: float) -> Float64:
    """Highest speed (M,) into room (M,) that never requires harder braking than a (M,) later.

    Up to ``v = a / alpha`` the linear bound ``alpha r`` needs at most the deceleration a, inf without a limit. A
    higher speed needs room to brake to ``a / alpha``, and for one period more:

        r(v) = a / alpha^2 + (v^2 - a^2 / alpha^2) / (2 a) + (v - a / alpha) dt,

    continuous at ``a / alpha``. Because ``r(v - a dt) <= r(v) - v dt``, the room after a step at v allows v - a dt.
    The speed is at most ``alpha r``, and equal where r < 0.
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


@dataclass(frozen=True, kw_only=True)
class JointLimits:
    """Limits of J joints: lower, upper [rad], velocity [rad/s], acceleration [rad/s^2] (None: no limit).

    gain [1/s]: of position limits; period [s]: of one velocity; by_position: further velocity limits, by q.
    """

    lower: Float64
    upper: Float64
    velocity: Float64
    gain: float
    period: float
    acceleration: Float64 | None = None
    by_position: VelocityLimits | None = None

    @classmethod
    def of(cls, model: RobotModel, config: ControlConfig) -> "JointLimits":
        """An arm's configured limits.

        Raises UsageError for a wrong number of accelerations, or FR3 limits for other joints.
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
        """Lowest and highest joint velocity (J,), (J,) [rad/s] at q.

        Without last_velocity the acceleration limit does not count. It gives way where it contradicts velocity or
        position limits, so that the box is never empty. In states that this box led to, it gives way only to
        by_position.
        """
        lowest, highest = velocity_box(
            q, self.lower, self.upper, self.velocity, self.gain, acceleration=self.acceleration, period=self.period
        )
        if self.by_position is not None:
            slowest, fastest = self.by_position(q)
            lowest, highest = np.clip(lowest, slowest, fastest), np.clip(highest, slowest, fastest)
        if self.acceleration is None or last_velocity is None:
            return lowest, highest
        change = self.acceleration * self.period
        return (np.clip(last_velocity - change, lowest, highest), np.clip(last_velocity + change, lowest, highest))

    def rest(self, last_velocity: Float64 | None) -> Float64:
        """Standstill (J,) [rad/s]: zero, or the nearest velocity that the acceleration allows."""
        if self.acceleration is None or last_velocity is None:
            return np.zeros(len(self.lower))
        change = self.acceleration * self.period
        return np.asarray(np.clip(0.0, last_velocity - change, last_velocity + change))


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
    """Lowest and highest joint velocity (J,), (J,) [rad/s] at q.

    III-E: ``v <= alpha (q_max - q)``, ``v >= -alpha (q - q_min)``, ``|v| <= v_max``, with the gain alpha [1/s]. An
    acceleration (J,) [rad/s^2] replaces the first two by `braking_speed`. For q outside its limits, the box demands
    motion back, up to the velocity limit.
    """
    above, below = upper - q, q - lower
    if acceleration is None:
        fastest_up, fastest_down = gain * above, gain * below
    else:
        fastest_up = braking_speed(above, gain, acceleration, period)
        fastest_down = braking_speed(below, gain, acceleration, period)
    highest = np.clip(fastest_up, -velocity_limit, velocity_limit)
    return np.clip(-fastest_down, -velocity_limit, velocity_limit), highest


def box_rows(lowest: Float64, highest: Float64) -> Rows:
    """Box as rows ``G v <= h``: J upper, then J lower."""
    identity = np.eye(len(lowest))
    return np.vstack([identity, -identity]), np.concatenate([highest, -lowest])


def _acceleration(value: float | tuple[float, ...], joints: Sequence[str]) -> Float64 | None:
    each = np.atleast_1d(np.asarray(value, dtype=np.float64))
    refuse_if(
        len(each) not in (1, len(joints)),
        f"control.max_acceleration: expected one number or {len(joints)}, one for each joint, got {len(each)}",
        remedy=f"in the order {', '.join(joints)}",
        error=UsageError,
    )
    return np.broadcast_to(each, (len(joints),)).copy() if np.any(each != 0) else None


@dataclass(frozen=True, kw_only=True)
class Strain:
    """Largest velocity and acceleration (T,) as shares of their joints' limits.

    velocity_joint, acceleration_joint (T,): these joints. acceleration: 0 without a limit.
    """

    velocity: Float64
    velocity_joint: Index
    acceleration: Float64
    acceleration_joint: Index


class MotionLimits:
    """A motion's velocities and accelerations as shares of limits, less encoder error.

    Velocities are averaged since the last state and over `MOTION_WINDOW`, accelerations over three positions
    `MOTION_WINDOW` apart. A sample covers the time before it.
    """

    def __init__(self, velocity_limit: Float64, acceleration_limit: Float64 | None) -> None:
        """velocity_limit (J,) [1/s], acceleration_limit (J,) [1/s^2] or None."""
        self._velocity, self._acceleration = velocity_limit, acceleration_limit
        self._stamps: Stamps = np.zeros(0, np.int64)
        self._positions: Float64 = np.zeros((0, len(velocity_limit)))

    def add(self, stamps: Stamps, positions: Float64) -> Strain:
        """Strain of the next states: stamps (T,) [ns], positions (T, J)."""
        num = len(stamps)
        all_stamps = np.concatenate([self._stamps, stamps])
        everything = np.concatenate([self._positions, positions])
        first = len(all_stamps) - num
        share = np.zeros((num, positions.shape[1]))
        window = np.int64(fixed.MOTION_WINDOW * 1e9)
        last = np.arange(first, first + num) - 1
        for before in (last, np.minimum(last, np.searchsorted(all_stamps, stamps - window, "right") - 1)):
            has = np.flatnonzero(before >= 0)
            seconds = (stamps[has] - all_stamps[before[has]]) * 1e-9
            moved = np.maximum(np.abs(positions[has] - everything[before[has]]) - 2 * fixed.ENCODER, 0.0)
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
        """Accelerations (T, J) [1/s^2], less encoder error; 0 until the motion is two windows long."""
        seconds = (all_stamps - all_stamps[0]) * 1e-9
        now = (stamps - all_stamps[0]) * 1e-9
        accelerations = np.zeros((len(stamps), everything.shape[1]))
        old = now >= 2 * fixed.MOTION_WINDOW
        for joint in range(everything.shape[1]):
            at = [np.interp(now[old] - k * fixed.MOTION_WINDOW, seconds, everything[:, joint]) for k in range(3)]
            second = np.abs(at[0] - 2 * at[1] + at[2]) - 4 * fixed.ENCODER
            accelerations[old, joint] = np.maximum(second, 0.0) / fixed.MOTION_WINDOW**2
        return accelerations


Cost = tuple[Float64, Float64]
"""H (J, J) and c (J,) of a cost ``1/2 v' H v + c' v`` over joint velocities v (J,)."""

NO_SPHERE: Bool = np.zeros(1, dtype=np.bool_)  # among the moving spheres


@dataclass(frozen=True, kw_only=True)
class State:
    """A step's state, the input of its terms.

    q (J,) [rad]; box: lowest, highest velocity (J,), (J,) [rad/s]; reference (6,) [m/s, rad/s]: desired twist of
    `frame`; guide: the goal's motion (None: at rest); last_velocity (J,) [rad/s] (None: unknown); distance_rate:
    dd/dt [m/s] of the moving spheres, (M,) or one number; by_surface (M,): spheres that count by their link's
    surface.
    """

    model: RobotModel
    frame: str
    q: Float64
    box: tuple[Float64, Float64]
    reference: Float64 = field(default_factory=lambda: np.zeros(6))
    guide: Guide | None = None
    last_velocity: Float64 | None = None
    distance_rate: float | Float64 = 0.0
    by_surface: Bool = field(default_factory=lambda: NO_SPHERE)

    @cached_property
    def jacobian(self) -> Float64:
        """(6, J) of the frame."""
        return self.model.frame_jacobian(self.q, self.frame)

    @cached_property
    def spheres(self) -> tuple[Float64, Float64]:
        """Centres (S, 3) [m], Jacobians (S, 3, J)."""
        return self.model.spheres_at(self.q)


CostTerm = Callable[[State], Cost]
"""A cost over joint velocities at a state."""


def lean_home(state: State, *, home: Float64, gain: float, weight: float) -> Cost:
    """Home bias of III-E, which makes a redundant arm's QP strictly convex.

    It leads to home (J,) [rad], or to the posture and motion of a guide.
    """
    if state.guide is None:
        return stray_cost(gain * (home - state.q), weight)
    return stray_cost(gain * (state.guide.posture - state.q) + state.guide.velocity, weight)


def change_little(state: State, *, weight: float) -> Cost:
    """Smoothness: a cost of change from the last velocity, if known."""
    if state.last_velocity is None:
        return stray_cost(np.zeros(len(state.q)), 0.0)
    return stray_cost(state.last_velocity, weight)


def standard_costs(config: ControlConfig, home: Float64) -> tuple[CostTerm, ...]:
    lean = partial(lean_home, home=home, gain=config.posture_gain, weight=config.posture_weight)
    smooth = partial(change_little, weight=config.smoothness_weight)
    return (lean, smooth) if config.smoothness_weight > 0 else (lean,)


def configured_weights(config: ControlConfig) -> tuple[Float64, Float64]:
    """Diagonals (6,) of Q and R."""
    Q = np.repeat([config.weight_linear, config.weight_angular], 3)
    return Q, config.weight_kinematics * Q


def eliminated_weight(weight_task: Float64, weight_kinematics: Float64) -> Float64:
    """III-E's weight (6,) after elimination of end-effector velocity and slack.

    ``min over d of (e - d)' Q (e - d) + d' R d`` is ``e' W e`` with ``W = (Q^-1 + R^-1)^-1``; Q, R diagonal (6,).
    """
    return np.asarray(1.0 / (1.0 / weight_task + 1.0 / weight_kinematics))


def reach_cost(jacobian: Float64, velocity: Float64, weight: Float64) -> Cost:
    """Cost ``(u - J v)' W (u - J v)`` of deviation from twist u: first two terms of III-E.

    jacobian (6, J); u (6,) [m/s, rad/s], world; weight (6,): diagonal of W.
    """
    weighted = jacobian.T * weight
    return 2.0 * weighted @ jacobian, -2.0 * weighted @ velocity


def stray_cost(velocity: Float64, weight: float) -> Cost:
    """Cost ``weight |v - velocity|^2`` of deviation from a joint velocity (J,) [rad/s]."""
    return 2.0 * weight * np.eye(len(velocity)), -2.0 * weight * velocity


def sum_costs(costs: Sequence[Cost]) -> Cost:
    H, c = np.zeros_like(costs[0][0]), np.zeros_like(costs[0][1])
    for cost_H, cost_c in costs:
        H += cost_H
        c += cost_c
    return H, c


class RowKind(StrEnum):
    """Object that a row guards."""

    LIMIT = "limit"
    SCENE = "scene"
    SELF = "self"


@dataclass(frozen=True, kw_only=True)
class Barrier(Columns):
    """M barrier rows ``G v - s <= h``, with ``G = -dd/dq`` (M, J).

    ``h = alpha (d - epsilon) + dd/dt`` (M,) [m/s], or less with an acceleration limit (`barriers.distance_bound`);
    distance d (M,) [m]; index (M,): among the term's names. A row's slack s [m/s] costs ``slack_cost * s +
    slack_weight * s^2``.
    """

    index: Integers
    G: Float64
    h: Float64
    distance: Float64
    slack_cost: float
    slack_weight: float


class BarrierTerm(ABC):
    """M named rows that bound the velocity.

    A term without distances defines only `rows`: infinite distances exempt it from a step's check.
    """

    kind = RowKind.LIMIT
    names: tuple[str, ...]

    @cached_property
    def margin(self) -> Float64:
        """Margins (M,) [m]."""
        return np.zeros(len(self.names))

    @abstractmethod
    def rows(self, state: State) -> Barrier:
        """Every row, in the order of the names."""

    def room(self, state: State, velocity: Float64) -> Float64:
        """``h - G v`` (M,) [m/s] of a velocity (J,)."""
        rows = self.rows(state)
        return np.asarray(rows.h - rows.G @ velocity)

    def distances(self, centers: Float64) -> Float64:
        """Distances (M,) [m] for sphere centers (S, 3), NaN if unknown."""
        return np.full(len(self.names), np.inf)

"""Goals over time: a pose, a logged motion, a planned detour, or commanded twists.

Twists are world-aligned, linear part first.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.records import Bool, Float64, FloatRows, Floats, Stamps
from splatctrl_cli.robot.model import RobotModel


@dataclass(frozen=True, kw_only=True)
class Guide:
    """A goal's motion: twist (6,) [m/s, rad/s], world, and posture (J,) [rad] to lean to.

    velocity (J,) [rad/s]: of that posture.
    """

    twist: Float64
    posture: Float64
    velocity: Float64


def rotation_vector(R: Float64) -> Float64:
    """Logarithm (3,) [rad] of a rotation (3, 3): axis times angle in [0, pi]."""
    quat_xyzw = quat_from_rotation(R)
    half_sine = float(np.linalg.norm(quat_xyzw[:3]))
    if half_sine == 0.0:
        return np.zeros(3)
    return np.asarray(quat_xyzw[:3] * (2.0 * np.arctan2(half_sine, quat_xyzw[3]) / half_sine))


def pose_error(T_world_frame: Float64, T_world_goal: Float64) -> Float64:
    """Twist (6,) [m, rad], world, that reaches the goal in one second."""
    rotation = rotation_vector(T_world_goal[:3, :3] @ T_world_frame[:3, :3].T)
    return np.concatenate([T_world_goal[:3, 3] - T_world_frame[:3, 3], rotation])


def reference_velocity(error: Float64, *, gain: float, max_linear: float, max_angular: float) -> Float64:
    """Gain times the pose error (6,) [m/s, rad/s], each part capped in norm."""
    velocity = gain * error
    return np.concatenate([_cap(velocity[:3], max_linear), _cap(velocity[3:], max_angular)])


def _cap(vector: Float64, limit: float) -> Float64:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= limit else vector * (limit / norm)


@dataclass(frozen=True, kw_only=True)
class LoggedMotion:
    """T logged states: stamp_ns (T,) that never go back; position, velocity (T, J) [rad, rad/s]."""

    stamp_ns: Stamps
    position: FloatRows
    velocity: FloatRows

    @property
    def last_ns(self) -> int:
        return int(self.stamp_ns[-1])

    def at(self, stamp_ns: int) -> tuple[Float64, Float64]:
        """Position and velocity (J,) at a stamp, linear between states.

        Earlier stamps give the first state, later stamps the last position at rest.
        """
        if stamp_ns > self.last_ns:
            return np.asarray(self.position[-1]), np.zeros(self.position.shape[1])
        after = int(np.searchsorted(self.stamp_ns, stamp_ns, side="left"))
        if after == 0 or self.stamp_ns[after] == stamp_ns:
            return np.asarray(self.position[after]), np.asarray(self.velocity[after])
        before_ns, after_ns = self.stamp_ns[after - 1 : after + 1]
        share = float(stamp_ns - before_ns) / float(after_ns - before_ns)
        position, velocity = (
            (1.0 - share) * values[after - 1] + share * values[after] for values in (self.position, self.velocity)
        )
        return position, velocity


def guided_goal(model: RobotModel, frame: str, position: Float64, velocity: Float64) -> tuple[Float64, Guide]:
    """Pose (4, 4) of a frame, and its `Guide`, at a posture and velocity (J,)."""
    return model.frame_pose(position, frame), Guide(
        twist=model.frame_jacobian(position, frame) @ velocity, posture=position, velocity=velocity
    )


@dataclass(frozen=True, kw_only=True)
class TimedPath:
    """A timed path, at rest at each waypoint (W, J) to keep its edges straight.

    start_time (W,) [s]: of each edge, and the end. top_speed [1/s], acceleration [1/s^2] (W - 1,): of a trapezoidal
    speed, as shares of the edge.
    """

    waypoints: Float64
    start_time: Float64
    top_speed: Float64
    acceleration: Float64

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return float(self.start_time[-1])

    def at(self, time: Floats | float) -> tuple[Float64, Float64]:
        """Position and velocity (K, J) at times (K,) [s]; at rest outside the path."""
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


@dataclass
class Detour:
    """A path whose clock runs while the frame is within `wait_distance` [m] of its goal."""

    path: TimedPath
    wait_distance: float
    clock: float = 0.0

    @property
    def is_over(self) -> bool:
        return self.clock >= self.path.duration

    def goal(self, model: RobotModel, frame: str) -> tuple[Float64, Guide]:
        """`guided_goal` at the clock's time."""
        position, velocity = self.path.at(self.clock)
        return guided_goal(model, frame, position[0], velocity[0])

    def advance(self, seconds: float, pose_error: Float64) -> None:
        """Advance the clock if the position part of pose_error (6,) is below `wait_distance`."""
        if float(np.linalg.norm(pose_error[:3])) < self.wait_distance:
            self.clock = min(self.clock + seconds, self.path.duration)


PlanDetour = Callable[[int, Float64, Float64], Detour | None]
"""Stamp [ns], posture (J,) and goal pose (4, 4) -> a path to the goal in the scene known then, or None."""


@dataclass(frozen=True, kw_only=True)
class TwistTrack:
    """Twists (N, 6) [m/s, rad/s] of the controlled frame, linear first.

    stamp_ns (N,) increases; axes: the frame whose axes the twists use (None: world).
    """

    stamp_ns: Stamps
    twist: Float64
    axes: str | None = None

    def at(self, stamp_ns: int, timeout: float) -> Float64:
        """Newest twist (6,) up to a stamp [ns]; zero if none or older than `timeout` [s]."""
        index = int(np.searchsorted(self.stamp_ns, stamp_ns, side="right")) - 1
        is_old = index < 0 or (stamp_ns - self.stamp_ns[index]) * 1e-9 > timeout
        return np.zeros(6) if is_old else np.asarray(self.twist[index])

    def is_known(self, stamp_ns: Stamps, timeout: float) -> Bool:
        """True for stamps (T,) with a current twist."""
        index = np.searchsorted(self.stamp_ns, stamp_ns, side="right") - 1
        age = (stamp_ns - self.stamp_ns[np.maximum(index, 0)]) * 1e-9
        return np.asarray((index >= 0) & (age <= timeout))

    def find_world_twist(self, model: RobotModel, q: Float64, stamp_ns: int, timeout: float) -> Float64:
        """Twist (6,) at a stamp [ns] in world axes, with the arm at q (J,); not capped."""
        twist = self.at(stamp_ns, timeout)
        if self.axes is None:
            return twist
        R = model.frame_pose(q, self.axes)[:3, :3]
        return np.concatenate([R @ twist[:3], R @ twist[3:]])

    def reference(self, model: RobotModel, config: ControlConfig, q: Float64, stamp_ns: int) -> Float64:
        """`find_world_twist`, each part capped in norm."""
        return reference_velocity(
            self.find_world_twist(model, q, stamp_ns, config.twist_timeout),
            gain=1.0,
            max_linear=config.max_linear_speed,
            max_angular=config.max_angular_speed,
        )

    def goal_at(
        self, model: RobotModel, config: ControlConfig, frame: str, q: Float64, stamp_ns: int
    ) -> tuple[Float64, Guide]:
        """Goal: the frame's present pose (4, 4), moving with the twist; posture q (J,)."""
        return model.frame_pose(q, frame), Guide(
            twist=self.reference(model, config, q, stamp_ns), posture=q, velocity=np.zeros(len(q))
        )

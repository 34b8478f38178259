"""Protective separation distance of ISO/TS 15066:2016, 5.5.4.2.3 (now in ISO 10218-2:2025).

    S_p = S_h + S_r + S_s + C + Z_d + Z_r                                                          (1)

Numbers in brackets are the standard's formulas. T states, M moving spheres, J joints. A scale (T,) from 0 to 1 slows
all joints alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from splatctrl_cli.records import Float64

PERSON_SPEED = 1.6  # [m/s] of v_h where it is not measured, by the standard and ISO 13855
STANDING = 1e-3  # of an axis's speed limit, below which it stands still
SCALE_STEPS = 20  # halvings of the interval of a speed scale: 1e-6


@dataclass(frozen=True, kw_only=True)
class ArmMotion:
    """Motion of an arm's spheres near a person.

    joint_speed (T, J) [rad/s or m/s], velocity_limit (J,); jacobian (T, M, 3, J) of the centres, world axes; gradient
    (T, M, 3) of the distance to the person; extension (T,): share of the arm's reach.
    """

    joint_speed: Float64
    velocity_limit: Float64
    jacobian: Float64
    gradient: Float64
    extension: Float64

    @cached_property
    def velocity(self) -> Float64:
        """Velocities (T, M, 3) [m/s], world axes."""
        return np.asarray(np.einsum("tmij,tj->tmi", self.jacobian, self.joint_speed))

    @cached_property
    def speed(self) -> Float64:
        """Speeds (T, M) [m/s]."""
        return np.asarray(np.linalg.norm(self.velocity, axis=2))

    @cached_property
    def approach(self) -> Float64:
        """v_r (T, M) [m/s]: speeds toward the person, at least 0."""
        return np.asarray(np.maximum(-np.sum(self.gradient * self.velocity, axis=2), 0.0))


@dataclass(frozen=True, kw_only=True)
class Stop:
    """A stop from each state: T_s (T,) [s], S_s (T, M) [m], and travel of the joints (T, J) [rad or m]."""

    time: Float64
    travel: Float64
    joint_travel: Float64


class Stopping(Protocol):
    """A declared account of how the arm stops."""

    def stop(self, motion: ArmMotion, scale: Float64) -> Stop: ...


@dataclass(frozen=True, kw_only=True)
class Deceleration:
    """A stop on the path: the fastest sphere slows by `deceleration` [m/s^2], the declared worst case.

    T_s = v / a and S_s = v^2 / (2 a) for that sphere; each other one travels in proportion to its speed.
    """

    deceleration: float

    def stop(self, motion: ArmMotion, scale: Float64) -> Stop:
        speed, joint_speed = scale[:, None] * motion.speed, scale[:, None] * np.abs(motion.joint_speed)
        time = speed.max(axis=1) / self.deceleration
        return Stop(time=time, travel=speed * time[:, None] / 2, joint_travel=joint_speed * time[:, None] / 2)


@dataclass(frozen=True, kw_only=True)
class StopRow:
    """Declared stops of one axis at an extension and payload, as shares of the largest.

    speed (K,): shares of the axis's limit, rising to 1; time (K,) [s], distance (K,) [rad or m].
    """

    axis: str
    extension: float
    payload: float
    speed: tuple[float, ...]
    time: tuple[float, ...]
    distance: tuple[float, ...]

    def at(self, share: Float64) -> tuple[Float64, Float64]:
        """Time (T,) and distance (T,) at shares (T,) of the speed limit.

        Distances are linear between the rows, which exceeds v^2. Times are at least the first row's. Past the limit
        they grow with v and v^2.
        """
        over = np.maximum(share, 1.0)
        time = np.where(share > STANDING, np.interp(share, self.speed, self.time), 0.0)
        return time * over, np.interp(share, (0.0, *self.speed), (0.0, *self.distance)) * over**2


@dataclass(frozen=True, kw_only=True)
class StopTable:
    """Declared stops by joint, rows by rising extension; the next larger extension counts.

    A sphere's travel adds those of all axes, each on its circle: their stops need not keep the path.
    """

    rows: Sequence[Sequence[StopRow]]

    def stop(self, motion: ArmMotion, scale: Float64) -> Stop:
        share = scale[:, None] * np.abs(motion.joint_speed) / motion.velocity_limit
        time, travel = np.zeros(share.shape), np.zeros(share.shape)
        for joint, rows in enumerate(self.rows):
            chosen = np.searchsorted([row.extension for row in rows[:-1]], motion.extension)
            for number, row in enumerate(rows):
                its = chosen == number
                time[its, joint], travel[its, joint] = row.at(share[its, joint])
        levers = np.linalg.norm(motion.jacobian, axis=2)
        return Stop(time=time.max(axis=1), travel=np.einsum("tmj,tj->tm", levers, travel), joint_travel=travel)


@dataclass(frozen=True, kw_only=True)
class Travel:
    """Motion until the arm stands: person (T,), reaction and stopping (T, M) [m], which is S_h, S_r and S_s."""

    person: Float64
    reaction: Float64
    stopping: Float64

    @property
    def total(self) -> Float64:
        """S_h + S_r + S_s (T, M) [m]."""
        return self.person[:, None] + self.reaction + self.stopping


@dataclass(frozen=True, kw_only=True)
class Approach:
    """A person who walks at person_speed [m/s] toward an arm that reacts after reaction_time [s]."""

    person_speed: float
    reaction_time: float
    stopping: Stopping

    def travel(self, motion: ArmMotion, scale: Float64) -> Travel:
        stop = self.stopping.stop(motion, scale)
        return Travel(
            person=self.person_speed * (self.reaction_time + stop.time),  # (3)
            reaction=scale[:, None] * motion.approach * self.reaction_time,  # (5)
            stopping=stop.travel,  # (6)
        )

    def speed_scale(self, motion: ArmMotion, room: Float64) -> Float64:
        """Largest scales (T,) at which no sphere travels more than its room (T, M) [m]; else 0."""
        kept = np.zeros(len(room))
        for step in (1.0, *(0.5**k for k in range(1, SCALE_STEPS + 1))):
            tried = np.minimum(kept + step, 1.0)
            kept = np.where(np.all(self.travel(motion, tried).total <= room, axis=1), tried, kept)
        return kept

    def time_to_contact(self, motion: ArmMotion, separation: Float64) -> Float64:
        """Least time (T,) [s] in which person and arm, at their speeds, close a separation (T, M) [m]."""
        return np.asarray(np.min(np.maximum(separation, 0.0) / (self.person_speed + motion.approach), axis=1))

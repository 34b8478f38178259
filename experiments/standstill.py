"""The monitored standstill: the arm stops on its path while a person is in a zone, as the baseline of IV-E (without
compliance).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Protocol

import numpy as np

from splatctrl_cli import Box, UsageError
from splatctrl_cli.blocks import Bool, Float64, LoggedMotion, RobotModel, Stamps, runs_of

MAX_RESUME = 100.0  # [m] a zone wider than any hall would hold the arm for ever
ZONE_RESOLUTION = 0.01  # [m] a person this near to a box counts as inside
STOP_ACCELERATION = 7.5  # [rad/s^2] with which the arm brakes and starts (the Panda's)
DistanceToPeople = Callable[[Float64, int], Float64]
"""points (Q, 3) [m], world, and a stamp [ns] -> distance (Q,) [m] to the nearest person, inf without people."""


def remembered(people: DistanceToPeople, age_s: Callable[[int], float], memory: float) -> DistanceToPeople:
    """Distance to the map's people; inf if the map used at a stamp is older than `memory` [s].

    age_s: stamp [ns] -> the age [s] of that map; NaN where maps have no times, and then they stay.
    """

    def distance(points: Float64, stamp_ns: int) -> Float64:
        return np.full(len(points), np.inf) if age_s(stamp_ns) > memory else people(points, stamp_ns)

    return distance


EIGHTHS = np.array(list(product((-0.5, 0.5), repeat=3)))


class StopZone(Protocol):
    """Where people must not be for the arm to move."""

    def is_entered(
        self, model: RobotModel, q: Float64, stamp_ns: int, people: DistanceToPeople, *, is_held: bool
    ) -> bool:
        """True if the arm at q (J,) must stop; a stopped arm (is_held) continues only with more room."""
        ...


@dataclass(frozen=True, kw_only=True)
class Zone:
    """The arm stops if a person is nearer than `stop` [m], and continues if all are farther than `resume` [m]."""

    stop: float
    resume: float

    def __post_init__(self) -> None:
        if not 0 < self.stop <= self.resume <= MAX_RESUME:
            raise UsageError(
                f"zone: expected 0 < stop <= resume <= {MAX_RESUME:g}, got {self.stop:g} and {self.resume:g} m"
            )

    def is_entered(
        self, model: RobotModel, q: Float64, stamp_ns: int, people: DistanceToPeople, *, is_held: bool
    ) -> bool:
        """See `StopZone`."""
        return distance_to_people(model, q, stamp_ns, people) < (self.resume if is_held else self.stop)


@dataclass(frozen=True, kw_only=True)
class BoxZone:
    """The arm stops if a person is in a box, and continues if all are over `hysteresis` [m] away from it."""

    box: Box
    hysteresis: float

    def __post_init__(self) -> None:
        if not self.hysteresis >= 0:
            raise UsageError(f"zone: expected a hysteresis of 0 or more, got {self.hysteresis:g} m")

    def is_entered(
        self, model: RobotModel, q: Float64, stamp_ns: int, people: DistanceToPeople, *, is_held: bool
    ) -> bool:
        """See `StopZone`; wherever the arm is."""
        room = self.hysteresis if is_held else 0.0
        return is_anybody_in(Box(lower=self.box.lower - room, upper=self.box.upper + room), people, stamp_ns)


def is_anybody_in(box: Box, people: DistanceToPeople, stamp_ns: int) -> bool:
    """True if a person reaches into a box, or is within `ZONE_RESOLUTION` of it.

    A distance changes by no more than a metre per metre: a cell whose middle is farther from everybody than from its
    own corners holds nobody, one whose middle is inside somebody does; the others are cut into eight.
    """
    middles, half = (box.lower + box.upper)[None] / 2, (box.upper - box.lower) / 2
    while len(middles):
        distance = people(np.ascontiguousarray(middles), stamp_ns)
        if np.any(distance <= 0):
            return True
        is_open = distance < np.linalg.norm(half)
        if np.linalg.norm(half) < ZONE_RESOLUTION:
            return bool(np.any(is_open))
        middles = (middles[is_open, None] + EIGHTHS * half).reshape(-1, 3)
        half = half / 2
    return False


@dataclass(frozen=True, kw_only=True)
class Separation:
    """A motion of T states beside people: stamp_ns (T,), distance (T,) [m] of the nearest moving sphere's surface to
    the nearest person (inf: nobody), is_stopped (T,); is_complete: it came to its end.
    """

    stamp_ns: Stamps
    position: Float64
    distance: Float64
    is_stopped: Bool
    is_complete: bool

    @property
    def duration_s(self) -> float:
        """From the first state to the last [s]."""
        return float(self.stamp_ns[-1] - self.stamp_ns[0]) * 1e-9

    def figures(self, period: float) -> dict[str, float | None]:
        """Figures by name of states a period [s] apart; distances count states with a person, None without any."""
        there = self.distance[np.isfinite(self.distance)]
        stops = [(end - first) * period for first, end in runs_of(self.is_stopped)]
        return {
            "completed": int(self.is_complete),
            "duration_s": self.duration_s,
            "mean_human_distance": float(there.mean()) if len(there) else None,
            "min_human_distance": float(there.min()) if len(there) else None,
            "num_stops": len(stops),
            "longest_stop_s": max(stops, default=0.0),
            "stopped_s": sum(stops),
        }


def distance_to_people(model: RobotModel, q: Float64, stamp_ns: int, people: DistanceToPeople) -> float:
    """The distance [m] of the nearest moving sphere's surface at q (J,) to the nearest person."""
    moving = np.flatnonzero(model.moving_spheres)
    centers = np.ascontiguousarray(model.sphere_centers(q)[moving])
    return float(np.min(people(centers, stamp_ns) - model.sphere_set.radii[moving]))


@dataclass(frozen=True, kw_only=True)
class Standstill(Separation):
    """The separation of a stopped path. path_s (T,) [s]: the path's time at each state. path_speed (T,): path time
    per second until the next state, 1 as recorded, 0 stopped.
    """

    path_s: Float64 = field(default_factory=lambda: np.zeros(0))
    path_speed: Float64 = field(default_factory=lambda: np.zeros(0))


def monitored_standstill(
    model: RobotModel, motion: LoggedMotion, people: DistanceToPeople, zone: StopZone, *,
    start_ns: int, period: float, max_wait: float, max_acceleration: float = 0.0,
) -> Standstill:  # fmt: skip
    """The path of `motion` from `start_ns`, time-stretched by every stop; people move in the log's time all along.

    q(t) = path(s(t)) with 0 <= s' <= 1: the arm never leaves the path, and continues from its stop. It brakes and
    starts with |s''| <= max_acceleration / (the path's fastest joint speed). Thus braking accelerates no joint by
    more than `max_acceleration` [rad/s^2]; 0 stops the arm at once, which favours it. If a person is in the zone at
    the start, the arm begins stopped. After the log's end, the last scene stays; a stop longer than `max_wait` [s]
    then ends the run.
    """
    tick, end_s = round(period * 1e9), (motion.last_ns - start_ns) * 1e-9
    change = np.inf if max_acceleration == 0 else period * max_acceleration / max(_fastest(motion, start_ns), 1e-9)
    stamp, path_s, speed, waited, is_held = start_ns, 0.0, -1.0, 0, False
    rows: list[tuple[int, Float64, float, float, float]] = []
    while True:
        q = motion.at(start_ns + round(path_s * 1e9))[0]
        is_held = zone.is_entered(model, q, stamp, people, is_held=is_held)
        aim = 0.0 if is_held else 1.0
        speed = aim if speed < 0 else float(np.clip(aim, speed - change, speed + change))
        rows.append((stamp, q, distance_to_people(model, q, stamp, people), path_s, speed))
        waited = waited + tick if speed == 0 and stamp > motion.last_ns else 0
        if path_s >= end_s - 1e-9 or waited > max_wait * 1e9:
            break
        stamp += tick
        path_s = min(path_s + period * speed, end_s)
    stamps, positions, distances, path, speeds = zip(*rows, strict=True)
    return Standstill(
        stamp_ns=np.array(stamps, dtype=np.int64),
        position=np.array(positions),
        distance=np.array(distances),
        is_stopped=np.array(speeds) == 0,
        is_complete=path_s >= end_s - 1e-9,
        path_s=np.array(path),
        path_speed=np.array(speeds),
    )


def _fastest(motion: LoggedMotion, start_ns: int) -> float:
    """Largest joint speed [rad/s] between neighbouring states of the path from `start_ns` on."""
    seconds = np.diff(motion.stamp_ns) * 1e-9
    is_used = (seconds > 0) & (motion.stamp_ns[1:] > start_ns)
    moved = np.abs(np.diff(np.asarray(motion.position), axis=0))[is_used]
    return float(np.max(moved / seconds[is_used, None], initial=0.0))


def separation_of(
    model: RobotModel, stamp_ns: Stamps, position: Float64, velocity: Float64, people: DistanceToPeople, *,
    still: float, is_complete: bool,
) -> Separation:  # fmt: skip
    """The same of a known motion, T states with velocity (T, J); stopped: no joint faster than `still` [rad/s]."""
    distance = [distance_to_people(model, q, int(stamp), people) for stamp, q in zip(stamp_ns, position, strict=True)]
    return Separation(
        stamp_ns=stamp_ns,
        position=position,
        distance=np.array(distance),
        is_stopped=np.asarray(np.max(np.abs(velocity), axis=1) < still),
        is_complete=is_complete,
    )

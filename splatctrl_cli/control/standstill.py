"""The monitored standstill: the logged path, held while a person is near, as the baseline of IV-E (no compliance)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.audit import Stamps
from splatctrl_cli.control.course import LoggedMotion
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Bool, Float64

DistanceToPeople = Callable[[Float64, int], Float64]
"""points (Q, 3) [m], world, and a stamp [ns] -> distance (Q,) [m] to the nearest person, inf where nobody is."""


@dataclass(frozen=True, kw_only=True)
class Zone:
    """The arm stops where a person is nearer than `stop` [m], and goes on where nobody is nearer than `resume`."""

    stop: float
    resume: float

    def __post_init__(self) -> None:
        if not 0 < self.stop <= self.resume:
            raise UsageError(f"zone: expected 0 < stop <= resume, got {self.stop:g} and {self.resume:g} m")


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


def distance_to_people(model: ArmModel, q: Float64, stamp_ns: int, people: DistanceToPeople) -> float:
    """The distance [m] of the nearest moving sphere's surface at q (J,) to the nearest person."""
    moving = np.flatnonzero(model.moving_spheres)
    centers = np.ascontiguousarray(model.sphere_centers(q)[moving])
    return float(np.min(people(centers, stamp_ns) - model.sphere_set.radii[moving]))


def monitored_standstill(
    model: ArmModel,
    motion: LoggedMotion,
    people: DistanceToPeople,
    zone: Zone,
    *,
    start_ns: int,
    period: float,
    max_wait: float,
) -> Separation:
    """The logged path from `start_ns`, delayed by every stop; people move in the log's time, whatever the arm does.

    The arm stops and goes on without delay, which favours it. After the log's end the last scene stays; a stop that
    then lasts longer than `max_wait` [s] ends the run.
    """
    tick = round(period * 1e9)
    stamp = path_ns = start_ns
    stamps, positions, distances, stops = [], [], [], []
    is_stopped, waited = False, 0
    while True:
        q = motion.at(path_ns)[0]
        distance = distance_to_people(model, q, stamp, people)
        is_stopped = distance < (zone.resume if is_stopped else zone.stop)
        stamps.append(stamp)
        positions.append(q)
        distances.append(distance)
        stops.append(is_stopped)
        waited = waited + tick if is_stopped and stamp > motion.last_ns else 0
        if path_ns >= motion.last_ns or waited > max_wait * 1e9:
            break
        stamp += tick
        path_ns += 0 if is_stopped else tick
    return Separation(
        stamp_ns=np.array(stamps, dtype=np.int64),
        position=np.array(positions),
        distance=np.array(distances),
        is_stopped=np.array(stops, dtype=np.bool_),
        is_complete=path_ns >= motion.last_ns,
    )


def separation_of(
    model: ArmModel, stamp_ns: Stamps, position: Float64, velocity: Float64, people: DistanceToPeople, *,
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

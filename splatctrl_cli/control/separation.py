"""Protective separation distance of ISO/TS 15066:2016, 5.5.4.2.3 (now in ISO 10218-2:2025).

    S_p = S_h + S_r + S_s + C + Z_d + Z_r                                                          (1)

Numbers in brackets are the standard's formulas. T states, M moving spheres, J joints. A scale (T,) from 0 to 1 slows
all joints alike. A TOML file declares the inputs (`--separation`).
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from splatctrl_cli.config.ranges import OneOf, Within, format_value
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_faults, refuse_if
from splatctrl_cli.formats.unpacking import read_text
from splatctrl_cli.records import Float64

PERSON_SPEED = 1.6  # [m/s] of v_h where it is not measured, by the standard and ISO 13855
STANDING = 1e-3  # of an axis's speed limit, below which it stands still
SCALE_STEPS = 20  # halvings of a speed scale's interval, down to 1e-6


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

    T_s = v / a and S_s = v^2 / (2 a) for that sphere; each other sphere travels in proportion to its speed.
    """

    deceleration: float

    def stop(self, motion: ArmMotion, scale: Float64) -> Stop:
        speed, joint_speed = scale[:, None] * motion.speed, scale[:, None] * np.abs(motion.joint_speed)
        time = speed.max(axis=1) / self.deceleration
        return Stop(time=time, travel=speed * time[:, None] / 2, joint_travel=joint_speed * time[:, None] / 2)


@dataclass(frozen=True, kw_only=True)
class StopRow:
    """Declared stops of one axis at an extension and payload, both shares of the largest.

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

        Distances are linear between declared speeds, which exceeds v^2. Times are at least the first, 0 at
        standstill. Above the limit, times grow with v, distances with v^2.
        """
        over = np.maximum(share, 1.0)
        time = np.where(share > STANDING, np.interp(share, self.speed, self.time), 0.0)
        return time * over, np.interp(share, (0.0, *self.speed), (0.0, *self.distance)) * over**2


@dataclass(frozen=True, kw_only=True)
class StopTable:
    """Declared stops by joint, rows by rising extension; the next larger extension counts.

    A sphere's travel is the sum of its arcs about all axes: independent stops leave the path.
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
    """Motion until the arm stands: person S_h (T,), reaction S_r and stopping S_s (T, M) [m]."""

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
        """Largest scales (T,) at which no sphere's `travel` exceeds its room (T, M) [m]; else 0."""
        scale = np.zeros(len(room))
        for step in (1.0, *(0.5**k for k in range(1, SCALE_STEPS + 1))):
            tried = np.minimum(scale + step, 1.0)
            scale = np.where(np.all(self.travel(motion, tried).total <= room, axis=1), tried, scale)
        return scale

    def time_to_contact(self, motion: ArmMotion, separation: Float64) -> Float64:
        """Least time (T,) [s] for person and arm to close a separation (T, M) [m]."""
        return np.asarray(np.min(np.maximum(separation, 0.0) / (self.person_speed + motion.approach), axis=1))


REMEDY = "see splatctrl help separation for the keys of this file"
_refuse_if = partial(refuse_if, remedy=REMEDY, error=UsageError)
ANYTHING, LABELLED, NEWCOMER = "anything", "labelled", "newcomer"  # surfaces that count as a person
IGNORED, PERSON = "ignored", "person"  # space that no camera ever saw
KEYS: Mapping[str, Mapping[str, Within | OneOf]] = {
    "person": {
        "who": OneOf((ANYTHING, LABELLED, NEWCOMER), "surfaces that count as a person"),
        "empty_at": Within(0, 1e8, "s", "time of the log whose map shows the cell without people"),
        "speed": Within(0, 20, "m/s", "v_h, if it was measured"),
        "unseen": OneOf((IGNORED, PERSON), "space that no camera ever saw"),
    },
    "robot": {
        "reaction_time": Within(0, 60, "s", "T_r"),
        "deceleration": Within(1e-3, 1e3, "m/s^2", "worst case of the fastest part"),
        "payload": Within(0, 1, "", "share of the rated load, for a stop table"),
        "reach": Within(0.01, 100, "m", "largest extension, for a stop table"),
    },
    "distance": {
        "intrusion": Within(0, 10, "m", "C"),
        "map_error": Within(0, 10, "m", "Z_d without the evidence's age"),
        "robot_error": Within(0, 10, "m", "Z_r"),
    },
}
STOP_KEYS = ("axis", "extension", "payload", "speed", "time", "distance")


@dataclass(frozen=True, kw_only=True)
class DeclaredSeparation:
    """The keys of the file, None where absent. stops: rows of the stop table."""

    intrusion: float
    who: str = ANYTHING
    unseen: str = IGNORED
    empty_at: float | None = None
    speed: float | None = None
    reaction_time: float | None = None
    deceleration: float | None = None
    payload: float | None = None
    reach: float | None = None
    map_error: float | None = None
    robot_error: float | None = None
    stops: tuple[StopRow, ...] = field(default=())

    def stopping(self, axes: Sequence[str]) -> Stopping:
        """The arm's stops; in a table, the rows of the next larger payload count."""
        if self.deceleration is not None:
            return Deceleration(deceleration=self.deceleration)
        payloads = sorted({row.payload for row in self.stops})
        carried = min(load for load in payloads if load >= (1.0 if self.payload is None else self.payload))
        chosen = sorted((row for row in self.stops if row.payload == carried), key=lambda row: row.extension)
        return StopTable(rows=[[row for row in chosen if row.axis == axis] for axis in axes])


def read_separation(path: Path, axes: Sequence[str]) -> DeclaredSeparation:
    """Read the declared inputs.

    axes: the robot's joints.
    Raises InputError for a missing file; UsageError for text that is not TOML, an unknown or missing key, or a value
    out of range. A stop table must be complete for all axes, and rise with the speed.
    """
    faults = (tomllib.TOMLDecodeError, UnicodeDecodeError)
    with refuse_faults(f"{path}: not valid TOML", *faults, remedy=REMEDY, error=UsageError):
        document = tomllib.loads(read_text(path, "give --separation a TOML file"))
    entries = document.pop("stop", [])
    values: dict[str, Any] = {}
    for name, table in document.items():
        _check_key(str(path), name, (*KEYS, "stop"))
        _refuse_if(not isinstance(table, dict), f"{path}: {name}: expected a table, got {format_value(table)}")
        for key, value in table.items():
            _check_key(f"{path}: {name}", key, tuple(KEYS[name]))
            values[key] = _checked(f"{path}: {name}.{key}", KEYS[name][key], value)
    _refuse_if(
        "intrusion" not in values, f"{path}: distance.intrusion: missing", remedy="declare C, 0 if nothing reaches in"
    )
    is_newcomer = values.get("who") == NEWCOMER
    _refuse_if(
        is_newcomer != ("empty_at" in values),
        f"{path}: person.empty_at: expected with who = {NEWCOMER!r}, {'missing' if is_newcomer else 'got another'}",
        remedy="give the time of the log at which the cell is empty",
    )
    _refuse_if(
        bool(entries) == ("deceleration" in values),
        f"{path}: expected [[stop]] entries or robot.deceleration, got {'both' if entries else 'neither'}",
    )
    _refuse_if(
        not isinstance(entries, list), f"{path}: stop: expected entries, got one table", remedy="write [[stop]]"
    )
    declared = DeclaredSeparation(
        **values, stops=tuple(_stop(f"{path}: stop {number}", entry) for number, entry in enumerate(entries, start=1))
    )
    if declared.stops:
        _check_table(path, declared, axes)
    return declared


def _stop(where: str, entry: Any) -> StopRow:
    _refuse_if(not isinstance(entry, dict), f"{where}: expected a table, got {format_value(entry)}")
    for key in entry:
        _check_key(where, key, STOP_KEYS)
    for key in STOP_KEYS:
        _refuse_if(key not in entry, f"{where}: {key}: missing")
    share, number = Within(0, 1, "", ""), Within(0, 1e3, "", "")
    lists: dict[str, tuple[float, ...]] = {}
    for key in ("speed", "time", "distance"):
        values = entry[key]
        _refuse_if(
            not isinstance(values, list) or len(values) != len(entry["speed"]) or not values,
            f"{where}: {key}: expected a list of one number for each speed, got {format_value(values)}",
        )
        lists[key] = tuple(_checked(f"{where}: {key}", share if key == "speed" else number, v) for v in values)
    speed = lists["speed"]
    _refuse_if(
        not all(0 < a < b for a, b in pairwise(speed)) or speed[-1] != 1.0,
        f"{where}: speed: expected shares that rise to 1, got {list(speed)}",
        remedy="add the speeds that are missing, such as 0.33, 0.66 and 1.0",
    )
    for key in ("time", "distance"):
        _refuse_if(
            any(b < a for a, b in pairwise(lists[key])),
            f"{where}: {key}: expected values that rise with the speed, got {list(lists[key])}",
            remedy="check the order of the values and their units",
        )
    extension, payload = (_checked(f"{where}: {key}", share, entry[key]) for key in ("extension", "payload"))
    return StopRow(axis=str(entry["axis"]), extension=extension, payload=payload, **lists)


def _check_table(path: Path, declared: DeclaredSeparation, axes: Sequence[str]) -> None:
    rows = {(row.axis, row.extension, row.payload) for row in declared.stops}
    extensions, payloads = {row.extension for row in declared.stops}, {row.payload for row in declared.stops}
    unknown = sorted({row.axis for row in declared.stops} - {*axes})
    _refuse_if(
        unknown, f"{path}: stop: unknown axis {', '.join(unknown[:1])}", remedy=f"the robot has {', '.join(axes)}"
    )
    gaps = [
        (axis, extension, payload)
        for axis in axes
        for extension in sorted(extensions | {1.0})
        for payload in sorted(payloads)
        if (axis, extension, payload) not in rows
    ]
    _refuse_if(
        gaps,
        f"{path}: stop: missing axis, extension, payload: {gaps and ', '.join(map(str, gaps[0]))}",
        remedy="declare every axis at the same extensions, up to 1, and payloads",
    )
    _refuse_if(len(rows) < len(declared.stops), f"{path}: stop: an axis, extension and payload is given twice")
    carried = 1.0 if declared.payload is None else declared.payload
    _refuse_if(
        max(payloads) < carried,
        f"{path}: stop: expected a payload of at least {carried:g}, got {max(payloads):g} at most",
        remedy="add its rows, or declare robot.payload",
    )
    _refuse_if(
        len(extensions) > 1 and declared.reach is None,
        f"{path}: robot.reach: missing, for stops by extension",
        remedy="give the largest extension in metres",
    )


def _checked(where: str, declared: Within | OneOf, value: Any) -> Any:
    is_number = type(value) in (int, float)
    is_kind = isinstance(value, str) if isinstance(declared, OneOf) else is_number
    _refuse_if(
        not is_kind or not declared.holds(value), f"{where}: expected {declared.expected}, got {format_value(value)}"
    )
    return float(value) if is_number else value


def _check_key(where: str, key: str, known: Sequence[str]) -> None:
    _refuse_if(
        key not in known,
        f"{where}: unknown key {key}",
        remedy=did_you_mean(key, known, f"known here: {', '.join(known)}"),
    )

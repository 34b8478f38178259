"""Declared inputs of a protective separation distance, from a TOML file (`--separation`)."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from splatctrl_cli.config.ranges import OneOf, Within, format_value
from splatctrl_cli.control.separation import Deceleration, Stopping, StopRow, StopTable
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_faults, refuse_if
from splatctrl_cli.formats.unpacking import read_text

REMEDY = "see splatctrl help separation for the keys of this file"
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
        """The arm's stops; a table's rows are those of the next larger payload."""
        if self.deceleration is not None:
            return Deceleration(deceleration=self.deceleration)
        payloads = sorted({row.payload for row in self.stops})
        carried = min(load for load in payloads if load >= (1.0 if self.payload is None else self.payload))
        chosen = sorted((row for row in self.stops if row.payload == carried), key=lambda row: row.extension)
        return StopTable(rows=[[row for row in chosen if row.axis == axis] for axis in axes])


def read_separation(path: Path, axes: Sequence[str]) -> DeclaredSeparation:
    """Read the declared inputs.

    axes: the robot's joints; a stop table must have all.
    Raises InputError for a missing file; UsageError for other text than TOML, an unknown or missing key, a value out
    of range, or a stop table that is incomplete or falls with the speed.
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
        "intrusion" not in values, f"{path}: distance.intrusion: missing", "declare C, 0 if nothing reaches in"
    )
    is_newcomer = values.get("who") == NEWCOMER
    _refuse_if(
        is_newcomer != ("empty_at" in values),
        f"{path}: person.empty_at: expected with who = {NEWCOMER!r}, {'missing' if is_newcomer else 'got another'}",
        "give the time of the log at which the cell is empty",
    )
    _refuse_if(
        bool(entries) == ("deceleration" in values),
        f"{path}: expected [[stop]] entries or robot.deceleration, got {'both' if entries else 'neither'}",
    )
    _refuse_if(not isinstance(entries, list), f"{path}: stop: expected entries, got one table", "write [[stop]]")
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
        "add the speeds that are missing, such as 0.33, 0.66 and 1.0",
    )
    for key in ("time", "distance"):
        _refuse_if(
            any(b < a for a, b in pairwise(lists[key])),
            f"{where}: {key}: expected values that rise with the speed, got {list(lists[key])}",
            "check the order of the values and their units",
        )
    extension, payload = (_checked(f"{where}: {key}", share, entry[key]) for key in ("extension", "payload"))
    return StopRow(axis=str(entry["axis"]), extension=extension, payload=payload, **lists)


def _check_table(path: Path, declared: DeclaredSeparation, axes: Sequence[str]) -> None:
    rows = {(row.axis, row.extension, row.payload) for row in declared.stops}
    extensions, payloads = {row.extension for row in declared.stops}, {row.payload for row in declared.stops}
    unknown = sorted({row.axis for row in declared.stops} - {*axes})
    _refuse_if(unknown, f"{path}: stop: unknown axis {', '.join(unknown[:1])}", f"the robot has {', '.join(axes)}")
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
        "declare every axis at the same extensions, up to 1, and payloads",
    )
    _refuse_if(len(rows) < len(declared.stops), f"{path}: stop: an axis, extension and payload is given twice")
    carried = 1.0 if declared.payload is None else declared.payload
    _refuse_if(
        max(payloads) < carried,
        f"{path}: stop: expected a payload of at least {carried:g}, got {max(payloads):g} at most",
        "add its rows, or declare robot.payload",
    )
    _refuse_if(
        len(extensions) > 1 and declared.reach is None,
        f"{path}: robot.reach: missing, for stops by extension",
        "give the largest extension in metres",
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
        key not in known, f"{where}: unknown key {key}", did_you_mean(key, known, f"known here: {', '.join(known)}")
    )


def _refuse_if(is_bad: object, what: str, remedy: str = REMEDY) -> None:
    refuse_if(is_bad, what, remedy=remedy, error=UsageError)

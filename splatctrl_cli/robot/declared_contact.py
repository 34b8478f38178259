"""Declared contact: carried objects and intended touches, from a TOML file (`--declare`)."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.formats.unpacking import read_toml
from splatctrl_cli.records import Bool, Box, Floats

REMEDY = "see splatctrl help declare for the keys of a declaration"


@dataclass(frozen=True, kw_only=True)
class DeclaredContact:
    """A carried box or intended contact of `link`, from `start` to `end` [s after the first state].

    box [m]: the carried one in the link's frame, or the contact's region in world. reason: of a contact. is_learned:
    from an observed grasp, not a file.
    """

    link: str
    box: Box
    start: float
    end: float
    reason: str = ""
    is_learned: bool = False


@dataclass(frozen=True, kw_only=True)
class Declarations:
    """Declared entries in file order.

    num_uses: by (table, index), how often an entry changed a label or excused a contact.
    """

    carried: tuple[DeclaredContact, ...] = ()
    expected_contact: tuple[DeclaredContact, ...] = ()
    num_uses: dict[tuple[str, int], int] = field(default_factory=dict)

    def carried_at(self, time_s: float) -> list[tuple[str, Box]]:
        """Links and boxes carried at a time, in their frames."""
        return [(entry.link, entry.box) for entry in self.carried if entry.start <= time_s <= entry.end]

    def is_carried(self, link: str, points_link: Floats, time_s: float) -> Bool:
        """True (N,) for points (N, 3) [m], link frame, in a carried box; counts uses."""
        inside = np.zeros(len(points_link), bool)
        for index, entry in enumerate(self.carried):
            if entry.link == link and entry.start <= time_s <= entry.end:
                its = entry.box.contains(points_link)
                self.count_use("carried", index, int(its.sum()))
                inside |= its
        return inside

    def find_expected(self, link: str, point_world: Floats, time_s: float) -> DeclaredContact | None:
        """First entry for a contact at a point (3,) [m]; counts its use."""
        for index, entry in enumerate(self.expected_contact):
            if link == entry.link and entry.start <= time_s <= entry.end and entry.box.contains(point_world):
                self.count_use("expected_contact", index, 1)
                return entry
        return None

    def count_use(self, table: str, index: int, count: int) -> None:
        if count:
            self.num_uses[table, index] = self.num_uses.get((table, index), 0) + count

    def carried_uses(self) -> list[dict[str, Any]]:
        return [
            {
                **{"link": entry.link, "start": entry.start, "end": entry.end},
                "box": [*entry.box.lower.tolist(), *entry.box.upper.tolist()],
                "num_uses": self.num_uses.get(("carried", index), 0),
            }
            for index, entry in enumerate(self.carried)
        ]

    def unused(self) -> list[tuple[str, int]]:
        """(table, index) of unused entries."""
        counts = {"carried": len(self.carried), "expected_contact": len(self.expected_contact)}
        entries = [(table, index) for table, count in counts.items() for index in range(count)]
        return [entry for entry in entries if not self.num_uses.get(entry)]


def carried_words(entry: Mapping[str, Any]) -> str:
    """An entry of `Declarations.carried_uses` in words, with a warning if unused."""
    used = (
        f"{entry['num_uses']} points"
        if entry["num_uses"]
        else "warning: no pixel of any frame needed it; check link and box"
    )
    return f"{entry['link']} carries a box from {entry['start']:g} to {entry['end']:g} s: {used}"


def read_declarations(path: Path, links: Collection[str] | None = None) -> Declarations:
    """Read declarations from TOML; `links`: of the robot, None if unknown.

    Raises InputError for an unreadable file, unknown tables, keys or links, or an invalid box or time.
    """
    document = read_toml(path, REMEDY)
    unknown = sorted(set(document) - {"carried", "expected_contact"})
    refuse_if(
        unknown, f"{path}: expected [[carried]] and [[expected_contact]], got {''.join(unknown[:1])}", remedy=REMEDY
    )
    carried, expected = (
        tuple(DeclaredContact(**entry) for entry in _entries(path, document, table, links))
        for table in ("carried", "expected_contact")
    )
    return Declarations(carried=carried, expected_contact=expected)


def _entries(
    path: Path, document: dict[str, Any], table: str, links: Collection[str] | None
) -> Iterator[dict[str, Any]]:
    entries = document.get(table, [])
    refuse_if(
        not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries),
        f"{path}: {table}: expected entries, got one table",
        remedy=f"write [[{table}]]",
    )
    kinds: dict[str, type] = {"link": str, "box": list, "start": float, "end": float}
    kinds |= {"reason": str} if table == "expected_contact" else {}
    for index, entry in enumerate(entries):
        where = f"{path}: {table} {index + 1}"
        for key in sorted(set(entry) ^ set(kinds)):
            raise InputError(f"{where}: {'unknown' if key in entry else 'missing'} key '{key}'", remedy=REMEDY)
        refuse_if(
            links is not None and entry["link"] not in links,
            f"{where}: link: expected a link of the robot, got {entry['link']!r}",
            remedy=f"its links: {', '.join(links or ())}",
        )
        reason = entry.get("reason", "none")
        refuse_if(
            not isinstance(reason, str) or not reason.strip(),
            f"{where}: reason: expected words, got {reason!r}",
            remedy="say why it is meant",
        )
        start, end = (_number(where, key, entry[key]) for key in ("start", "end"))
        refuse_if(not start < end, f"{where}: expected start < end, got {start:g} and {end:g} s", remedy=REMEDY)
        yield {**entry, "box": _box(where, entry["box"]), "start": start, "end": end}


def _box(where: str, values: object) -> Box:
    if not isinstance(values, list) or len(values) != 6:
        raise InputError(f"{where}: box: expected [lx, ly, lz, ux, uy, uz] [m], got {values!r}", remedy=REMEDY)
    numbers = np.array([_number(where, "box", value) for value in values])
    refuse_if(
        not np.all(numbers[:3] < numbers[3:]),
        f"{where}: box: expected its lower corner below its upper one, got {values}",
        remedy=REMEDY,
    )
    return Box(lower=numbers[:3], upper=numbers[3:])


def _number(where: str, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{where}: {key}: expected a finite number, got {value!r}", remedy=REMEDY)
    return float(value)

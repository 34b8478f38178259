"""The shape of what `info` says about a file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table: rows of as many cells as the header has."""

    name: str
    header: tuple[str, ...]
    rows: Sequence[Sequence[object]]


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A described file: its kind, facts by name, tables, what a reconstruction would lack, remarks.

    damaged counts what could not be read.
    """

    path: str
    kind: str
    facts: Mapping[str, object] = field(default_factory=dict)
    grids: tuple[Grid, ...] = ()
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    damaged: int = 0

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON: facts, each table as a list of objects, `missing` and `notes`."""
        grids = {g.name: [dict(zip(g.header, row, strict=True)) for row in g.rows] for g in self.grids}
        return {
            "path": self.path,
            "kind": self.kind,
            **self.facts,
            **grids,
            "missing": list(self.missing),
            "notes": list(self.notes),
            "damaged": self.damaged,
        }

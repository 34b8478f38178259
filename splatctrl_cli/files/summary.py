"""The shape of `info`'s answer, and names in folders of millions of files.

Names are strings: Path objects cost ten times more.
"""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table; unused: first cells of rows no command reads."""

    name: str
    header: tuple[str, ...]
    rows: Sequence[Sequence[object]]
    unused: Collection[object] = ()


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A described file: facts, tables, missing input, notes; `damaged` counts unreadable parts."""

    path: str
    kind: str
    facts: Mapping[str, object] = field(default_factory=dict)
    grids: tuple[Grid, ...] = ()
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    damaged: int = 0

    def as_dict(self) -> dict[str, object]:
        return {
            "path": self.path,
            "kind": self.kind,
            **self.facts,
            **{g.name: [dict(zip(g.header, row, strict=True)) for row in g.rows] for g in self.grids},
            "missing": list(self.missing),
            "notes": list(self.notes),
            "damaged": self.damaged,
        }


def names_in(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))  # noqa: PTH208  (paths cost ten times more)


def files_below(path: Path) -> tuple[int, int]:
    """Number and bytes of files at any depth, links not followed."""
    if not path.is_dir():
        return (1, path.stat().st_size) if path.is_file() else (0, 0)
    count, size, folders = 0, 0, [str(path)]
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif entry.is_file():
                    count, size = count + 1, size + entry.stat().st_size
    return count, size

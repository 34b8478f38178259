"""The table of a campaign: a row for each recording and replay, in a CSV file."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass, fields
from math import isnan, nan
from pathlib import Path

MARGIN_MM = 20.0
GREEN_MM, RED_MM, CAUTION_MM = 15.0, 35.0, 40.0  # safe is false below, red is false above, caution useless from
SAFE, FAILED, CONTACT = "safe", "failed", "contact"
NOT_EVALUABLE, REFUSED, CRASH = "not evaluable", "refused", "crash"
OUTCOMES = (SAFE, FAILED, CONTACT, NOT_EVALUABLE, REFUSED, CRASH)
AUDIT, DRIVEN, RECORD = "audit", "driven", "record"
CLEAR, UNKNOWN = "clear", "unknown"
TRUTHS = (CONTACT, "margin", CLEAR, UNKNOWN)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One replay of one recording, with its truth. Missing figures are NaN; lengths are in mm."""

    seed: int
    index: int
    mode: str  # audit, driven, or record where no recording could be made
    family: str = ""
    robot: str = ""
    depth: str = ""
    num_cams: int = 0
    log: str = ""  # mcap, bag or ros2
    outcome: str = CRASH
    label: str = ""  # of the verdict
    said_mm: float = nan  # least clearance by the tool
    true_mm: float = nan  # least true clearance of the seen surface over the same states
    collision_mm: float = nan  # the same of the collision meshes
    median_mm: float = nan  # |said - true| of a state: median and 95 %
    p95_mm: float = nan
    over_share: float = nan  # of states over-estimated by more than 8 mm
    over_mm: float = nan  # largest over-estimate where the truth is under 100 mm
    num_states: int = 0
    num_said_below: int = 0  # states below the margin
    num_true_below: int = 0
    worst_s: float = nan  # the state of the least clearance by the tool: its time in the log, and what is nearest
    worst_link: str = ""
    worst_splat: str = ""
    worst_true_mm: float = nan
    true_link: str = ""
    true_object: str = ""
    reason: str = ""
    seconds: float = nan

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return f"{self.seed}-{self.index}"

    @property
    def truth(self) -> str:
        """`contact`, `margin` (broken), `clear` or `unknown`."""
        if isnan(self.true_mm):
            return UNKNOWN
        return CONTACT if self.true_mm < 0 else "margin" if self.true_mm < MARGIN_MM else CLEAR

    @property
    def is_false_green(self) -> bool:
        """Safe, though truly in contact or 5 mm under the margin."""
        return self.outcome == SAFE and self.true_mm < GREEN_MM

    @property
    def is_red(self) -> bool:
        """Contact or margin broken, by the tool."""
        return self.label in {"contact", "margin broken"}

    @property
    def is_false_red(self) -> bool:
        """Red, though truly far from contact and margin."""
        return self.is_red and self.true_mm > RED_MM

    @property
    def is_useless_caution(self) -> bool:
        """True if there is no answer, though the motion is clear and at least three cameras see it."""
        return self.outcome in {NOT_EVALUABLE, REFUSED} and self.true_mm >= CAUTION_MM and self.num_cams >= 3

    @property
    def criterion(self) -> str:
        """A verdict's failed criterion; or the first words of a refusal's message."""
        return (self.reason.partition(":")[0] if self.label else self.reason.partition(",")[0]) or "none"


COLUMNS = tuple(field.name for field in fields(Row))
_READERS = {field.name: {int: int, float: float, str: str}[field.type] for field in fields(Row)}  # type: ignore[index]


def read_rows(path: Path) -> list[Row]:
    """The rows of a table, in its order; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        return [Row(**{k: _READERS[k](text) for k, text in entry.items()}) for entry in csv.DictReader(stream)]


def merge_rows(before: Iterable[Row], rows: Iterable[Row]) -> list[Row]:
    """All rows by seed, index and mode; new rows replace all earlier rows of their recordings."""
    new = [*rows]
    recordings = {row.name for row in new}
    kept = [row for row in before if row.name not in recordings]
    return sorted([*kept, *new], key=lambda row: (row.seed, row.index, row.mode))


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write a table; an earlier file stays until the new file is complete."""
    part = path.with_name(f"{path.name}.part")
    with part.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        values = ([getattr(row, name) for name in COLUMNS] for row in rows)
        writer.writerows([f"{v:.5g}" if isinstance(v, float) else v for v in each] for each in values)
    part.replace(path)

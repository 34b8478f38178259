"""Where a replay shows a figure: the state of ``steps.csv`` that is worst by it."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.evaluate.metrics import Shown
from splatctrl_cli.jobs.declared_metrics import shown


@dataclass(frozen=True, kw_only=True)
class WorstState:
    """A state by its row, from 0, and its time [s] as in ``steps.csv``; the nearest sphere, and what it is near."""

    state: int
    time_s: float
    sphere: str = ""
    obstacle: str = ""

    def __str__(self) -> str:
        """As words of a report."""
        near = f", {self.sphere}" if self.sphere else ""
        return f"state {self.state}{near}" + (f" near {self.obstacle}" if self.obstacle else "")


def worst_state(folder: Path | None, metric: str) -> WorstState | None:
    """Where the replay in `folder` shows a metric; None where its states do not, or are not there."""
    where = shown().get(metric)
    if where is None or folder is None or not (folder / "steps.csv").is_file():
        return None
    with (folder / "steps.csv").open(encoding="utf-8", newline="") as stream:
        rows = csv.DictReader(stream)
        if where.column not in (rows.fieldnames or ()):
            return None
        found, least = None, math.inf
        for index, row in enumerate(rows):
            badness = _badness(where, row[where.column])
            if badness < least:
                found, least = (index, row), badness
    if found is None:
        return None
    index, row = found
    sphere = row.get(f"nearest_{where.column.removeprefix('clearance_')}") or ""
    is_exact = where.column == "clearance_exact"
    obstacle = (row.get("obstacle") or "") if is_exact else ""
    return WorstState(state=index, time_s=float(row["time_s"]), sphere=sphere, obstacle=obstacle)


def _badness(where: Shown, text: str) -> float:
    """Smaller is worse; infinite where the cell does not count."""
    if where.pick not in ("least", "largest"):
        return 0.0 if text == where.pick else math.inf
    if not text:
        return math.inf
    return float(text) if where.pick == "least" else -float(text)

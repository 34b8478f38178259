"""What changed against a baseline, as a table of a report: from what compare prints, or from rows of one's own."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError
from splatctrl_cli.jobs.worst_state import WorstState
from splatctrl_cli.report.page import Cell, Row, Table

ID = "id"  # of a job, in a row
COMPARED = {"verdicts", "figures"}  # of what compare prints
STATES = {"worse": "failed"}  # of a row, by its change
SHOWN = ("worse", "better")  # of figures; the others have no direction


def table_of_changes(path: Path | None) -> Table:
    """The rows of a file, no rows without one; columns in the order in which they come up. Raises InputError for a
    file that is neither a JSON list of objects nor what ``compare --json`` prints.
    """
    if path is None:
        return Table()
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    try:
        rows = list(_compared(rows)) if isinstance(rows, dict) and rows.keys() >= COMPARED else rows
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected what compare --json prints: {error!r}") from None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        remedy = 'give what compare --json prints, or a list like [{"id": "a/audit", "now": 1}]'
        raise InputError(f"{path}: expected a JSON list of objects", remedy=remedy)
    header = list(dict.fromkeys(str(name) for row in rows for name in row))
    made = [
        Row(cells=[_linked(name, row.get(name)) for name in header], state=STATES.get(str(row.get("change")), ""))
        for row in rows
    ]
    return Table(title="What changed", header=header, rows=made)


def _compared(document: Mapping[str, Any]) -> Iterator[dict[str, object]]:
    """A row for each verdict that changed, then for each figure that got worse or better."""
    for one in document["verdicts"]:
        yield {
            ID: one["run"],
            "what": "verdict",
            "before": one["before"],
            "now": one["after"],
            "change": one["change"],
        }
    for one in document["figures"]:
        if one["change"] in SHOWN:
            where = None if one["where"] is None else WorstState(**one["where"])
            yield {
                ID: one["run"],
                "what": one["metric"],
                "before": one["before"],
                "now": one["after"],
                "change": one["change"],
                "allowed": one["allowed"],
                "unit": one["unit"],
                "where": None if where is None else f"{where.time_s:.2f} s, {where}",
            }


def _linked(name: str, value: object) -> object:
    return Cell(text=str(value), link=str(value)) if name == ID and value else value

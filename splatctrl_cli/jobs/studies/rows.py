"""Trials as rows of a table: written, read back to the value, and the verdict that no green one was false."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar, get_args, get_type_hints

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.files.digests import Parts

TRIALS = "trials.csv"
FALSE_GREEN = "false green"
FLAGS = {"True": True, "False": False}


class Row(Protocol):
    """A trial: a frozen dataclass of words, numbers and flags, some of them None where there is no such thing.

    verdict: the house's label, empty without one; is_false_green: judged safe, and something was touched; cause: of
    its failure, empty for a success; true_clearance [m]: the least on the whole way; label: which trial it is; told:
    what came of it, in a few words.
    """

    @property
    def verdict(self) -> str: ...
    @property
    def is_false_green(self) -> bool: ...
    @property
    def success(self) -> bool: ...
    @property
    def cause(self) -> str: ...
    @property
    def true_clearance(self) -> float | None: ...
    @property
    def label(self) -> str: ...
    @property
    def told(self) -> str: ...


R = TypeVar("R", bound=Row)


def verdict_on_trials(trials: Sequence[Row]) -> Verdict:
    """Failed where one that was judged safe touched something: a study may find failures, and no false green."""
    judged = [trial for trial in trials if trial.verdict]
    reasons = [
        Reason(
            criterion=FALSE_GREEN,
            outcome=Outcome.FAILED,
            sentence=f"{trial.label}: judged safe, and there was a {trial.cause}",
            value=trial.true_clearance,
            threshold=0.0,
            unit="m",
            label=FALSE_GREEN,
            count=len(judged),
        )
        for trial in trials
        if trial.is_false_green
    ]
    held = Reason(
        criterion=FALSE_GREEN,
        outcome=Outcome.PASSED,
        sentence="no trial judged safe touched anything",
        count=len(judged),
    )
    return verdict_of("study", reasons or [held], scope=f"{len(trials)} trials, {len(judged)} judged")


def write_trials(path: Path, trials: Sequence[Row], kind: type[Row]) -> None:
    """A row for each trial, all of one kind; lengths in metres, angles in radians, times in seconds."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(_columns(kind))
        for trial in trials:
            values = astuple(trial)  # type: ignore[call-overload]
            writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in values])


def read_trials(path: Path, kind: type[R]) -> list[R]:
    """What `write_trials` wrote. Raises InputError for a file that is not that, or not as it was written."""
    Parts.beside(path).checked(path)
    types = _columns(kind)
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = csv.DictReader(stream)
            if rows.fieldnames != list(types):
                raise ValueError("other columns")
            return [kind(**_values(row, types)) for row in rows]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", remedy="check the path") from None
    except (ValueError, TypeError, KeyError, csv.Error) as error:
        raise InputError(f"{path}: is not a table of trials: {error}", remedy="run its problem again") from None


def _columns(kind: type[Row]) -> dict[str, Any]:
    """Type of each column, by name, in the order of the fields."""
    types = get_type_hints(kind)
    return {column.name: types[column.name] for column in fields(kind)}  # type: ignore[arg-type]


def _values(row: Mapping[str, str | None], types: Mapping[str, Any]) -> dict[str, Any]:
    found = dict[str, Any]()
    for name, text in row.items():
        if text is None:
            raise ValueError(f"a row ends before {name}")
        known = get_args(types[name]) or (types[name],)
        if known[0] is str:
            found[name] = text
        elif text == "" and type(None) in known:
            found[name] = None
        else:
            found[name] = FLAGS[text] if known[0] is bool else known[0](text)
    return found

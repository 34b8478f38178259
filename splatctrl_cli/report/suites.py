"""What CI systems are told of commands: a suite for each recording, a case for each criterion and gate."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any


class Kind(StrEnum):
    """How a case ended; the worst first."""

    FAILED = "failed"
    ERROR = "error"
    NOT_EVALUABLE = "not evaluable"
    SKIPPED = "skipped"
    PASSED = "passed"


WORST_FIRST = tuple(Kind)
WORDS = {
    2: "wrong usage",
    4: "input unusable",
    6: "writing failed",
    70: "internal error",
    130: "interrupted",
}  # by exit code


@dataclass(frozen=True, kw_only=True)
class Case:
    """One criterion or gate. group: recording and command, which with the name tells it from all others; sentence:
    what was found, in one line; text: all of it; seconds: 0 where it has no time of its own.
    """

    name: str
    group: str
    kind: Kind
    sentence: str = ""
    text: str = ""
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Suite:
    """The cases of one recording. path: its file or folder; notes: lines that decide nothing; started: ISO 8601."""

    name: str
    cases: Sequence[Case]
    path: str = ""
    notes: Sequence[str] = ()
    properties: Mapping[str, str] = field(default_factory=dict)
    started: str = ""
    seconds: float = 0.0

    def count(self, *kinds: Kind) -> int:
        """How many cases are of these kinds."""
        return sum(case.kind in kinds for case in self.cases)


def cases_of(verdict: Mapping[str, Any], group: str, *, expected: str = "passed") -> list[Case]:
    """A case for each criterion of a verdict, as `Verdict.as_dict` and the JSON of a command have it.

    expected: the outcome that is right. Where another than "passed" was expected and came, every case passes.
    """
    by_criterion: dict[str, list[Mapping[str, Any]]] = {}
    for reason in verdict["reasons"]:
        by_criterion.setdefault(reason["criterion"], []).append(reason)
    cases = [_case(name, group, reasons) for name, reasons in by_criterion.items()]
    if expected == "passed":
        return cases
    outcome = verdict["outcome"]
    words = f"expected '{expected}', got '{outcome}'"
    kind = Kind.PASSED if outcome == expected else Kind.FAILED
    if kind is Kind.PASSED:
        cases = [replace(case, kind=kind, text=f"{case.kind}, as expected\n{case.text}") for case in cases]
    return [Case(name="outcome", group=group, kind=kind, sentence=words, text=words), *cases]


def error_case(group: str, line: str, *, exit_code: int | None, lines: Sequence[str] = ()) -> Case:
    """The only case of a command that did not come to a verdict, without an exit code where it was killed; `line` is
    what it said, `lines` the end of its log.
    """
    name = "killed" if exit_code is None else WORDS.get(exit_code, "error")
    text = "\n".join([line, *lines, *([] if exit_code is None else [f"exit code: {exit_code}"])])
    return Case(name=name, group=group, kind=Kind.ERROR, sentence=line, text=text)


def skipped_case(group: str, why: str) -> Case:
    """The only case of a command that was not run."""
    return Case(name="skipped", group=group, kind=Kind.SKIPPED, sentence=why, text=why)


def notes_of(verdict: Mapping[str, Any]) -> list[str]:
    """The sentence of a verdict, its notes, and that part of the input was lost."""
    lost = ["part of the input was damaged and is left out (exit code 3)"] if verdict["exit_code"] == 3 else []
    return [verdict["sentence"], *verdict["notes"], *lost]


def worst_first(suites: Iterable[Suite]) -> list[tuple[Suite, Case]]:
    """Every case that is not passed, with its suite: failures, errors, what is not evaluable, what was skipped."""
    found = [(suite, case) for suite in suites for case in suite.cases if case.kind is not Kind.PASSED]
    return sorted(found, key=lambda pair: WORST_FIRST.index(pair[1].kind))


def _case(name: str, group: str, reasons: Sequence[Mapping[str, Any]]) -> Case:
    """The reasons of one criterion, the worst first, as one case."""
    ordered = sorted(reasons, key=lambda reason: WORST_FIRST.index(Kind(reason["outcome"])))
    worst, more = ordered[0], sum(reason["outcome"] != Kind.PASSED for reason in ordered[1:])
    sentence = worst["sentence"] if worst["time_s"] is None else f"{worst['sentence']} at {worst['time_s']:.2f} s"
    return Case(
        name=name,
        group=group,
        kind=Kind(worst["outcome"]),
        sentence=f"{sentence}; and {more} more" if more else sentence,
        text="\n\n".join(map(_told, ordered)),
    )


def _told(reason: Mapping[str, Any]) -> str:
    """All that is known of a reason, a line each."""
    unit = f" {reason['unit']}" if reason["unit"] else ""
    place = reason["place"]
    facts = {
        "value": None if reason["value"] is None else f"{reason['value']:.6g}{unit}",
        "threshold": None if reason["threshold"] is None else f"{reason['threshold']:.6g}{unit}",
        "time": None if reason["time_s"] is None else f"{reason['time_s']:.3f} s",
        "place": None if place is None else f"{', '.join(f'{value:.3f}' for value in place)} m, world",
        "who": reason["who"],
        "what is there": reason["cause"],
        "rests on": reason["count"],
        "remedy": reason["remedy"],
    }
    lines = [f"{name}: {value}" for name, value in facts.items() if value not in (None, "")]
    return "\n".join([f"{reason['outcome']}: {reason['sentence']}", *lines])

"""Reports for CI: JUnit XML (GitLab, Jenkins), and annotations and a table on GitHub.

Recordings are suites; criteria and gates are cases.
"""

import itertools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, TextIO
from xml.etree import ElementTree

from splatctrl_cli.errors import DAMAGE, DAMAGED, UsageError, refuse_if
from splatctrl_cli.files.output import output_path


class Kind(StrEnum):
    """Outcome of a case, worst first."""

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
    """One criterion or gate. group: recording and command; unique with the name.

    sentence: the finding in one line; text: in full; seconds: 0 if not timed.
    """

    name: str
    group: str
    kind: Kind
    sentence: str = ""
    text: str = ""
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A recording's cases. path: file or folder; notes: without effect; started: ISO 8601."""

    name: str
    cases: Sequence[Case]
    path: str = ""
    notes: Sequence[str] = ()
    properties: Mapping[str, str] = field(default_factory=dict)
    started: str = ""
    seconds: float = 0.0

    def count(self, *kinds: Kind) -> int:
        return sum(case.kind in kinds for case in self.cases)


def cases_of(verdict: Mapping[str, Any], group: str, *, expected: str = "passed") -> list[Case]:
    """A case per criterion of a verdict (`Verdict.as_dict`, or a command's JSON).

    expected: outcome; if it is not "passed" and occurs, every case passes.
    """
    reasons = verdict["reasons"]
    names = dict.fromkeys(reason["criterion"] for reason in reasons)
    cases = [_case(name, group, [reason for reason in reasons if reason["criterion"] == name]) for name in names]
    damaged = [damage_case(group)] if verdict.get("is_damaged") else []
    if expected == "passed":
        return [*cases, *damaged]
    outcome = verdict["outcome"]
    words = f"expected '{expected}', got '{outcome}'"
    kind = Kind.PASSED if outcome == expected else Kind.FAILED
    if kind is Kind.PASSED:
        cases = [replace(case, kind=kind, text=f"{case.kind}, as expected\n{case.text}") for case in cases]
    return [Case(name="outcome", group=group, kind=kind, sentence=words, text=words), *cases, *damaged]


def damage_case(group: str) -> Case:
    """The case of a damaged recording, to explain a nonzero exit code."""
    text = f"{DAMAGE} (exit code {DAMAGED}); splatctrl check says which"
    return Case(name="recording", group=group, kind=Kind.ERROR, sentence=text, text=text)


def error_case(group: str, line: str, *, exit_code: int | None, lines: Sequence[str] = ()) -> Case:
    """The only case of a command without verdict; exit_code None if killed.

    line: its message; lines: the end of its log.
    """
    return Case(
        name="killed" if exit_code is None else WORDS.get(exit_code, "error"),
        group=group,
        kind=Kind.ERROR,
        sentence=line,
        text="\n".join([line, *lines, *([] if exit_code is None else [f"exit code: {exit_code}"])]),
    )


def worst_first(suites: Iterable[Suite]) -> list[tuple[Suite, Case]]:
    """Cases not passed, with suites, worst first: failed, error, not evaluable, skipped."""
    cases = [(suite, case) for suite in suites for case in suite.cases if case.kind is not Kind.PASSED]
    return sorted(cases, key=lambda pair: WORST_FIRST.index(pair[1].kind))


def _case(name: str, group: str, reasons: Sequence[Mapping[str, Any]]) -> Case:
    ordered = sorted(reasons, key=lambda reason: WORST_FIRST.index(Kind(reason["outcome"])))
    worst, more = ordered[0], sum(reason["outcome"] != Kind.PASSED for reason in ordered[1:])
    sentence = worst["sentence"] if worst["time_s"] is None else f"{worst['sentence']} at {worst['time_s']:.2f} s"
    return Case(
        name=name,
        group=group,
        kind=Kind(worst["outcome"]),
        sentence=f"{sentence}; and {more} more" if more else sentence,
        text="\n\n".join(map(_explain, ordered)),
    )


def _explain(reason: Mapping[str, Any]) -> str:
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


HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<testsuites name="splatctrl"'
ELEMENTS = {Kind.FAILED: "failure", Kind.ERROR: "error", Kind.NOT_EVALUABLE: "error", Kind.SKIPPED: "skipped"}
_NOT_XML = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_junit(path: Path, suites: Sequence[Suite]) -> None:
    """Write the suites atomically to `path`, replacing a report.

    Raises UsageError if `path` is no report, WriteError on a full disk.
    """
    check_replaceable(path)
    with output_path(path, force=True, is_folder=False) as partial:
        partial.write_text(junit_text(suites), encoding="utf-8")


def check_replaceable(path: Path) -> None:
    """Raise UsageError if `path` is neither ours nor empty."""
    try:
        with path.open("rb") as stream:
            start = stream.read(len(HEAD))
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return  # `output_path` says what is wrong with the others
    except OSError as error:
        raise UsageError(f"{path}: cannot be replaced: {error.strerror}", remedy="give another --junit") from None
    refuse_if(
        start not in (b"", HEAD.encode()),
        f"{path}: exists, and is no JUnit report of splatctrl",
        remedy="give another --junit",
        error=UsageError,
    )


def junit_text(suites: Sequence[Suite]) -> str:
    """The suites as reproducible XML 1.0; characters that XML cannot hold are escaped."""
    root = ElementTree.Element(
        "testsuites",
        {"name": "splatctrl", **_counts(suites), "time": f"{sum(suite.seconds for suite in suites):.3f}"},
    )
    for suite in suites:
        _add_suite(root, suite)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_suite(root: ElementTree.Element, suite: Suite) -> None:
    attributes = {
        "name": _clean(suite.name),
        **_counts([suite]),
        "skipped": str(suite.count(Kind.SKIPPED)),
        "time": f"{suite.seconds:.3f}",
        **({"timestamp": suite.started} if suite.started else {}),
    }
    element = ElementTree.SubElement(root, "testsuite", attributes)
    if suite.properties:
        properties = ElementTree.SubElement(element, "properties")
        for name, value in suite.properties.items():
            ElementTree.SubElement(properties, "property", name=_clean(name), value=_clean(value))
    for case in suite.cases:
        _add_case(element, case)
    if suite.notes:
        ElementTree.SubElement(element, "system-out").text = _clean("\n".join(suite.notes))


def _add_case(suite: ElementTree.Element, case: Case) -> None:
    element = ElementTree.SubElement(
        suite,
        "testcase",
        {"classname": _clean(case.group), "name": _clean(case.name), "time": f"{case.seconds:.3f}"},
    )
    if case.kind is Kind.PASSED:
        if case.text:
            ElementTree.SubElement(element, "system-out").text = _clean(case.text)
        return
    ended = {"message": _clean(case.sentence), "type": str(case.kind)}
    ElementTree.SubElement(element, ELEMENTS[case.kind], ended).text = _clean(case.text)


def _counts(suites: Sequence[Suite]) -> dict[str, str]:
    """Count failures and errors. Not evaluable counts as an error: nothing was proven."""
    return {
        "tests": str(sum(len(suite.cases) for suite in suites)),
        "failures": str(sum(suite.count(Kind.FAILED) for suite in suites)),
        "errors": str(sum(suite.count(Kind.ERROR, Kind.NOT_EVALUABLE) for suite in suites)),
    }


def _clean(text: str) -> str:
    return _NOT_XML.sub(lambda match: ascii(match[0])[1:-1], text)


SUMMARY_BYTES = 1 << 20  # of a step, whoever wrote them; GitHub shows none of a larger one
TABLE_HEAD = ["| recording | criterion | outcome | what was found |", "|---|---|---|---|"]
MORE = "\n... and {} more that do not fit here\n"


def tell_github(suites: Sequence[Suite], stream: TextIO, *, is_fatal: bool) -> None:
    """Print annotations, and append a table to the step's summary, in GitHub Actions only.

    is_fatal: if False, annotations are warnings. Raises OSError if the summary cannot be written.
    """
    if os.environ.get("GITHUB_ACTIONS") != "true":
        return
    for line in annotations(suites, is_fatal=is_fatal, environment=os.environ):
        print(line, file=stream, flush=True)
    if file := os.environ.get("GITHUB_STEP_SUMMARY"):
        with Path(file).open("a", encoding="utf-8", errors="backslashreplace") as step:
            written = step.tell()  # by other commands of the step
            step.write(summary(suites, SUMMARY_BYTES - written))


def annotations(suites: Sequence[Suite], *, is_fatal: bool, environment: Mapping[str, str]) -> list[str]:
    """A workflow command for each of the most severe cases."""
    level = "error" if is_fatal else "warning"
    lines = []
    # GitHub shows ten of a level for a step
    for suite, case in [pair for pair in worst_first(suites) if pair[1].kind is not Kind.SKIPPED][:10]:
        file = _repository_path(suite.path, environment)
        properties = {**({"file": file} if file else {}), "title": f"{case.group}: {case.name} ({case.kind})"}
        attributes = ",".join(
            f"{name}={_escape(value).replace(':', '%3A').replace(',', '%2C')}" for name, value in properties.items()
        )
        lines.append(f"::{level} {attributes}::{_escape(case.text)}")
    return lines


def summary(suites: Sequence[Suite], room: int) -> str:
    """Markdown of at most `room` bytes: counts, and cases not passed, worst first."""
    cases = worst_first(suites)
    total = sum(len(suite.cases) for suite in suites)
    of = suites[0].name if len(suites) == 1 else f"{len(suites)} recordings"
    counts = [
        f"{_cell(of)}: {total - len(cases)} of {total} criteria passed",
        *(f"{number} {kind}" for kind in Kind if (number := sum(case.kind is kind for _, case in cases))),
    ]
    head = "\n".join([f"### splatctrl: {', '.join(counts)}", "", *(TABLE_HEAD if cases else [])]) + "\n"
    rows = [
        f"| {' | '.join(map(_cell, (suite.name, case.name, str(case.kind), case.sentence)))} |\n"
        for suite, case in cases
    ]
    left = room - len(head.encode()) - 1
    if sum(len(row.encode()) for row in rows) <= left:
        return head + "".join(rows) + "\n" if left >= 0 else ""
    left -= len(MORE.encode()) + len(str(len(rows)))
    if left < 0:
        return ""
    ends = itertools.accumulate(len(row.encode()) for row in rows)
    shown_rows = [row for row, end in zip(rows, ends, strict=True) if end <= left]
    return head + "".join(shown_rows) + MORE.format(len(rows) - len(shown_rows))


def _cell(text: str) -> str:
    escaped = "".join(f"&#{ord(mark)};" if mark in "&<>|`*_[]\\#~@" else mark for mark in text)
    return " ".join(escaped.split()).encode("utf-8", "backslashreplace").decode()


def _repository_path(path: str, environment: Mapping[str, str]) -> str:
    workspace = environment.get("GITHUB_WORKSPACE", "")
    if not (path and workspace and Path(path).is_file()):
        return ""
    real, root = Path(os.path.realpath(path)), Path(os.path.realpath(workspace))
    return real.relative_to(root).as_posix() if real.is_relative_to(root) else ""


def _escape(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")

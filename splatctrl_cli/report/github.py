"""What GitHub Actions shows of suites: annotations, and the summary of a step."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

from splatctrl_cli.report.suites import Case, Kind, Suite, worst_first

MOST_ANNOTATIONS = 10  # of a level that GitHub shows for a step
SUMMARY_BYTES = 1 << 20  # of a step, whoever wrote them; GitHub shows none of a larger one
HEAD = ["| recording | criterion | outcome | what was found |", "|---|---|---|---|"]
MORE = "\n... and {} more that do not fit here\n"


def tell_github(suites: Sequence[Suite], stream: TextIO, *, is_fatal: bool) -> None:
    """Inside a step of GitHub Actions: annotations to `stream`, which has to be the process's stdout or stderr, and
    the table to the summary of the step. Nothing elsewhere.

    is_fatal: the exit code is not 0; else annotations are warnings. Raises OSError where the summary cannot be
    written.
    """
    if os.environ.get("GITHUB_ACTIONS") != "true":
        return
    for line in annotations(suites, is_fatal=is_fatal, environment=os.environ):
        print(line, file=stream, flush=True)
    if os.environ.get("GITHUB_STEP_SUMMARY"):
        _append(Path(os.environ["GITHUB_STEP_SUMMARY"]), suites)


def annotations(suites: Sequence[Suite], *, is_fatal: bool, environment: Mapping[str, str]) -> list[str]:
    """A workflow command for each of the most severe cases; its file is the recording, where that is in the
    repository.
    """
    level = "error" if is_fatal else "warning"
    lines = []
    for suite, case in [pair for pair in worst_first(suites) if pair[1].kind is not Kind.SKIPPED][:MOST_ANNOTATIONS]:
        file = _in_repository(suite.path, environment)
        properties = {**({"file": file} if file else {}), "title": f"{case.group}: {case.name} ({case.kind})"}
        given = ",".join(f"{name}={_property(value)}" for name, value in properties.items())
        lines.append(f"::{level} {given}::{_escaped(case.text)}")
    return lines


def summary(suites: Sequence[Suite], room: int) -> str:
    """Markdown of at most `room` bytes: how many cases passed, and a row for each that did not, the worst first."""
    cases = worst_first(suites)
    total = sum(len(suite.cases) for suite in suites)
    of = suites[0].name if len(suites) == 1 else f"{len(suites)} recordings"
    counts = [f"{_cell(of)}: {total - len(cases)} of {total} criteria passed"]
    counts += [f"{number} {kind}" for kind in Kind if (number := sum(case.kind is kind for _, case in cases))]
    head = "\n".join([f"### splatctrl: {', '.join(counts)}", "", *(HEAD if cases else [])]) + "\n"
    rows = [_row(suite, case) for suite, case in cases]
    left = room - len(head.encode()) - 1
    if sum(len(row.encode()) for row in rows) <= left:
        return head + "".join(rows) + "\n" if left >= 0 else ""
    left -= len(MORE.encode()) + len(str(len(rows)))
    if left < 0:
        return ""
    kept: list[str] = []
    for row in rows:
        left -= len(row.encode())
        if left < 0:
            break
        kept.append(row)
    return head + "".join(kept) + MORE.format(len(rows) - len(kept))


def _append(path: Path, suites: Sequence[Suite]) -> None:
    """The summary behind what other commands of the step wrote, as far as there is room."""
    written = path.stat().st_size if path.exists() else 0
    text = summary(suites, SUMMARY_BYTES - written)
    with path.open("a", encoding="utf-8", errors="backslashreplace") as stream:
        stream.write(text)


def _row(suite: Suite, case: Case) -> str:
    return f"| {' | '.join(map(_cell, (suite.name, case.name, str(case.kind), case.sentence)))} |\n"


def _cell(text: str) -> str:
    """Text that Markdown and HTML leave as it is, in one line."""
    escaped = "".join(f"&#{ord(mark)};" if mark in "&<>|`*_[]\\#~@" else mark for mark in text)
    return " ".join(escaped.split()).encode("utf-8", "backslashreplace").decode()


def _in_repository(path: str, environment: Mapping[str, str]) -> str:
    """The file relative to the repository's folder; empty where it is a folder or lies elsewhere."""
    workspace = environment.get("GITHUB_WORKSPACE", "")
    if not (path and workspace and Path(path).is_file()):
        return ""
    real, root = Path(os.path.realpath(path)), Path(os.path.realpath(workspace))
    return real.relative_to(root).as_posix() if real.is_relative_to(root) else ""


def _escaped(text: str) -> str:
    """As actions/toolkit writes the message of a workflow command."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _escaped(text).replace(":", "%3A").replace(",", "%2C")

"""Output of subcommands: tables and JSON on stdout, log lines on stderr."""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from splatctrl_cli.cli.options import names_of
from splatctrl_cli.cli.reports import enveloped, reports_of
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import plain
from splatctrl_cli.records import Label

_NUMBER = re.compile(r"^[-+]?[\d.]|^(nan|-)$")


class Console:
    """Output of a command: results to stdout, log lines to stderr unless --quiet, verdicts to CI.

    is_step: a step of another command; CI gets no verdict.
    """

    def __init__(self, args: argparse.Namespace, *, is_step: bool = False) -> None:
        self._args = args
        self.is_json = bool(args.json)
        self.is_quiet = bool(args.quiet)
        self.reports = reports_of(args) if hasattr(args, "junit") and not is_step else None

    def log(self, line: str) -> None:
        if not self.is_quiet:
            print(line, file=sys.stderr, flush=True)

    def result(self, result: Mapping[str, Any], lines: Iterable[str], *, code: int = 0) -> int:
        """Print `result` as JSON with --json, else `lines`; return `code`."""
        if self.is_json:
            text = json.dumps(enveloped(result, code), indent=2, allow_nan=False, default=plain)
            self._args.is_printed = True
            print(text)
        else:
            for line in lines:
                print(line)
        return code

    def concluded(
        self,
        verdict: Verdict,
        result: Mapping[str, Any],
        lines: Iterable[str],
        *,
        code: int | None = None,
        has_findings: bool = False,
    ) -> int:
        """Print a verdict, its reasons and notes, then `result` or `lines`; return the exit code.

        With --json a failure's sentence also goes to stderr. has_findings: `lines` contain the reasons.
        """
        code = verdict.exit_code if code is None else code
        if self.is_json:
            self.result({"verdict": verdict.as_dict(), **result}, (), code=code)
        else:
            print(verdict.sentence)
            for reason in () if has_findings else verdict.decisive[1:10]:  # --json and summary.json have all
                print(f"  {reason.outcome}: {reason}")
            for reason in () if has_findings else verdict.said:
                print(f"  note: {reason}")
            print()
            self.result({}, lines)
        if code and self.is_json:
            gates = [str(reason) for reason in verdict.decisive[1:] if reason.criterion.startswith("--require")]
            print("\n".join(f"splatctrl: {line}" for line in (verdict.sentence, *gates)), file=sys.stderr, flush=True)
        if self.reports is not None:
            self.reports.conclude(verdict.as_dict(), code)
        return code


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Aligned text columns, numbers to the right."""
    return list(long_table(header, lambda: rows))


def long_table(header: Sequence[str], rows: Callable[[], Iterable[Sequence[object]]]) -> Iterator[str]:
    """`table` of rows made twice, first for widths, to bound memory."""
    widths, is_number = [len(name) for name in header], [True] * len(header)
    for row in rows():
        for i, cell in enumerate(map(str, row)):
            widths[i] = max(widths[i], len(cell))
            is_number[i] = is_number[i] and _NUMBER.match(cell) is not None

    def line(row: Sequence[object]) -> str:
        cells = zip(map(str, row), widths, is_number, strict=True)
        return "  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in cells).rstrip()

    yield line(header)
    yield "  ".join("-" * width for width in widths)
    yield from map(line, rows())


def shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def labels_of(text: str) -> frozenset[Label]:
    """Labels in a field: objects and those of ``--include``. Raises UsageError for others."""
    names = () if text.strip() == "none" else names_of(text, ("robot", "human"), "--include")
    return frozenset({Label.OBJECT, *(Label[name.upper()] for name in names)})

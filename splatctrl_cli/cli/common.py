"""What subcommands share: common options, tables and JSON on stdout, log lines on stderr, gates."""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.numbers import MAX_SEED, whole
from splatctrl_cli.cli.parser import COMMANDS
from splatctrl_cli.config import Config, load_config
from splatctrl_cli.evaluate.gates import gate
from splatctrl_cli.evaluate.verdict import Verdict

MAX_REASONS = 10  # printed; --json and summary.json have all
Subparsers = Any  # argparse keeps its subparser type private


def add_named(subparsers: Subparsers, name: str, summary: str = "") -> argparse.ArgumentParser:
    """The parser of a subcommand, or of an action of one with a summary of its own."""
    summary = summary or COMMANDS[name]
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name, help=summary, description=summary[0].upper() + summary[1:] + ".", allow_abbrev=False
    )
    return parser


def add_command(
    subparsers: Subparsers, name: str, run: Callable[[argparse.Namespace], int], *, summary: str = ""
) -> argparse.ArgumentParser:
    """The same, with what runs it and the options that every command has: --json, -v, -q."""
    parser = add_named(subparsers, name, summary)
    parser.set_defaults(run=run)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="say more; show tracebacks")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress, no log lines")
    return parser


def add_output(parser: argparse.ArgumentParser, *, default: str, what: str) -> None:
    """``-o/--out`` and ``--force``."""
    parser.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"{what} (default: {default})")
    parser.add_argument("--force", action="store_true", help="replace the output if it exists")


def add_config(parser: argparse.ArgumentParser) -> None:
    """``--config``, ``--set``, ``--seed``, ``--threads``."""
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="configuration, see docs/config.md")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="one setting (repeatable)"
    )
    parser.add_argument("--seed", type=whole(0, MAX_SEED), default=0, help="seed of everything random (default: 0)")
    add_threads(parser)


def add_threads(parser: argparse.ArgumentParser) -> None:
    """``--threads``."""
    parser.add_argument(
        "--threads",
        type=whole(0, 1024),
        default=0,
        help="threads, at most 16 or one per core (default: one per core)",
    )


def add_gates(parser: argparse.ArgumentParser) -> None:
    """``--require 'metric>=value'``."""
    parser.add_argument(
        "--require",
        action="append",
        default=[],
        type=gate,
        metavar="METRIC>=VALUE",
        help="fail (exit 1) unless it holds",
    )


def configured(args: argparse.Namespace) -> "Config":
    """The configuration that --config and --set give."""
    return load_config(args.config, args.set)


_NUMBER = re.compile(r"^[-+]?[\d.]|^(nan|-)$")


class Console:
    """Results to stdout, as a table or one JSON object; log lines to stderr unless --quiet."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.is_json = bool(args.json)
        self.is_quiet = bool(args.quiet)

    def log(self, line: str) -> None:
        """One progress line on stderr."""
        if not self.is_quiet:
            print(line, file=sys.stderr, flush=True)

    def result(self, result: Mapping[str, Any], lines: Iterable[str]) -> None:
        """The command's result: `result` as JSON with --json, else `lines`."""
        if self.is_json:
            print(json.dumps(result, indent=2, allow_nan=False, default=_plain))
        else:
            for line in lines:
                print(line)

    def concluded(
        self,
        verdict: "Verdict",
        result: Mapping[str, Any],
        lines: Iterable[str],
        code: int,
        *,
        has_findings: bool = False,
    ) -> None:
        """A verdict, its reasons and notes, then `result` or `lines`; the sentence goes to stderr too where `code` is
        not 0. has_findings: the lines say each reason themselves.
        """
        if self.is_json:
            self.result({"exit_code": code, "verdict": verdict.as_dict(), **result}, ())
        else:
            print(verdict.sentence)
            for reason in () if has_findings else verdict.decisive[1:MAX_REASONS]:
                print(f"  {reason.outcome}: {reason}")
            for reason in () if has_findings else verdict.said:
                print(f"  note: {reason}")
            print()
            self.result({}, lines)
        if code:
            gates = [str(reason) for reason in verdict.decisive[1:] if reason.criterion.startswith("--require")]
            print("\n".join(f"splatctrl: {line}" for line in (verdict.sentence, *gates)), file=sys.stderr, flush=True)


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Aligned text columns; numbers to the right, words to the left."""
    return list(long_table(header, lambda: rows))


def long_table(header: Sequence[str], rows: Callable[[], Iterable[Sequence[object]]]) -> Iterator[str]:
    """`table` of rows that are made twice, first for their widths, and never all held."""
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


def _plain(value: object) -> object:
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)

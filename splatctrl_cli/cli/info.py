"""``splatctrl info``: describes any file the tool reads or writes."""

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

from splatctrl_cli.cli.common import Console, Subparsers, add_command, table
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.sources.describe import describe


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "info", run)
    parser.add_argument("path", type=Path, help="file or folder")
    add_source(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    summary = describe(args.path, source_options(args))
    Console(args).result(summary.as_dict(), list(_lines(summary)))
    return 3 if summary.damaged else 0


def _lines(summary: "Summary") -> Iterator[str]:
    yield f"{summary.path}: {summary.kind}"
    yield from _facts(summary.facts, "  ")
    for grid in summary.grids:
        yield ""
        yield from table(grid.header, grid.rows) if grid.rows else [f"no {grid.name}"]
    if summary.missing:
        yield ""
        yield from (f"missing for a reconstruction: {item}" for item in summary.missing)
    yield from (f"note: {note}" for note in summary.notes)


def _facts(facts: Mapping[str, object], indent: str) -> Iterator[str]:
    for key, value in facts.items():
        if isinstance(value, dict):
            yield f"{indent}{key}:"
            yield from _facts(value, indent + "  ")
        elif isinstance(value, list):
            yield f"{indent}{key}: {', '.join(map(_shown, value)) or '-'}"
        else:
            yield f"{indent}{key}: {_shown(value)}"


def _shown(value: object) -> str:
    """A float with up to six decimals, more digits where it is small; a dash for nothing."""
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.6f}".rstrip("0").rstrip(".") if value == 0 or abs(value) >= 1e-3 else f"{value:.6g}"

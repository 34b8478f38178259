"""``splatctrl query``: distances at points."""

import argparse
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.cli.common import Console, remarks, request_of, table
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.jobs.query.query import QueryRequest, query


def run(args: argparse.Namespace, console: Console) -> int:
    """Run `query`; without --out, print answers to stdout and figures to stderr."""
    request = request_of(QueryRequest, args)
    if args.out is not None or console.is_json:
        result = query(request, console)
        return console.show(result, _query_lines(result))
    with tempfile.TemporaryDirectory() as folder:  # a table with a wrong line is refused before anything is printed
        answers = Path(folder) / "answers.csv"
        result = query(replace(request, out=answers), console)
        with answers.open(encoding="utf-8", newline="") as stream:
            shutil.copyfileobj(stream, sys.stdout)
    for line in _query_lines(replace(result, out=None)):
        console.log(line)
    return 0


def _query_lines(result: Result) -> list[str]:
    num = result.metrics["num_points"] or 0
    rate = f"{num / max(result.seconds['answer'], 1e-9):,.0f} points/s"  # of fewer points it says nothing
    return [
        *table(
            (result.document["source"], ""),
            [(name.replace("_", " "), _format_figure(name, v)) for name, v in result.metrics.items()],
        ),
        *(f"note: {note}" for note in result.notes),
        *remarks((rate, num >= 1000), (f"wrote {result.out}", result.out)),
    ]


def _format_figure(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if name.startswith("num_") else f"{value * 1e3:.1f} mm"

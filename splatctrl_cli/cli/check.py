"""``splatctrl check``, ``info``, ``ingest``: faults of a recording, file contents, captures."""

import argparse
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import asdict

from splatctrl_cli.checks.finding import CheckReport
from splatctrl_cli.cli.common import Console, format_cell, locked_joints, request_of, source_options, table
from splatctrl_cli.errors import DAMAGED
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.jobs.check import CheckRequest, check
from splatctrl_cli.jobs.ingest import IngestRequest, IngestResult, ingest
from splatctrl_cli.recording.source import describe

WIDTH = 118  # columns of text


def run(args: argparse.Namespace) -> int:
    result = check(
        request_of(
            CheckRequest,
            args,
            paths=tuple(args.source),
            options=source_options(args),
            num_images=args.quick,
            locked=locked_joints(args),
        )
    )
    report, lines = result.report.as_dict(), _lines(result.report)
    return Console(args).concluded(result.verdict, report, lines, code=result.exit_code, has_findings=True)


def _lines(report: CheckReport) -> Iterator[str]:
    span = f", {report.duration_s:.2f} s" if report.duration_s else ""
    num = f", {report.num_messages} {report.unit}" if report.num_messages else ""
    yield f"{report.path}: {report.kind}{span}{num}"
    for finding in report.sorted_findings:
        yield ""
        at = report.seconds(finding)
        when = "" if at is None else f", at {at:.3f} s"
        yield f"{finding.severity}: {finding.where}{when} [{finding.code}]"
        yield from textwrap.wrap(finding.what, WIDTH, initial_indent="  ", subsequent_indent="  ")
        if finding.remedy:
            yield from textwrap.wrap(f"-> {finding.remedy}", WIDTH, initial_indent="  ", subsequent_indent="     ")
    rates = [rate for rate in report.rates if rate.is_read]
    if rates:
        yield ""
        yield from table(
            ["topic", "messages", "hz", "longest gap s", "delay s"],
            [
                (
                    rate.topic,
                    rate.messages,
                    format_cell(rate.hz, ".2f"),
                    format_cell(rate.longest_s, ".3f"),
                    format_cell(rate.delay_s, ".3f"),
                )
                for rate in rates
            ],
        )
    if len(rates) < len(report.rates):
        yield from () if rates else ("",)
        others = len(report.rates) - len(rates)
        yield f"{others} topic{'' if others == 1 else 's'} that no command reads"
    yield ""
    yield from _needs(report)


def _needs(report: CheckReport) -> Iterator[str]:
    if ready := [command for command in report.lacks if not report.obstacles(command)]:
        yield f"can start: {', '.join(ready)}"
    kept: dict[str, list[str]] = {}
    for command in report.lacks:
        if codes := dict.fromkeys(finding.code for finding in report.blockers(command)):
            kept.setdefault(", ".join(f"[{code}]" for code in codes), []).append(command)
    yield from (f"cannot start, or would be wrong: {', '.join(names)}; see {why}" for why, names in kept.items())
    for command, lack in report.lacks.items():
        yield from textwrap.wrap(f"missing for {command}: {lack}", WIDTH, subsequent_indent="  ") if lack else ()


def run_info(args: argparse.Namespace) -> int:
    return show_described(Console(args), describe(args.path, source_options(args)), is_long=args.verbose > 0)


def show_described(console: Console, summary: Summary, *, is_long: bool = False) -> int:
    """Print facts and tables, and what a reconstruction lacks."""
    code = DAMAGED if summary.damaged else 0
    return console.result(summary.as_dict(), _described(summary, is_long=is_long), code=code)


def _described(summary: Summary, *, is_long: bool) -> Iterator[str]:
    yield f"{summary.path}: {summary.kind}"
    yield from _facts(summary.facts, "  ")
    for grid in summary.grids:
        yield ""
        num = len(grid.unused) if len(grid.unused) > 3 and not is_long else 0  # few are all printed
        rows = [row for row in grid.rows if not num or row[0] not in grid.unused]
        yield from table(grid.header, rows) if rows else () if num else [f"no {grid.name}"]
        yield from [f"and {num} {grid.name} that no command reads; -v prints them"] if num else ()
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
            yield f"{indent}{key}: {', '.join(map(_fact, value)) or '-'}"
        else:
            yield f"{indent}{key}: {_fact(value)}"


def _fact(value: object) -> str:
    """Text of a float with up to six decimals, more if small."""
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.6f}".rstrip("0").rstrip(".") if value == 0 or abs(value) >= 1e-3 else f"{value:.6g}"


def run_ingest(args: argparse.Namespace) -> int:
    console = Console(args)
    return show_ingested(
        console,
        ingest(request_of(IngestRequest, args, paths=tuple(args.source), options=source_options(args)), console),
    )


def show_ingested(console: Console, result: IngestResult) -> int:
    lost = asdict(result.summary.loss)
    lines = [
        *table(["camera", "frames"], sorted(result.summary.num_frames.items())),
        *(f"{name.replace('_', ' ')}: {value}" for name, value in lost.items() if value and name != "notes"),
        *(f"note: {note}" for note in lost["notes"]),
        f"joint states: {result.summary.num_joint_states}",
        f"wrote {result.capture}",
    ]
    return console.result({"capture": str(result.capture), **result.metrics}, lines, code=result.exit_code)

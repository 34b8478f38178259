"""``splatctrl check``, ``info``, ``ingest``: faults of a recording, file contents, captures."""

import argparse
import textwrap
from collections.abc import Iterator, Mapping

from splatctrl_cli.checks.finding import CheckReport
from splatctrl_cli.cli.common import Console, format_cell, remarks, request_of, table
from splatctrl_cli.errors import DAMAGED
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.jobs.check import CheckRequest, IngestRequest, check, ingest
from splatctrl_cli.recording.source import describe
from splatctrl_cli.recording.source_options import SourceOptions

WIDTH = 118  # columns of text


def run(args: argparse.Namespace, console: Console) -> int:
    report, verdict = check(request_of(CheckRequest, args))
    code = 0 if args.fail_on == "never" else verdict.exit_code
    result = JudgedResult(document=report.as_dict(), verdict=verdict)
    return console.show(result, _lines(report), code=code, has_findings=True)


def _lines(report: CheckReport) -> Iterator[str]:
    span = f", {report.duration_s:.2f} s" if report.duration_s else ""
    num = f", {report.num_messages} {report.unit}" if report.num_messages else ""
    yield f"{report.path}: {report.kind}{span}{num}"
    for finding in report.sorted_findings:
        at = report.seconds(finding)
        when = "" if at is None else f", at {at:.3f} s"
        yield from ("", f"{finding.severity}: {finding.where}{when} [{finding.code}]")
        yield from textwrap.wrap(finding.what, WIDTH, initial_indent="  ", subsequent_indent="  ")
        remedy = f"-> {finding.remedy}" if finding.remedy else ""
        yield from textwrap.wrap(remedy, WIDTH, initial_indent="  ", subsequent_indent="     ")
    rates = [rate for rate in report.rates if rate.is_read]
    forms = {"hz": ".2f", "longest_s": ".3f", "delay_s": ".3f"}
    cells = [
        (rate.topic, rate.messages, *(format_cell(getattr(rate, name), form) for name, form in forms.items()))
        for rate in rates
    ]
    others = len(report.rates) - len(rates)
    yield from ("", *table(["topic", "messages", "hz", "longest gap s", "delay s"], cells)) if rates else ()
    unread = f"{others} topic{'' if others == 1 else 's'} that no command reads"
    yield from remarks(("", others and not rates), (unread, others))
    yield from ("", *_needs(report))


def _needs(report: CheckReport) -> Iterator[str]:
    if ready := [command for command in report.lacks if not report.obstacles(command)]:
        yield f"can start: {', '.join(ready)}"
    needs: dict[str, list[str]] = {}
    for command in report.lacks:
        if codes := dict.fromkeys(finding.code for finding in report.blockers(command)):
            needs.setdefault(", ".join(f"[{code}]" for code in codes), []).append(command)
    yield from (f"cannot start, or would be wrong: {', '.join(names)}; see {why}" for why, names in needs.items())
    for command, lack in report.lacks.items():
        yield from textwrap.wrap(f"missing for {command}: {lack}", WIDTH, subsequent_indent="  ") if lack else ()


def run_info(args: argparse.Namespace, console: Console) -> int:
    """Print facts and tables, and what a reconstruction lacks."""
    summary = describe(args.path, request_of(SourceOptions, args))
    lines = _describe(summary, is_long=args.verbose > 0)
    return console.result(summary.as_dict(), lines, code=DAMAGED if summary.damaged else 0)


def _describe(summary: Summary, *, is_long: bool) -> Iterator[str]:
    yield f"{summary.path}: {summary.kind}"
    yield from _facts(summary.facts, "  ")
    for grid in summary.grids:
        yield ""
        num = len(grid.unused) if len(grid.unused) > 3 and not is_long else 0  # few are all printed
        rows = [row for row in grid.rows if not num or row[0] not in grid.unused]
        yield from table(grid.header, rows) if rows else () if num else [f"no {grid.name}"]
        yield from [f"and {num} {grid.name} that no command reads; -v prints them"] if num else ()
    yield from ("", *(f"missing for a reconstruction: {item}" for item in summary.missing)) if summary.missing else ()
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
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.6f}".rstrip("0").rstrip(".") if value == 0 or abs(value) >= 1e-3 else f"{value:.6g}"


def run_ingest(args: argparse.Namespace, console: Console) -> int:
    result = ingest(request_of(IngestRequest, args), console)
    metrics, lost = result.metrics, result.metrics["loss"]
    lines = [
        *table(["camera", "frames"], sorted(metrics["frames"].items())),
        *(f"{name.replace('_', ' ')}: {value}" for name, value in lost.items() if value and name != "notes"),
        *(f"note: {note}" for note in lost["notes"]),
        f"joint states: {metrics['joint_states']}",
        f"wrote {result.out}",
    ]
    return console.show(result, lines, code=DAMAGED if lost["damaged"] else 0)

"""``splatctrl compare``, ``sweep``, ``report``, ``view``: regressions, distance from another verdict, HTML pages."""

import argparse
import os
import sys
import webbrowser
from collections.abc import Iterator
from pathlib import Path

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.common import Console, format_cell, request_of, table
from splatctrl_cli.jobs.compare.compare import Change, CompareRequest, CompareResult, FigureChange, compare
from splatctrl_cli.jobs.report.report import ViewRequest, WriteReportRequest, view, write_report
from splatctrl_cli.jobs.sweep.sweep import KeyFlip, SweepRequest, SweepResult, Tried, sweep

FORM = ".6g"


def run_compare(args: argparse.Namespace) -> int:
    console = Console(args)
    result = compare(request_of(CompareRequest, args, runs=tuple(args.output)), console)
    return console.concluded(result.verdict, result.as_dict(), _compare_lines(result, is_long=args.verbose > 0))


def _compare_lines(result: CompareResult, *, is_long: bool) -> Iterator[str]:
    kinds = (Change.WORSE, Change.BETTER, *((Change.OTHER,) if is_long else ()))
    rows = [_change_row(one) for one in result.figures if one.change in kinds]
    num = len(rows) if is_long else max(20, result.metrics["num_worse"])  # --json has all
    if rows:
        yield from table(("figure", "run", "before", "after", "allowed", "unit", "", "where"), rows[:num])
        yield from [f"and {len(rows) - num} more; -v prints all"] if len(rows) > num else []
    else:
        yield "no figure changed by more than its tolerance"
    if result.jobs:
        yield ""
        changed = [one for one in result.jobs if is_long or one.change is not Change.SAME]
        yield f"{len(result.jobs)} figures over recordings, {len(changed)} changed: mean change for the worse"
        cells = [
            (
                one.metric,
                one.job,
                one.harm.num_pairs,
                *(format_cell(value, FORM) for value in (one.harm.mean, one.harm.low, one.harm.high)),
            )
            for one in changed
        ]
        yield from table(("figure", "job", "recordings", "mean", "low", "high"), cells) if cells else ()
    if result.differences:
        yield ""
        yield from table(("not alike", "before", "after"), [(name, *v) for name, v in result.differences.items()])
    if result.baseline is not None:
        yield f"wrote {result.baseline}"


def _change_row(one: FigureChange) -> tuple[object, ...]:
    where = "" if one.where is None else f"{one.where.time_s:.2f} s, {one.where}"
    values = (format_cell(value, FORM) for value in (one.before, one.after, one.allowed))
    return one.metric, one.run, *values, one.unit, one.change, where


def run_sweep(args: argparse.Namespace) -> int:
    console, workers = Console(args), args.workers or os.cpu_count() or 1
    request = request_of(SweepRequest, args, out=args.out or Path("sweep"), workers=workers)
    result = sweep(request, OfThisProgram(threads=max((os.cpu_count() or 1) // workers, 1)), console)
    return console.result(
        {"out": str(result.out), **result.as_dict()}, _sweep_lines(result, is_long=args.verbose > 0)
    )


def _sweep_lines(result: SweepResult, *, is_long: bool) -> Iterator[str]:
    yield str(result.before["sentence"])
    yield ""
    header = ("key", "from", "to", "unit", "verdict until", "", "verdict from", "", "tried")
    yield from table(header, [_flip_row(flip) for flip in result.flips])
    yield ""
    for flip in result.flips:
        yield flip.sentence
        if flip.first is not None:
            yield f"  at {flip.first.values[flip.key.name]:.6g}: {flip.first.sentence}"
        if not flip.is_monotone:
            yield "  the verdict turns back: the flip nearest to the start is reported"
        if flip.spacing:
            which = "values tried" if flip.first is None else "values tried before it"
            yield f"  {which} are up to {flip.spacing:.4g} apart: a narrower flip is not excluded"
    if len(result.flips) > 1:
        yield ""
        yield from _least(result)
    if is_long:
        yield ""
        for flip in result.flips:
            rows = [(f"{each.values[flip.key.name]:.6g}", each.label.upper(), each.folder) for each in flip.tried]
            yield from table((flip.key.name, "verdict", "folder"), rows)
    yield ""
    yield f"{result.num_runs} runs, {result.num_new} of them new; wrote {result.out / 'sweep.json'}"


def _flip_row(flip: KeyFlip) -> tuple[object, ...]:
    name = flip.key.name
    ends = (f"{flip.start.values[name]:g}", f"{flip.end.values[name]:g}", flip.key.unit or "-")
    return name, *ends, *_side(flip.last, name), *_side(flip.first, name), len(flip.tried)


def _side(tried: Tried | None, name: str) -> tuple[str, str]:
    return ("-", "no flip") if tried is None else (f"{tried.values[name]:.6g}", tried.label.upper())


def _least(result: SweepResult) -> Iterator[str]:
    if result.least is None:
        yield "all together: no flip in any direction tried"
        return
    first = result.least.first
    values = ", ".join(f"{name}={value:.6g}" for name, value in first.values.items())
    yield f"least change of all together: {values}: {first.label.upper()}, {result.least.length:.3f} of the ranges"
    yield f"  {first.sentence}"


SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")  # one of which is set on Linux where a browser can open a window
MOST_NOTES = 5


def run_report(args: argparse.Namespace) -> int:
    console = Console(args)
    result = write_report(request_of(WriteReportRequest, args, roots=tuple(args.root)), console)
    lines = [f"{result.file}: {result.num_runs} runs, {result.num_scenes} in 3-D, {result.bytes} bytes"]
    lines += result.notes[:MOST_NOTES]
    more = len(result.notes) - MOST_NOTES
    return console.result(result.as_dict(), [*lines, *([f"and {more} more not in 3-D"] if more > 0 else [])])


def run_view(args: argparse.Namespace) -> int:
    console = Console(args)
    result = view(request_of(ViewRequest, args, roots=tuple(args.root)))
    found = f"{result.num_splats} splats, {result.num_states} states, {result.num_unknown} cubes never seen"
    is_opened = not args.no_open and opened(result.file)
    console.result({**result.as_dict(), "is_opened": is_opened}, [f"{result.file}: {found}, {result.bytes} bytes"])
    if not is_opened and not args.no_open:
        console.log(f"no browser here: open {result.file.absolute()}")
    return 0


def opened(page: Path) -> bool:
    """Open a page in a browser window; False without one."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SCREENS):
        return False
    return webbrowser.open(page.absolute().as_uri())

"""``splatctrl compare``: regressions between runs."""

import argparse
from collections.abc import Iterator

from splatctrl_cli.cli.common import Console, format_cell, remarks, request_of, table
from splatctrl_cli.jobs.compare.compare import Change, CompareRequest, CompareResult, FigureChange, compare

FORM = ".6g"


def run(args: argparse.Namespace, console: Console) -> int:
    result = compare(request_of(CompareRequest, args), console)
    return console.show(result, _lines(result, is_long=args.verbose > 0))


def _lines(result: CompareResult, *, is_long: bool) -> Iterator[str]:
    kinds = (Change.WORSE, Change.BETTER, *((Change.OTHER,) if is_long else ()))
    rows = [_change_row(one) for one in result.figures if one.change in kinds]
    num = len(rows) if is_long else max(20, result.metrics["num_worse"])  # --json has all
    titles = ("figure", "run", "before", "after", "allowed", "unit", "", "where")
    yield from table(titles, rows[:num]) if rows else ["no figure changed by more than its tolerance"]
    yield from remarks((f"and {len(rows) - num} more; -v prints all", len(rows) > num))
    changed = [one for one in result.jobs if is_long or one.change is not Change.SAME]
    cells = [
        (
            one.metric,
            one.job,
            one.harm.num_pairs,
            *(format_cell(value, FORM) for value in (one.harm.mean, one.harm.low, one.harm.high)),
        )
        for one in changed
    ]
    over = f"{len(result.jobs)} figures over recordings, {len(changed)} changed: mean change for the worse"
    yield from remarks(("", result.jobs), (over, result.jobs))
    yield from table(("figure", "job", "recordings", "mean", "low", "high"), cells) if cells else ()
    unlike = table(("not alike", "before", "after"), [(name, *v) for name, v in result.differences.items()])
    yield from ("", *unlike) if result.differences else ()
    yield from remarks((f"wrote {result.baseline}", result.baseline))


def _change_row(one: FigureChange) -> tuple[object, ...]:
    where = "" if one.where is None else f"{one.where.time_s:.2f} s, {one.where}"
    values = (format_cell(value, FORM) for value in (one.before, one.after, one.allowed))
    return one.metric, one.run, *values, one.unit, one.change, where

"""``splatctrl sweep``: how far a replay is from another verdict."""

import argparse
import os
from collections.abc import Iterator

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.common import Console, remarks, request_of, table
from splatctrl_cli.jobs.sweep.sweep import KeyFlip, SweepRequest, SweepResult, Tried, sweep


def run(args: argparse.Namespace, console: Console) -> int:
    workers = args.workers or os.cpu_count() or 1
    result = sweep(
        request_of(SweepRequest, args, workers=workers),
        OfThisProgram(threads=max((os.cpu_count() or 1) // workers, 1)),
        console,
    )
    return console.result({"out": str(result.out), **result.as_dict()}, _lines(result, is_long=args.verbose > 0))


def _lines(result: SweepResult, *, is_long: bool) -> Iterator[str]:
    titles = ("key", "from", "to", "unit", "verdict until", "", "verdict from", "", "tried")
    yield from (str(result.before["sentence"]), "", *table(titles, [_flip_row(flip) for flip in result.flips]), "")
    for flip in result.flips:
        first = flip.first
        which = "values tried" if first is None else "values tried before it"
        yield flip.sentence
        yield from () if first is None else [f"  at {first.values[flip.key.name]:.6g}: {first.sentence}"]
        yield from remarks(
            ("  the verdict turns back: the flip nearest to the start is reported", not flip.is_monotone),
            (f"  {which} are up to {flip.spacing:.4g} apart: a narrower flip is not excluded", flip.spacing),
        )
    yield from ("", *_least(result)) if len(result.flips) > 1 else ()
    yield from [""] * is_long
    for flip in result.flips if is_long else ():
        tried = [(f"{each.values[flip.key.name]:.6g}", each.label.upper(), each.folder) for each in flip.tried]
        yield from table((flip.key.name, "verdict", "folder"), tried)
    yield from ("", f"{result.num_runs} runs, {result.num_new} of them new; wrote {result.out / 'sweep.json'}")


def _flip_row(flip: KeyFlip) -> tuple[object, ...]:
    name = flip.key.name
    ends = (f"{flip.start.values[name]:g}", f"{flip.end.values[name]:g}", flip.key.unit or "-")
    return name, *ends, *_side(flip.last, name), *_side(flip.first, name), len(flip.tried)


def _side(tried: Tried | None, name: str) -> tuple[str, str]:
    return ("-", "no flip") if tried is None else (f"{tried.values[name]:.6g}", tried.label.upper())


def _least(result: SweepResult) -> list[str]:
    if result.least is None:
        return ["all together: no flip in any direction tried"]
    first = result.least.first
    values = ", ".join(f"{name}={value:.6g}" for name, value in first.values.items())
    summary = (
        f"least change of all together: {values}: {first.label.upper()}, {result.least.length:.3f} of the ranges"
    )
    return [summary, f"  {first.sentence}"]

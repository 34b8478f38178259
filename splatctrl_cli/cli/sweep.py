"""``splatctrl sweep``: distance of a replay from another verdict."""

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.common import Console, request_of, table
from splatctrl_cli.jobs.sweep.sweep import KeyFlip, SweepRequest, SweepResult, Tried, sweep


def run(args: argparse.Namespace) -> int:
    console, workers = Console(args), args.workers or os.cpu_count() or 1
    result = sweep(
        request_of(SweepRequest, args, out=args.out or Path("sweep"), workers=workers),
        OfThisProgram(threads=max((os.cpu_count() or 1) // workers, 1)),
        console,
    )
    return console.result({"out": str(result.out), **result.as_dict()}, _lines(result, is_long=args.verbose > 0))


def _lines(result: SweepResult, *, is_long: bool) -> Iterator[str]:
    yield str(result.before["sentence"])
    yield ""
    yield from table(
        ("key", "from", "to", "unit", "verdict until", "", "verdict from", "", "tried"),
        [_flip_row(flip) for flip in result.flips],
    )
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
            yield from table(
                (flip.key.name, "verdict", "folder"),
                [(f"{each.values[flip.key.name]:.6g}", each.label.upper(), each.folder) for each in flip.tried],
            )
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

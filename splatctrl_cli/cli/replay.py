"""``splatctrl replay``: clearance of motion, and what a controller would do."""

import argparse
from collections.abc import Iterator, Sequence
from functools import partial

from splatctrl_cli.cli.common import (
    Console,
    format_cell,
    long_table,
    remarks,
    request_of,
    table,
)
from splatctrl_cli.jobs.replay.files import chunks_of, when_and_why
from splatctrl_cli.jobs.replay.replay import ReplayResult, replay
from splatctrl_cli.jobs.replay.request import Replay, ReplayRequest

HEADLINE = (
    *("min_clearance", "min_clearance_certified", "min_clearance_true", "min_self_clearance", "min_limit_margin"),
    *("max_velocity_share", "unknown_share", "max_map_age_s", "map_error_bound", "goal_reached", "duration_s"),
)


def run(args: argparse.Namespace, console: Console) -> int:
    result = replay(request_of(ReplayRequest, args), console)
    return console.show(
        result,
        _lines(result, is_long=args.verbose > 0, with_steps=args.steps),
        code=result.exit_code(report_only=args.report_only),
    )


def _lines(result: ReplayResult, *, is_long: bool, with_steps: bool) -> Iterator[str]:
    replay, metrics = result.replay, result.metrics
    shown = metrics if is_long else {name: metrics[name] for name in HEADLINE if metrics.get(name) is not None}
    yield from (
        *when_and_why(replay),
        "",
        *table(("replay", "value"), [(name, format_cell(value)) for name, value in shown.items()]),
        *result.notes,
        *remarks((f"wrote {result.out}; -v prints every figure", not is_long), ("", with_steps)),
    )
    if with_steps:
        names = [n for n in next(chunks_of(replay)) if not n.startswith(("stamp_ns", "q_", "v_", "dv_"))]
        yield from long_table(names, partial(_step_rows, replay, names))


def _step_rows(replay: Replay, names: Sequence[str]) -> Iterator[list[str]]:
    for chunk in chunks_of(replay):
        columns = (chunk[name] for name in names)
        yield from ([format_cell(value) for value in row] for row in zip(*columns, strict=True))

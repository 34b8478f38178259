"""``splatctrl replay``: clearance of motion, and what a controller would do."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from splatctrl_cli.cli.common import (
    Console,
    format_cell,
    locked_joints,
    long_table,
    request_of,
    source_options,
    table,
)
from splatctrl_cli.config import load_config
from splatctrl_cli.jobs.replay.files import Columns, chunks_of, when_and_why
from splatctrl_cli.jobs.replay.replay import ReplayResult, replay
from splatctrl_cli.jobs.replay.request import Replay, ReplayRequest

HEADLINE = (
    *("min_clearance", "min_clearance_certified", "min_clearance_true", "min_self_clearance", "min_limit_margin"),
    *("max_velocity_share", "unknown_share", "max_map_age_s", "map_error_bound", "goal_reached", "duration_s"),
)


def run(args: argparse.Namespace) -> int:
    console = Console(args)
    result = replay(
        request_of(
            ReplayRequest,
            args,
            out=args.out or Path("replay"),
            config=load_config(args.config, args.set),
            options=source_options(args),
            locked=locked_joints(args),
        ),
        console,
    )
    return show_replayed(
        console,
        result,
        code=result.exit_code(report_only=args.report_only),
        is_long=args.verbose > 0,
        with_steps=args.steps,
    )


def show_replayed(
    console: Console, result: ReplayResult, *, code: int, is_long: bool = False, with_steps: bool = False
) -> int:
    lines = _lines(result, is_long=is_long, with_steps=with_steps)
    return console.concluded(result.verdict, {"out": str(result.out), **result.metrics}, lines, code=code)


def _lines(result: ReplayResult, *, is_long: bool, with_steps: bool) -> Iterator[str]:
    replay, metrics = result.replay, result.metrics
    shown = metrics if is_long else {name: metrics[name] for name in HEADLINE if metrics.get(name) is not None}
    yield from when_and_why(replay)
    yield ""
    yield from table(("replay", "value"), [(name, format_cell(value)) for name, value in shown.items()])
    yield from result.notes
    if not is_long:
        yield f"wrote {result.out}; -v prints every figure"
    if with_steps:
        yield ""
        yield from _step_lines(replay)


def _step_lines(replay: Replay) -> Iterator[str]:
    def shown(columns: Columns) -> Columns:
        hidden = ("stamp_ns", "q_", "v_", "dv_")
        return {name: values for name, values in columns.items() if not name.startswith(hidden)}

    def rows() -> Iterator[list[str]]:
        for chunk in chunks_of(replay):
            yield from ([format_cell(value) for value in row] for row in zip(*shown(chunk).values(), strict=True))

    return long_table([*shown(next(chunks_of(replay)))], rows)

"""Run the hunt: ``python -m tools.hunt --runs 2000 --seed 0``. The same seed gives the same runs."""

import argparse
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tools.hunt.table import append_rows, border_of, read_rows, report
from tools.hunt.trial import Row, family_of, run

TABLE = Path(__file__).parent / "campaigns.csv"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, and print the table; 1 where something observable in contact, or a crash, was called safe."""
    args = _parser().parse_args(arguments)
    known = {(row.seed, row.index): row for row in read_rows(args.table)}
    if args.only:
        wanted = args.only
    else:
        done = [index for seed, index in known if seed == args.seed]
        first = max(done, default=-1) + 1 if args.goes_on else args.first
        wanted = [(args.seed, index) for index in range(first, first + args.runs)]
    if args.border:
        print("\n".join(f"{row.name}  {row.family}, {row.kind}" for row in border_of(list(known.values()))))
        return 0
    rows: list[Row] = []
    try:
        for row in _rows(wanted, args.jobs):
            rows.append(row)
            print(_line(row), file=sys.stderr, flush=True)
            if args.goes_on:
                append_rows(args.table, [row])
    except KeyboardInterrupt:
        print(f"interrupted after {len(rows)} runs", file=sys.stderr)
    counted = [row for row in known.values() if row.seed == args.seed] + rows if args.goes_on else rows
    print("\n".join(report(counted)))
    return int(any(row.outcome == "crash" or _is_grave(row) for row in rows))


def _rows(wanted: Sequence[tuple[int, int]], jobs: int) -> Iterator[Row]:
    """The runs in their order, whichever process ends first."""
    if jobs == 1:
        yield from (_caught(seed, index) for seed, index in wanted)
        return
    with ProcessPoolExecutor(jobs) as pool:
        try:
            yield from pool.map(_caught, *zip(*wanted, strict=True))
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise


def _caught(seed: int, index: int) -> Row:
    """The run's row; one of outcome `crash` where the tool raised what it must not."""
    try:
        return run(seed, index)
    except Exception as error:  # whatever it is, it is a finding, and the hunt goes on
        traceback.print_exc()
        return Row(
            seed=seed, index=index, family=family_of(index), kind="", strength=0.0, mode="", outcome="crash",
            clearance=0.0, observable=True, rule="", reason=f"{type(error).__name__}: {error}"[:90],
        )  # fmt: skip


def _is_grave(row: Row) -> bool:
    return row.is_false_green and row.observable and row.clearance < 0


def _line(row: Row) -> str:
    mark = "  FALSE GREEN" if row.is_false_green else ""
    return (
        f"{row.name} {row.family} ({row.kind}, {row.strength:.3g}) {row.mode}: {row.outcome} ({row.reason}); "
        f"true {1e3 * row.clearance:.1f} mm, {'' if row.observable else 'not '}observable ({row.rule}){mark}"
    )


def _run_name(text: str) -> tuple[int, int]:
    seed, _, index = text.partition("/")
    return int(seed), int(index)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.hunt", description=__doc__, allow_abbrev=False)
    parser.add_argument("--runs", type=int, default=100, metavar="N", help="how many (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the campaign (default: 0)")
    parser.add_argument("--first", type=int, default=0, metavar="INDEX", help="the first run (default: 0)")
    parser.add_argument("--only", type=_run_name, nargs="+", metavar="SEED/INDEX", help="these runs alone")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes")
    parser.add_argument(
        "--continue", dest="goes_on", action="store_true", help="go on where the table ends, and add to it"
    )
    parser.add_argument(
        "--border", action="store_true", help="print the runs of the table for tests/tools/border.txt"
    )
    parser.add_argument("--table", type=Path, default=TABLE, metavar="FILE.csv", help=f"(default: {TABLE.name})")
    return parser


if __name__ == "__main__":
    sys.exit(main())

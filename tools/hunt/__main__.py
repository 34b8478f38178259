"""Run the hunt: ``python -m tools.hunt --runs 2000 --seed 0``. The same seed gives the same runs.

The runs are a batch. Finished runs in a folder are repeated only if the code or the hunt has changed.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from splatctrl_cli.jobs.batch.graph import Node
from splatctrl_cli.jobs.batch.ledger import Ledger, Run
from splatctrl_cli.jobs.batch.run import DONE, FAILED, Scheduler, local_executor
from splatctrl_cli.jobs.batch.suite import Job
from tools.hunt.table import border_of, merge_rows, read_rows, report
from tools.hunt.trial import Row, family_of, run

HERE = Path(__file__).parent
TABLE, ENTRY = HERE / "campaigns.csv", "tools.hunt.__main__:one"


class Lines:
    """Prints on stderr."""

    is_quiet = False

    def log(self, line: str) -> None:
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, and print the table; return 1 for an observable false green or a crash."""
    args = _parser().parse_args(arguments)
    if args.border:
        print("\n".join(f"{row.name}  {row.family}, {row.kind}" for row in border_of(read_rows(TABLE))))
        return 0
    wanted = args.only or [(args.seed, index) for index in range(args.first, args.first + args.runs)]
    nodes = [_node(seed, index, args.device) for seed, index in wanted]
    with Ledger(args.out) as ledger, local_executor(args.jobs) as executor:
        places = {"executor": executor, "slots": args.jobs}
        runs = Scheduler(ledger=ledger, entry=ENTRY, progress=Lines(), **places).run(nodes)
    rows = [_row(args.out, run) for run in runs.values()]
    if args.table is not None:
        merge_rows(args.table, rows)
    print("\n".join(report(rows)))
    return int(any(row.outcome == "crash" or _is_grave(row) for row in rows))


def one(words: list[str]) -> int:
    """Run one node: the run and device that `words` name; print its row and line."""
    row = run(*_run_name(words[0]), device=words[1])
    label = (
        ("false green" if row.observable else "false green, not observable") if row.is_false_green else row.outcome
    )
    outcome = "failed" if row.is_false_green and row.observable else "passed"
    verdict = {"outcome": outcome, "label": label, "sentence": _line(row)}
    print(json.dumps({"verdict": verdict, "row": asdict(row)}))
    return 0


def preload() -> None:
    """Make one run per runner, so that later runs reuse the arm's coverage."""
    run(0, 0)


def _node(seed: int, index: int, device: str) -> Node:
    name = f"{seed}/{index}"
    return Node(
        name=name, recording=str(seed), job=Job(name=str(index), command="hunt"), words=(name, device), inputs=_code()
    )


def _code() -> tuple[Path, ...]:
    return tuple(sorted(HERE.glob("*.py")))


def _row(out: Path, run: Run) -> Row:
    """The row of a run; its outcome is `crash` if the tool raised an unexpected error."""
    if run.state in (DONE, FAILED):
        return Row(**json.loads((out / run.result).read_text(encoding="utf-8"))["row"])
    seed, index = _run_name(run.node)
    return Row(
        seed=seed, index=index, family=family_of(seed, index), kind="", strength=0.0, mode="", outcome="crash",
        clearance=0.0, observable=True, rule="", reason=(run.cause or run.sentence)[:90],
    )  # fmt: skip


def _is_grave(row: Row) -> bool:
    return row.is_false_green and row.observable and row.clearance < 0


def _line(row: Row) -> str:
    return (
        f"{row.family} ({row.kind}, {row.strength:.3g}) {row.mode}: {row.outcome} ({row.reason}); "
        f"true {1e3 * row.clearance:.1f} mm, {'' if row.observable else 'not '}observable ({row.rule})"
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
    parser.add_argument("--device", default="cpu", metavar="NAME", help="of the fits: cpu (default), cuda or cuda:N")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes")
    parser.add_argument(
        "--border", action="store_true", help=f"print runs of {TABLE.name} for tests/tools/border.txt"
    )
    parser.add_argument("--table", type=Path, metavar="FILE.csv", help="put the runs into it, for those of before")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("hunt.out"),
        metavar="DIR",
        help="the batch's folder (default: hunt.out)",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())

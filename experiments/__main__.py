"""Repeat an experiment of the paper: ``python -m experiments table2 --trials 20 -o out/table2``."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments import baselines, fits, record
from experiments.problem_run import TRIALS, run_problem
from experiments.problems import ProblemRequest
from experiments.registry import STUDIES
from experiments.study import StudyRequest, merged_study, run_study
from experiments.tables import aligned
from splatctrl_cli import SplatCtrlError, Verdict

ABOUT = {
    "table2": "plan in reconstructed scenes",
    "scenes": "pick and place in twelve scenes",
    "shared-workspace": "share a table with a person's arm",
    "dtu": "fit DTU scans, beside 3D Gaussian splatting",
    "ablation": "leave out one mechanism of ours at a time",
}


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A subcommand: its description, its options, and the function that runs it and returns the exit code."""

    about: str
    add_options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def main(words: Sequence[str] | None = None) -> int:
    """Run one experiment; an error is one line on stderr."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    parsers = parser.add_subparsers(dest="experiment", required=True, metavar="EXPERIMENT")
    for name, experiment in EXPERIMENTS.items():
        experiment.add_options(parsers.add_parser(name, help=experiment.about))
    args = parser.parse_args(words)
    try:
        return EXPERIMENTS[args.experiment].run(args)
    except SplatCtrlError as error:
        print(f"experiments: {error}", file=sys.stderr)
        return error.exit_code


def add_study_options(parser: argparse.ArgumentParser) -> None:
    """Add what every study takes."""
    add = parser.add_argument
    add("-o", "--out", type=Path, help="folder of the study, in which it goes on (default: its name)")
    add("--trials", type=_count, help="problems of each kind (default: as many as the paper's)")
    add("--methods", type=_names, default=(), help="some of the study's: A,B (default: all that are installed)")
    add("--problems", type=Path, help="folder of MotionBenchMaker's problems (table2), or of DTU scans (dtu)")
    add("--width", type=_count, help="width of the images [px]")
    add("--workers", type=_count, default=os.cpu_count() or 1, help="problems that run at once")
    add("--shard", type=_shard, default=(1, 1), help="I/N: only every N-th problem, from the I-th on")
    add("--made", type=Path, action="append", default=[], help="merge these trials instead of running any")
    add("--problem", help="run one problem alone, such as cubby-0007")


def run(args: argparse.Namespace) -> int:
    """Run a study, merge a study's tables, or run one of its problems."""
    if args.problem is not None:
        return _run_one(args)
    request = StudyRequest(
        study=args.experiment,
        out=args.out or Path(args.experiment),
        trials=args.trials,
        problems=args.problems,
        methods=args.methods,
        width=args.width,
        workers=args.workers,
        shard=args.shard,
        made=tuple(args.made),
    )
    result = merged_study(request) if request.made else run_study(request)
    for title, header, rows in result.sections:
        print(title, *aligned(header, rows), "", sep="\n")
    print(*result.notes, sep="\n")
    if not result.missing:
        print(f"{result.num_kept} problems as before; every trial is in {result.out / TRIALS}")
    return _concluded(result.verdict)


def _run_one(args: argparse.Namespace) -> int:
    study = STUDIES[args.experiment]
    request = ProblemRequest(
        study=args.experiment,
        problem=args.problem,
        out=args.out or Path(args.problem),
        problems=study.archive(args.problems),
        methods=study.methods_of(args.methods),
        width=args.width or study.width,
    )
    result = run_problem(study, request)
    print(*(trial.told for trial in result.trials), f"every figure is in {result.out / TRIALS}", sep="\n")
    return _concluded(result.verdict)


def _concluded(verdict: Verdict) -> int:
    print(verdict.sentence)
    return verdict.exit_code


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text}")
    return int(text)


def _shard(text: str) -> tuple[int, int]:
    first, _, num = text.partition("/")
    if not (first.isdecimal() and num.isdecimal() and 1 <= int(first) <= int(num)):
        raise argparse.ArgumentTypeError(f"expected I/N with I from 1 to N, got {text}")
    return int(first), int(num)


EXPERIMENTS = {
    **{name: Experiment(about=about, add_options=add_study_options, run=run) for name, about in ABOUT.items()},
    "baselines": Experiment(
        about="compare with a planner and a standstill", add_options=baselines.add_options, run=baselines.run
    ),
    "fits": Experiment(about="fit scans by both methods", add_options=fits.add_options, run=fits.run),
    "record": Experiment(about="record a drawn scene", add_options=record.add_options, run=record.run),
}

if __name__ == "__main__":
    sys.exit(main())

"""``splatctrl study``: an experiment of the paper, as a batch of problems and one table."""

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.common import Console, table
from splatctrl_cli.cli.options import request_of
from splatctrl_cli.jobs.studies.experiments import STUDIES
from splatctrl_cli.jobs.studies.problem_run import TRIALS, run_problem
from splatctrl_cli.jobs.studies.problems import ProblemRequest
from splatctrl_cli.jobs.studies.study import StudyRequest, StudyResult, merged_study, run_study


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    if args.problem is not None:
        return _one(args)
    console, workers = Console(args, is_step=True), args.workers or os.cpu_count() or 1
    request = request_of(StudyRequest, args, out=args.out or Path(args.study), workers=workers)
    if request.made:
        result = merged_study(request)
    else:
        result = run_study(request, OfThisProgram(threads=max((os.cpu_count() or 1) // workers, 1)), console)
    sections = {title: {"header": header, "rows": rows} for title, header, rows in result.sections}
    found = {"out": str(result.out), "trials": len(result.trials), "lacking": result.lacking, "tables": sections}
    return console.concluded(result.verdict, found, _lines(result))


def _lines(result: StudyResult) -> Iterator[str]:
    """The tables of a study that is whole, and what is to be known of them."""
    for title, header, rows in result.sections:
        yield title
        yield from table(header, rows)
        yield ""
    yield from result.notes
    if not result.lacking:
        yield f"{result.num_kept} problems as before; every trial is in {result.out / TRIALS}"


def _one(args: argparse.Namespace) -> int:
    """One problem alone, as the nodes of a study run it."""
    console, study = Console(args), STUDIES[args.study]
    request = request_of(
        ProblemRequest,
        args,
        out=args.out or Path(args.problem),
        methods=study.methods_of(args.methods or ()),
        width=args.width or study.width,
    )
    result = run_problem(study, request, console)
    lines = [trial.told for trial in result.trials]
    found = {"out": str(result.out), "trials": len(lines)}
    return console.concluded(result.verdict, found, [*lines, f"every figure is in {result.out / TRIALS}"])

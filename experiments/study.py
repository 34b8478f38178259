"""Run a study: each problem once, in parallel processes; then one table of all trials."""

import json
import multiprocessing
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.problem_run import (
    TRIALS,
    Row,
    Section,
    Study,
    read_trials,
    run_problem,
    verdict_on_trials,
    write_trials,
)
from experiments.problems import ProblemRequest, name_of
from experiments.registry import STUDIES
from splatctrl_cli import InputError, Outcome, Reason, SplatCtrlError, UsageError, Verdict
from splatctrl_cli.blocks import verdict_of

FILE, FIGURE = "study.json", "figure.png"
MOST_NAMED = 5  # problems that are missing


@dataclass(frozen=True, kw_only=True)
class StudyRequest:
    """Run a study into the folder `out`; a second run continues there.

    trials: most problems of each environment (None: the paper's number). problems: MotionBenchMaker's folder (None:
    below SPLATCTRL_REAL_DATA, if there). methods: of the study; empty for all installed methods. width [px]: of the
    images (None: the study's). shard: (i, n), every n-th problem from the i-th on. made: tables of trials or folders
    of studies to merge, instead of running problems.
    """

    study: str
    out: Path
    trials: int | None = None
    problems: Path | None = None
    methods: tuple[str, ...] = ()
    width: int | None = None
    workers: int = 1
    shard: tuple[int, int] = (1, 1)
    made: tuple[Path, ...] = ()


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """All trials with their tables and notes; both are empty while problems are `missing`."""

    out: Path
    trials: Sequence[Row]
    sections: Sequence[Section]
    notes: Sequence[str]
    missing: Sequence[str]
    verdict: Verdict
    num_kept: int = 0


def run_study(request: StudyRequest) -> StudyResult:
    """Run the shard's problems that have no trials yet. When all problems have trials, write ``trials.csv`` and the
    figure.

    Raises UsageError for a folder of another study or of other settings.
    """
    study, out = STUDIES[request.study], request.out
    archive = study.archive(request.problems)
    methods = study.methods_of(request.methods)
    width = request.width or study.width
    names = {name_of(e, n): e in study.archived for e, n in study.problems(request.trials, archive)}
    _begin(out, {"study": request.study, "methods": list(methods), "width": width})
    first, step = request.shard
    asked = [
        ProblemRequest(
            study=request.study,
            problem=name,
            out=out / name,
            problems=archive if is_archived else None,
            methods=methods,
            width=width,
            threads=max((os.cpu_count() or 1) // request.workers, 1),
        )
        for name, is_archived in [*names.items()][first - 1 :: step]
        if not (out / name / TRIALS).is_file()
    ]
    num_kept = sum((out / name / TRIALS).is_file() for name in names)
    errors = _run_side_by_side(asked, request.workers)
    missing = [name for name in names if not (out / name / TRIALS).is_file()]
    if missing:
        verdict = _unfinished(missing, errors, len(names))
        return StudyResult(
            out=out, trials=[], sections=[], notes=[], missing=missing, verdict=verdict, num_kept=num_kept
        )
    trials = [trial for name in names for trial in read_trials(out / name / TRIALS, study.row)]
    return _concluded(out, study, trials, num_kept)


def merged_study(request: StudyRequest) -> StudyResult:
    """Make the table of the trials in `made`, of several machines for example.

    Raises InputError for a table that cannot be read, and for a trial that is there twice.
    """
    study = STUDIES[request.study]
    found = {path: read_trials(path, study.row) for given in request.made for path in _tables(given)}
    labels = Counter(trial.label for rows in found.values() for trial in rows)
    for path, rows in found.items():
        for trial in rows:
            if labels[trial.label] > 1:
                raise InputError(f"{path}: {trial.label}: is there twice", remedy="give each trial once")
    _begin(request.out, {"study": request.study, "is_merged": True})
    return _concluded(request.out, study, [trial for rows in found.values() for trial in rows])


def _begin(out: Path, asked: Mapping[str, Any]) -> None:
    """Write study.json. Raises UsageError where the folder holds something else, or a study with other settings."""
    if (out / FILE).is_file():
        before = json.loads((out / FILE).read_text(encoding="utf-8"))
        changed = [name for name in {**before, **asked} if before.get(name) != asked.get(name)]
        if changed:
            raise UsageError(
                f"{out}: was begun with other settings: {', '.join(changed)}", remedy="give another --out"
            )
    elif out.is_dir() and any(out.iterdir()):
        raise UsageError(f"{out}: is no study, but something else", remedy="give another --out")
    out.mkdir(parents=True, exist_ok=True)
    (out / FILE).write_text(json.dumps(asked, indent=1) + "\n", encoding="utf-8")


def _run_side_by_side(asked: Sequence[ProblemRequest], workers: int) -> dict[str, str]:
    """Run problems in separate processes; return error messages by problem."""
    errors: dict[str, str] = {}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=workers, mp_context=context) as pool:
        futures = {pool.submit(_run, one): one.problem for one in asked}
        for future in as_completed(futures):
            name = futures[future]
            try:
                print(f"{name}: {future.result()}", flush=True)
            except SplatCtrlError as error:
                errors[name] = str(error)
                print(f"{name}: {error}", flush=True)
    return errors


def _run(request: ProblemRequest) -> str:
    trials = run_problem(STUDIES[request.study], request).trials
    return f"{sum(trial.success for trial in trials)} of {len(trials)} trials succeeded"


def _concluded(out: Path, study: Study[Any], trials: Sequence[Row], num_kept: int = 0) -> StudyResult:
    write_trials(out / TRIALS, trials, study.row)
    if study.draw is not None:
        study.draw(trials, out / FIGURE)
    return StudyResult(
        out=out,
        trials=trials,
        sections=list(study.sections(trials)),
        notes=list(study.notes(trials)),
        missing=[],
        verdict=verdict_on_trials(trials),
        num_kept=num_kept,
    )


def _tables(given: Path) -> list[Path]:
    """Return the path of a table, or of a folder's table, else of its problems' tables."""
    if not given.is_dir() or (given / TRIALS).is_file():
        return [given / TRIALS if given.is_dir() else given]
    found = sorted(given.glob(f"*/{TRIALS}"))
    if not found:
        raise InputError(f"{given}: has no {TRIALS}", remedy="give the folder of a study, or a table of its trials")
    return found


def _unfinished(missing: Sequence[str], errors: Mapping[str, str], num_problems: int) -> Verdict:
    words = f"{len(missing)} of {num_problems} problems have no trials yet"
    if errors:
        name, message = next(iter(errors.items()))
        words = f"{words}, {len(errors)} of them ended in an error: {name}: {message}"
    else:
        words = f"{words}: {', '.join(missing[:MOST_NAMED])}"
    reason = Reason(
        criterion="problems",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=words,
        remedy="" if errors else "run the other shards, then the same without --shard",
        count=num_problems,
    )
    return verdict_of("study", [reason], scope=f"{num_problems} problems")

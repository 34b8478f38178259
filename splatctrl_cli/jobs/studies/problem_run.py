"""One problem of a study as a run of its own: its trials as a table, and the verdict that no green one was false."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from splatctrl_cli.config import Config, PlannerConfig
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.files.digests import Parts
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_run
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.studies.problems import ARCHIVE, read_problem
from splatctrl_cli.jobs.studies.trial import METHODS, Trial, trials_of

TRIALS = "trials.csv"
FALSE_GREEN = "false green"
MAX_TIME = 86_400.0  # [s] of a search: iterations bound it, which are the same on every machine
WHOLE = ("number", "cameras", "num_parts")
REALS = ("true_clearance", "margin", "position_error", "rotation_error", "duration_s", "joint_path_rad")
FLAGS = ("success", "is_false_green", "in_known_space")


@dataclass(frozen=True, kw_only=True)
class ProblemRequest:
    """Run the problem of a name into the folder `out`; problems: MotionBenchMaker's folder, for one of its own."""

    problem: str
    out: Path
    study: str = "table2"
    problems: Path | None = None
    methods: tuple[str, ...] = METHODS
    width: int = 320
    force: bool = False
    threads: int = 0


@dataclass(frozen=True, kw_only=True)
class ProblemResult:
    """The trials of a problem."""

    out: Path
    trials: Sequence[Trial]
    verdict: Verdict


def run_problem(request: ProblemRequest, progress: Progress = SILENT) -> ProblemResult:
    """Run it; the same request leaves the same table. Raises InputError as `read_problem`."""
    config, stopwatch = Config(planner=PlannerConfig(max_time=MAX_TIME)), Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        with stopwatch.stage("problem"):
            problem = read_problem(request.problem, request.problems)
        trials = list[Trial]()
        for trial in trials_of(
            problem, config, request.methods, width=request.width, threads=request.threads, stopwatch=stopwatch
        ):
            trials.append(trial)
            progress.log(f"study: {problem.name}: {told(trial)}")
        write_trials(folder / TRIALS, trials)
        verdict = verdict_on_trials(trials)
        archive = request.problems and request.problems / ARCHIVE
        write_run(
            folder,
            command="study",
            config=config.as_dict(),
            inputs={} if archive is None else {ARCHIVE: sha256(archive)},
            metrics={"trials": len(trials), "succeeded": sum(trial.success for trial in trials)},
            stopwatch=stopwatch,
            seed=problem.number,
            verdict=verdict.as_dict(),
        )
    return ProblemResult(out=request.out, trials=trials, verdict=verdict)


def told(trial: Trial) -> str:
    """A trial in a few words."""
    cameras = f"{trial.cameras} cameras, " if trial.cameras else ""
    verdict = f"; {trial.verdict.upper()}" if trial.verdict else ""
    return f"{cameras}{trial.method}: {trial.cause or 'success'}{verdict}"


def verdict_on_trials(trials: Sequence[Trial]) -> Verdict:
    """Failed where one that was judged safe touched something: a study may find failures, and no false green."""
    judged = [trial for trial in trials if trial.verdict]
    reasons = [
        Reason(
            criterion=FALSE_GREEN,
            outcome=Outcome.FAILED,
            sentence=f"{trial.environment} {trial.number}, {trial.cameras} cameras, {trial.method}: judged safe, "
            f"and there was a {trial.cause}",
            value=trial.true_clearance,
            threshold=0.0,
            unit="m",
            label=FALSE_GREEN,
            count=len(judged),
        )
        for trial in trials
        if trial.is_false_green
    ]
    held = Reason(
        criterion=FALSE_GREEN,
        outcome=Outcome.PASSED,
        sentence="no trial judged safe touched anything",
        count=len(judged),
    )
    return verdict_of("study", reasons or [held], scope=f"{len(trials)} trials, {len(judged)} judged")


def write_trials(path: Path, trials: Sequence[Trial]) -> None:
    """A row for each trial; lengths in metres, angles in radians."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(Trial.columns())
        for trial in trials:
            writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in astuple(trial)])


def read_trials(path: Path) -> list[Trial]:
    """What `write_trials` wrote. Raises InputError for a file that is not that, or not as it was written."""
    Parts.beside(path).checked(path)
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = csv.DictReader(stream)
            if rows.fieldnames != Trial.columns():
                raise ValueError("other columns")
            return [Trial(**_values(row)) for row in rows]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: is not a table of trials: {error}", remedy="run its problem again") from None


def _values(row: Mapping[str, str | None]) -> dict[str, Any]:
    found = dict[str, Any]()
    for name, text in row.items():
        if text is None:
            raise ValueError(f"a row ends before {name}")
        if name in FLAGS:
            found[name] = {"True": True, "False": False, "": None}[text]
        elif name in WHOLE or name in REALS:
            found[name] = None if text == "" else int(text) if name in WHOLE else float(text)
        else:
            found[name] = text
    return found

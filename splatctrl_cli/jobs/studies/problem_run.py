"""One problem of a study as a run of its own: its trials as a table, and the verdict that no green one was false."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_run
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.studies.experiments import STUDIES, ProblemRequest
from splatctrl_cli.jobs.studies.problems import ARCHIVE
from splatctrl_cli.jobs.studies.rows import TRIALS, Row, verdict_on_trials, write_trials


@dataclass(frozen=True, kw_only=True)
class ProblemResult:
    """The trials of a problem."""

    out: Path
    trials: Sequence[Row]
    verdict: Verdict


def run_problem(request: ProblemRequest, progress: Progress = SILENT) -> ProblemResult:
    """Run it; the same request leaves the same table. Raises InputError for one that its study does not have."""
    study, stopwatch = STUDIES[request.study], Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        trials = list[Row]()
        for trial in study.trials(request, study.config, stopwatch):
            trials.append(trial)
            progress.log(f"study: {request.problem}: {trial.told}")
        write_trials(folder / TRIALS, trials, study.row)
        verdict = verdict_on_trials(trials)
        archive = request.problems and request.problems / ARCHIVE
        write_run(
            folder,
            command="study",
            config=study.config.as_dict(),
            inputs={} if archive is None else {ARCHIVE: sha256(archive)},
            metrics={"trials": len(trials), "succeeded": sum(trial.success for trial in trials)},
            stopwatch=stopwatch,
            seed=int(request.problem.rpartition("-")[2]),
            verdict=verdict.as_dict(),
        )
    return ProblemResult(out=request.out, trials=trials, verdict=verdict)

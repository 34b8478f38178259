"""One problem of a study as a run of its own: its trials as a table, and the verdict that no green one was false."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic

from splatctrl_cli.config import Config, PlannerConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Verdict
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_run
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.studies.problems import ARCHIVE
from splatctrl_cli.jobs.studies.rows import TRIALS, R, Row, verdict_on_trials, write_trials
from splatctrl_cli.jobs.studies.trial import TSDF
from splatctrl_cli.libraries import is_installed

MAX_TIME = 86_400.0  # [s] of a search: iterations bound it, which are the same on every machine
SETTINGS = Config(planner=PlannerConfig(max_time=MAX_TIME))

Section = tuple[str, Sequence[str], Sequence[Sequence[str]]]


@dataclass(frozen=True, kw_only=True)
class ProblemRequest:
    """Run the problem of a name into the folder `out`; problems: MotionBenchMaker's folder, for one of its own;
    methods: of the study; width [px] of the images.
    """

    problem: str
    out: Path
    study: str = "table2"
    problems: Path | None = None
    methods: tuple[str, ...] = ()
    width: int = 320
    force: bool = False
    threads: int = 0


@dataclass(frozen=True, kw_only=True)
class Study(Generic[R]):
    """An experiment of the paper, whose trials are rows of a kind. problems: environment and number, of at most so
    many of each (None: all), with those of a folder; archive: that folder, by --problems; archived: the environments
    that are in it; trials: those of a problem, whose `out` is the folder that is being written; sections: tables of
    all trials; notes: sentences below them; draw: their figure, into a file.
    """

    row: type[R]
    methods: tuple[str, ...]
    problems: Callable[[int | None, Path | None], list[tuple[str, int]]]
    trials: Callable[[ProblemRequest, Config, Stopwatch], Iterator[R]]
    sections: Callable[[Sequence[R]], Iterable[Section]]
    notes: Callable[[Sequence[R]], Iterable[str]]
    config: Config = SETTINGS
    width: int = 320
    archived: tuple[str, ...] = ()
    archive: Callable[[Path | None], Path | None] = lambda given: None
    draw: Callable[[Sequence[R], Path], None] | None = None

    def methods_of(self, given: Sequence[str]) -> tuple[str, ...]:
        """The methods that are asked for, or all that are installed. Raises UsageError for one that is none."""
        for name in given:
            if name not in self.methods:
                raise UsageError(f"--methods {name}: expected some of {', '.join(self.methods)}")
        return tuple(n for n in self.methods if (n in given if given else n != TSDF or is_installed("open3d")))


@dataclass(frozen=True, kw_only=True)
class ProblemResult:
    """The trials of a problem."""

    out: Path
    trials: Sequence[Row]
    verdict: Verdict


def run_problem(study: Study[R], request: ProblemRequest, progress: Progress = SILENT) -> ProblemResult:
    """Run it; the same request leaves the same table. Raises InputError for one that its study does not have."""
    stopwatch = Stopwatch()
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        trials = list[R]()
        for trial in study.trials(replace(request, out=folder), study.config, stopwatch):
            trials.append(trial)
            progress.log(f"study: {request.problem}: {trial.told}")
        write_trials(folder / TRIALS, trials, study.row)
        verdict = verdict_on_trials(trials)
        archive = request.problems and request.problems / ARCHIVE
        write_run(
            folder,
            command="study",
            config=study.config.as_dict(),
            inputs={ARCHIVE: sha256(archive)} if archive and archive.is_file() else {},
            metrics={"trials": len(trials), "succeeded": sum(trial.success for trial in trials)},
            stopwatch=stopwatch,
            seed=int(request.problem.rpartition("-")[2]),
            verdict=verdict.as_dict(),
        )
    return ProblemResult(out=request.out, trials=trials, verdict=verdict)

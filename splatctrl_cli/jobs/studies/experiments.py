"""The experiments that a study repeats: of each its problems, what a trial is, and the tables made of them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from splatctrl_cli.config import Config, PlannerConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.studies import ablation, ablation_table, table2, trial
from splatctrl_cli.jobs.studies.problems import FAMILIES, read_problem
from splatctrl_cli.jobs.studies.rows import R
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
    many of each (None: all), with the archive's or without; archived: environments of the archive; trials: those of a
    problem; sections: tables of all trials; notes: sentences below them; draw: their figure, into a file.
    """

    row: type[R]
    methods: tuple[str, ...]
    problems: Callable[[int | None, bool], list[tuple[str, int]]]
    trials: Callable[[ProblemRequest, Config, Stopwatch], Iterator[R]]
    sections: Callable[[Sequence[R]], Iterable[Section]]
    notes: Callable[[Sequence[R]], Iterable[str]]
    config: Config = SETTINGS
    width: int = 320
    archived: tuple[str, ...] = ()
    draw: Callable[[Sequence[R], Path], None] | None = None

    def methods_of(self, given: Sequence[str]) -> tuple[str, ...]:
        """The methods that are asked for, or all that are installed. Raises UsageError for one that is none."""
        for name in given:
            if name not in self.methods:
                raise UsageError(f"--methods {name}: expected some of {', '.join(self.methods)}")
        return tuple(n for n in self.methods if (n in given if given else n != trial.TSDF or is_installed("open3d")))


def _planned(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[trial.Trial]:
    """The trials of a problem of Table II."""
    with stopwatch.stage("problem"):
        problem = read_problem(request.problem, request.problems)
    yield from trial.trials_of(
        problem, config, request.methods, width=request.width, threads=request.threads, stopwatch=stopwatch
    )


def _ablated(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[ablation.Measured]:
    """A recording with each mechanism off in turn; `config` is that of each."""
    del config
    yield from ablation.measured(
        request.problem, request.methods, width=request.width, threads=request.threads, stopwatch=stopwatch
    )


STUDIES: Mapping[str, Study[Any]] = {
    "ablation": Study(
        row=ablation.Measured,
        methods=tuple(ablation.OFF),
        problems=ablation.problems,
        trials=_ablated,
        sections=ablation_table.sections,
        notes=ablation_table.notes,
    ),
    "table2": Study(
        row=trial.Trial,
        methods=trial.METHODS,
        problems=table2.problems,
        trials=_planned,
        sections=table2.sections,
        notes=table2.notes,
        archived=FAMILIES,
    ),
}

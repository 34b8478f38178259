"""One problem of a study as a separate run. Its trials are rows of a table, written and read without loss; its
verdict is that no green trial was false.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, get_args, get_type_hints

from experiments.problems import ProblemRequest
from experiments.trial import TSDF
from splatctrl_cli import Config, InputError, Outcome, Progress, Reason, UsageError, Verdict
from splatctrl_cli.blocks import (
    SILENT,
    PlannerConfig,
    Stopwatch,
    is_installed,
    output_path,
    verdict_of,
)

TRIALS = "trials.csv"
FALSE_GREEN = "false green"
FLAGS = {"True": True, "False": False}


class Row(Protocol):
    """A trial: a frozen dataclass of words, numbers and flags; missing values are None.

    verdict: splatctrl's label, or "". is_false_green: judged safe, though something was touched. cause: of its
    failure, "" for a success. true_clearance [m]: the least over the whole motion. label: names the trial. told: its
    result in a few words.
    """

    @property
    def verdict(self) -> str: ...
    @property
    def is_false_green(self) -> bool: ...
    @property
    def success(self) -> bool: ...
    @property
    def cause(self) -> str: ...
    @property
    def true_clearance(self) -> float | None: ...
    @property
    def label(self) -> str: ...
    @property
    def told(self) -> str: ...


R = TypeVar("R", bound=Row)


def verdict_on_trials(trials: Sequence[Row]) -> Verdict:
    """Fail if a trial that was judged safe touched something. Without trials, nothing is judged."""
    if not trials:
        return verdict_of("study", [])
    judged = [trial for trial in trials if trial.verdict]
    reasons = [
        Reason(
            criterion=FALSE_GREEN,
            outcome=Outcome.FAILED,
            sentence=f"{trial.label}: judged safe, and there was a {trial.cause}",
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


def write_trials(path: Path, trials: Sequence[Row], kind: type[Row]) -> None:
    """A row for each trial, all of one kind; lengths in metres, angles in radians, times in seconds."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(_columns(kind))
        for trial in trials:
            values = astuple(trial)  # type: ignore[call-overload]
            writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in values])


def read_trials(path: Path, kind: type[R]) -> list[R]:
    """Read trials from `write_trials`. Raises InputError for another or a changed file."""
    types = _columns(kind)
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = csv.DictReader(stream)
            if rows.fieldnames != list(types):
                raise ValueError("other columns")
            return [kind(**_values(row, types)) for row in rows]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", remedy="check the path") from None
    except (ValueError, TypeError, KeyError, csv.Error) as error:
        raise InputError(f"{path}: is not a table of trials: {error}", remedy="run its problem again") from None


def _columns(kind: type[Row]) -> dict[str, Any]:
    """Type of each column, by name, in the order of the fields."""
    types = get_type_hints(kind)
    return {column.name: types[column.name] for column in fields(kind)}  # type: ignore[arg-type]


def _values(row: Mapping[str, str | None], types: Mapping[str, Any]) -> dict[str, Any]:
    found = dict[str, Any]()
    for name, text in row.items():
        if text is None:
            raise ValueError(f"a row ends before {name}")
        known = get_args(types[name]) or (types[name],)
        if known[0] is str:
            found[name] = text
        elif text == "" and type(None) in known:
            found[name] = None
        else:
            found[name] = FLAGS[text] if known[0] is bool else known[0](text)
    return found


MAX_TIME = 86_400.0  # [s] of a search: iterations bound it, which are the same on every machine
SETTINGS = Config(planner=PlannerConfig(max_time=MAX_TIME))

Section = tuple[str, Sequence[str], Sequence[Sequence[str]]]


@dataclass(frozen=True, kw_only=True)
class Study(Generic[R]):
    """An experiment of the paper, whose trials are rows of a kind. problems: environments and numbers, at most so
    many of each (None: all), with a folder's. archive: this folder, by --problems. archived: environments in the
    folder. trials: of a problem, whose `out` is the folder being written. sections: tables of all trials. notes:
    sentences below them. draw: writes their figure to a file.
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
        """The given methods, or all installed methods. Raises UsageError for an unknown method."""
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
    """Run a problem; the same request gives the same table. Raises InputError for an unknown problem."""
    with output_path(request.out, force=request.force, is_folder=True) as folder:
        trials = list[R]()
        for trial in study.trials(replace(request, out=folder), study.config, Stopwatch()):
            trials.append(trial)
            progress.log(f"study: {request.problem}: {trial.told}")
        write_trials(folder / TRIALS, trials, study.row)
        verdict = verdict_on_trials(trials)
    return ProblemResult(out=request.out, trials=trials, verdict=verdict)

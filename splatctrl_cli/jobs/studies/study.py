"""A study from its request to its table: its problems are nodes of a batch, each made once."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.files.output import check_can_be_written, write_durably, write_json
from splatctrl_cli.jobs.batches.batch import check_same_asked, scheduling, write_batch
from splatctrl_cli.jobs.batches.graph import CommandLine, nodes_of, of_shard
from splatctrl_cli.jobs.batches.ledger import Ledger, Run, keys_of
from splatctrl_cli.jobs.batches.run import DONE, FAILED
from splatctrl_cli.jobs.batches.suite import Job, Recording, Suite
from splatctrl_cli.jobs.progress import SILENT, Progress
from splatctrl_cli.jobs.report import WriteReportRequest, write_report
from splatctrl_cli.jobs.studies.experiments import STUDIES
from splatctrl_cli.jobs.studies.problem_run import (
    TRIALS,
    Row,
    Section,
    Study,
    read_trials,
    verdict_on_trials,
    write_trials,
)
from splatctrl_cli.jobs.studies.problems import name_of

FILE, FORMAT = "study.json", "splatctrl-study"
DRAWN, ARCHIVED = "drawn", "archive"  # jobs: of environments by their seed, of MotionBenchMaker
MOST_NAMED = 5  # problems that lack


@dataclass(frozen=True, kw_only=True)
class StudyRequest:
    """Run a study into the folder `out`, in which it goes on. trials: problems of each environment at most (None: as
    many as the paper's); problems: MotionBenchMaker's folder (None: what SPLATCTRL_REAL_DATA has, if anything);
    methods: of the study, none for all that are installed; shard: (i, n), every n-th problem from the i-th on;
    width [px] of the images (None: the study's own); dask: the address of a Dask scheduler that runs them. made:
    tables of trials or folders of studies, of which the table is made instead of running a problem.
    """

    study: str
    out: Path
    trials: int | None = None
    problems: Path | None = None
    methods: tuple[str, ...] = ()
    width: int | None = None
    workers: int = 1
    shard: tuple[int, int] = (1, 1)
    dask: str | None = None
    made: tuple[Path, ...] = ()


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """The trials of every problem with their tables and notes, empty as long as `lacking` are still to run, and the
    verdict on them.
    """

    out: Path
    trials: Sequence[Row]
    sections: Sequence[Section]
    notes: Sequence[str]
    lacking: Sequence[str]
    verdict: Verdict
    num_kept: int


def run_study(request: StudyRequest, command_line: CommandLine, progress: Progress = SILENT) -> StudyResult:
    """Run what is not done of the shard; where every problem is, write the table, ``trials.csv`` and the report page.

    Raises UsageError for an output of another study or of other settings, InputError for problems that lack.
    """
    study, out = STUDIES[request.study], request.out.absolute()
    archive = study.archive(request.problems)
    wanted = study.problems(request.trials, archive)
    asked: dict[str, Any] = {
        "study": request.study,
        "methods": list(study.methods_of(request.methods)),
        "width": request.width or study.width,
    }
    suite = _suite(study, asked, wanted, out, archive)
    nodes = nodes_of(suite, out, command_line)
    check_can_be_written(out)
    check_same_asked(out, FILE, asked, what="study")
    with (
        Ledger(out) as ledger,
        scheduling(ledger, command_line.entry, progress, workers=request.workers, dask=request.dask) as scheduler,
    ):
        write_durably(out / FILE, lambda path: write_json(path, {"format": FORMAT, "version": 1, "asked": asked}))
        (out / TRIALS).unlink(missing_ok=True)  # of fewer problems, or of an older program
        try:
            scheduler.run(of_shard(nodes, request.shard))
        except KeyboardInterrupt:
            raise KeyboardInterrupt("interrupted; run the same again to go on") from None
        finally:
            if scheduler.keys:
                write_batch(out, suite, nodes, ledger.latest(), scheduler.keys)
        latest, keys = ledger.latest(), keys_of(nodes, ledger, command_line.entry)
    lacking = [node.name for node in nodes if not _is_done(latest.get(node.name), keys[node.name])]
    tables = [node.out / TRIALS for node in nodes if node.out is not None and not lacking]
    trials = [trial for table in tables for trial in read_trials(table, study.row)]
    if not lacking:
        _write(out, study, trials)
        page = out.with_name(f"{out.name}.html")
        write_report(WriteReportRequest(path=out, out=page, force=True), progress)
    return StudyResult(
        out=request.out,
        trials=trials,
        sections=[] if lacking else list(study.sections(trials)),
        notes=[] if lacking else list(study.notes(trials)),
        lacking=lacking,
        verdict=_verdict(trials, lacking, latest, len(nodes)),
        num_kept=scheduler.num_kept,
    )


def merged_study(request: StudyRequest) -> StudyResult:
    """The table of the trials that `made` has: they may be of several machines, and some of each problem.

    Raises InputError for what is no table of trials, and for a trial that is there twice; UsageError for an output
    that is something else.
    """
    study, out = STUDIES[request.study], request.out.absolute()
    found = {path: read_trials(path, study.row) for given in request.made for path in _tables(given)}
    labels = Counter(trial.label for rows in found.values() for trial in rows)
    for path, rows in found.items():
        for trial in rows:
            if labels[trial.label] > 1:
                raise InputError(f"{path}: {trial.label}: is there twice", remedy="give each trial once")
    trials = [trial for rows in found.values() for trial in rows]
    asked = {"study": request.study, "is_merged": True}
    check_can_be_written(out)
    check_same_asked(out, FILE, asked, what="study")
    out.mkdir(parents=True, exist_ok=True)
    write_durably(out / FILE, lambda path: write_json(path, {"format": FORMAT, "version": 1, "asked": asked}))
    _write(out, study, trials)
    return StudyResult(
        out=request.out,
        trials=trials,
        sections=list(study.sections(trials)),
        notes=list(study.notes(trials)),
        lacking=[],
        verdict=verdict_on_trials(trials),
        num_kept=0,
    )


def _tables(given: Path) -> list[Path]:
    """A table of trials, that of a folder, or where it has none those of its problems."""
    if not given.is_dir() or (given / TRIALS).is_file():
        return [given / TRIALS if given.is_dir() else given]
    found = sorted(given.glob(f"*/*/{TRIALS}"))
    if not found:
        raise InputError(f"{given}: has no {TRIALS}", remedy="give the folder of a study, or a table of its trials")
    return found


def _write(out: Path, study: Study[Any], trials: Sequence[Row]) -> None:
    """The table of trials, and the figure of a study that has one."""
    write_durably(out / TRIALS, lambda path: write_trials(path, trials, study.row))
    if study.draw is not None:
        study.draw(trials, out.with_name(f"{out.name}.png"))


def _suite(
    study: Study[Any],
    asked: Mapping[str, Any],
    wanted: Sequence[tuple[str, int]],
    out: Path,
    archive: Path | None,
) -> Suite:
    options: dict[str, Any] = {**asked, "problem": "{name}"}
    jobs = [Job(name=DRAWN, command="study", options=options)]
    if archive is not None:
        jobs.append(Job(name=ARCHIVED, command="study", options={**options, "problems": str(archive)}))
    recordings = [
        Recording(name=name_of(e, n), paths=(), only=(ARCHIVED if e in study.archived else DRAWN,)) for e, n in wanted
    ]
    return Suite(name=asked["study"], folder=Path.cwd(), out=out, recordings=tuple(recordings), jobs=tuple(jobs))


def _is_done(run: Run | None, key: str) -> bool:
    return run is not None and run.key == key and run.state in (DONE, FAILED)


def _verdict(trials: Sequence[Row], lacking: Sequence[str], latest: Mapping[str, Run], num_problems: int) -> Verdict:
    if not lacking:
        return verdict_on_trials(trials)
    errors = [name for name in lacking if name in latest and latest[name].state not in (DONE, FAILED)]
    named = ", ".join((errors or list(lacking))[:MOST_NAMED])
    words = f"{len(lacking)} of {num_problems} problems have no trials yet"
    reason = Reason(
        criterion="problems",
        outcome=Outcome.NOT_EVALUABLE,
        sentence=words + (f", {len(errors)} of them ended in an error: {named}" if errors else f": {named}"),
        remedy="see their logs" if errors else "run the other shards, then the same without --shard",
        count=num_problems,
    )
    return verdict_of("study", [reason], scope=f"{num_problems} problems")

"""A batch: read the suite, run its graph, write batch.json."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from splatctrl_cli import __version__
from splatctrl_cli.errors import DAMAGED, UsageError, refuse_faults, refuse_if
from splatctrl_cli.evaluate.verdict import JudgedResult, Outcome, Reason, Verdict, plural, verdict_of
from splatctrl_cli.files.output import write_durably, write_json
from splatctrl_cli.jobs.batch.graph import COMMANDS, CommandLine, Node, nodes_of, select_shard
from splatctrl_cli.jobs.batch.ledger import FILE, FILE_VERSION, FORMAT, Ledger, Run, keys_of
from splatctrl_cli.jobs.batch.run import (
    DONE,
    ERROR,
    FAILED,
    SKIPPED,
    TO_DO,
    Scheduler,
    describe_run,
    local_executor,
    not_run,
    verdict_in,
)
from splatctrl_cli.jobs.batch.suite import Suite as Asked
from splatctrl_cli.jobs.batch.suite import read_suite
from splatctrl_cli.jobs.batch.task import last_lines
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.libraries import distributed
from splatctrl_cli.report.junit import Case, Kind, Suite, cases_of, damage_case, error_case

CONNECT_S = 10.0  # to a scheduler


@dataclass(frozen=True, kw_only=True)
class BatchRequest:
    """A run of a suite's file into `out` (default: the suite's).

    workers: number of processes. shard: (i, n) runs every n-th recording from the i-th on. dask: address of a Dask
    scheduler instead of local processes. again: rerun finished nodes.
    """

    suite: Path
    out: Path | None = None
    workers: int = 1
    shard: tuple[int, int] = (1, 1)
    dask: str | None = None
    again: bool = False


@dataclass(frozen=True, kw_only=True, repr=False)
class BatchResult(JudgedResult):
    """Runs of all nodes in graph order; `num_kept` are from earlier batches."""

    out: Path
    suite: str
    jobs: Sequence[str]
    runs: Sequence[Run]
    num_kept: int


def batch(request: BatchRequest, command_line: CommandLine, progress: Progress = SILENT) -> BatchResult:
    """Run unfinished nodes. Raises UsageError for an invalid suite, InputError for missing files."""
    suite, every, nodes, out = plan_batch(request, command_line)
    with (
        Ledger(out) as ledger,
        scheduling(
            ledger, command_line.entry, progress, workers=request.workers, dask=request.dask, again=request.again
        ) as scheduler,
    ):
        progress.log(f"batch: {plural(len(nodes), 'node')} into {out}")
        try:
            runs = list(scheduler.run(nodes).values())
        except KeyboardInterrupt:
            raise KeyboardInterrupt("interrupted; run the same command again to continue") from None
        finally:
            if scheduler.keys:  # the key of each node is known
                write_batch(out, suite, every, ledger.latest(), scheduler.keys)
    document = {"out": out, "suite": suite.name, "kept": scheduler.num_kept}
    return BatchResult(
        out=out,
        document=document | {"nodes": [run.document() for run in runs]},
        suite=suite.name,
        jobs=[job.name for job in suite.jobs],
        runs=runs,
        num_kept=scheduler.num_kept,
        verdict=verdict_of_runs(runs),
    )


def plan_batch(request: BatchRequest, command_line: CommandLine) -> tuple[Asked, list[Node], list[Node], Path]:
    """Suite, all its nodes in order, this shard's nodes, and the output folder.

    Raises UsageError for a shard without a recording.
    """
    suite = read_suite(request.suite, COMMANDS)
    out = (request.out or suite.out).absolute()
    every = nodes_of(suite, out, command_line)
    nodes = select_shard(every, request.shard)
    index, count = request.shard
    refuse_if(
        not nodes,
        f"--shard {index}/{count}: has none of the {len(suite.recordings)} recordings",
        remedy="give fewer shards",
        error=UsageError,
    )
    return suite, every, nodes, out


def dry_run(request: BatchRequest, command_line: CommandLine) -> list[tuple[Node, str]]:
    """Every node of the shard, "done" or "to do"; writes only the ledger's digests."""
    *_, nodes, out = plan_batch(request, command_line)
    with Ledger(out) as ledger:
        keys, latest = keys_of(nodes, ledger, command_line.entry), ledger.latest()
    stand = {name for name, run in latest.items() if run.state in {DONE, FAILED} and run.key == keys.get(name)}
    return [(node, "done" if node.name in stand and not request.again else "to do") for node in nodes]


def verdict_of_runs(runs: Sequence[Run]) -> Verdict:
    """Judge a batch: each node has a reason, passed if the node ended as expected."""
    num = len({run.recording for run in runs})
    damaged = dict.fromkeys(run.recording for run in runs if _is_damaged(run))
    return verdict_of(
        "batch",
        [_reason(run) for run in runs],
        scope=f"{plural(len(runs), 'node')} of {plural(num, 'recording')}",
        passed="as expected",
        notes=[f"damaged: {', '.join(damaged)}"] if damaged else [],
        is_damaged=bool(damaged),
    )


def _is_damaged(run: Run) -> bool:
    return run.state == DONE and run.expect != f"exit {DAMAGED}" and bool(run.damage)


def _reason(run: Run) -> Reason:
    lacks = run.state == SKIPPED or (run.state != ERROR and run.outcome == Outcome.NOT_EVALUABLE)
    return Reason(
        criterion=run.node,
        outcome=Outcome.PASSED if run.state == DONE else Outcome.NOT_EVALUABLE if lacks else Outcome.FAILED,
        sentence=describe_run(run) + (f": {run.sentence}" if run.sentence and run.state != DONE else ""),
        label="error" if run.state == ERROR else "not as expected",
        remedy="" if run.state in (DONE, SKIPPED) else f"see {run.log}",
        count=1,
    )


def suites_of(result: BatchResult) -> list[Suite]:
    suites = list[Suite]()
    for recording in dict.fromkeys(run.recording for run in result.runs):
        runs = [run for run in result.runs if run.recording == recording]
        cases = [
            replace(case, seconds=0.0 if number else run.seconds)  # the first case of a node has the node's time
            for run in runs
            for number, case in enumerate(_cases_of(run, result.out))
        ]
        properties = {} if suites else {"splatctrl": __version__, "batch": result.suite}  # once: readers join suites
        suites.append(
            Suite(
                name=recording,
                cases=cases,
                properties=properties,
                started=datetime.fromtimestamp(min(run.started for run in runs), UTC).isoformat(timespec="seconds"),
                seconds=sum(run.seconds for run in runs),
            )
        )
    return suites


def _cases_of(run: Run, out: Path) -> list[Case]:
    if run.state == SKIPPED:
        return [Case(name="skipped", group=run.node, kind=Kind.SKIPPED, sentence=run.cause, text=run.cause)]
    if run.state == ERROR:
        return [
            error_case(
                run.node,
                run.cause or run.sentence or run.label,
                exit_code=run.exit_code,
                lines=last_lines(out / run.log),
            )
        ]
    verdict = verdict_in(out / run.result)
    if run.state == FAILED:
        wrong = Case(
            name="expected", group=run.node, kind=Kind.FAILED, sentence=describe_run(run), text=str(_reason(run))
        )
        return [wrong, *(cases_of(verdict, run.node) if verdict and run.outcome != Outcome.PASSED else [])]
    if verdict:
        return cases_of({**verdict, "is_damaged": _is_damaged(run)}, run.node, expected=run.outcome)
    passed = Case(name=run.command, group=run.node, kind=Kind.PASSED, text="" if run.outcome else describe_run(run))
    return [passed, *([damage_case(run.node)] if _is_damaged(run) else [])]


def write_batch(
    out: Path, suite: Asked, nodes: Sequence[Node], latest: Mapping[str, Run], keys: Mapping[str, str]
) -> None:
    """Write batch.json: every node with a key, and the last run of other nodes.

    Nodes still to run have the state "to do".
    """
    runs = list[Run]()
    for node in nodes:
        run = latest.get(node.name)
        if node.name in keys and (run is None or run.key != keys[node.name]):
            run = not_run(
                node, "", out, state=TO_DO, cause="has not run since the suite, its inputs or the program changed"
            )
        runs += [] if run is None else [run]
    document = {
        "format": FORMAT,
        "version": FILE_VERSION,
        "suite": suite.name,
        "jobs": [job.name for job in suite.jobs],
        "nodes": [run.document() for run in runs],
    }
    write_durably(out / FILE, lambda path: write_json(path, document))


@contextmanager
def scheduling(
    ledger: Ledger, entry: str, progress: Progress, *, workers: int, dask: str | None, again: bool = False
) -> Iterator[Scheduler]:
    """Yield a scheduler: local processes or a Dask cluster. Raises UsageError if no scheduler answers."""
    scheduler = partial(Scheduler, ledger=ledger, entry=entry, progress=progress, again=again)
    if dask is None:
        with local_executor(workers) as executor:
            yield scheduler(executor=executor, slots=workers)
        return
    lacks, silent = "--dask: dask is not installed", f"--dask {dask}: no scheduler answers"
    with (
        refuse_faults(lambda _: lacks, ImportError, remedy="pip install 'splatctrl[dask]'", error=UsageError),
        refuse_faults(silent, OSError, ValueError, remedy="check the address", error=UsageError),
    ):
        client = distributed.Client(dask, timeout=CONNECT_S)
    with client:
        yield scheduler(
            executor=client.get_executor(pure=False, retries=2),
            slots=2 * max(sum(client.nthreads().values()), 1),
            hint=lambda: "" if client.nthreads() else ": the cluster has no worker",
        )

"""Scheduler of a batch: nodes run in processes, in graph order; unchanged results stay."""

import json
import os
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.jobs.batch.graph import Node
from splatctrl_cli.jobs.batch.ledger import Ledger, Run, keys_of
from splatctrl_cli.jobs.batch.task import End, Task, last_lines, read_end, run_task, stamp_of, stop_runners
from splatctrl_cli.jobs.running.progress import Progress, duration

DONE, FAILED, ERROR, SKIPPED, TO_DO = "done", "failed", "error", "skipped", "to do"
DISK_FULL = 6  # exit code
AGAIN_S = 0.5  # between looks at nodes that another batch runs
STILL_S = 60.0  # without an ended node, until a log line names a running node
MAY_PASS = ("killed by SIGKILL", "killed by SIGBUS", "its runner", "lost")  # causes that this batch did not ask for
PRINTED = "printed"  # stamp of a node that only prints


@dataclass(kw_only=True)
class Scheduler:
    """Runner of `slots` nodes at once; hint: why a wait may be in vain."""

    ledger: Ledger
    entry: str
    executor: Executor
    slots: int
    progress: Progress
    again: bool = False
    hint: Callable[[], str] = lambda: ""
    keys: dict[str, str] = field(default_factory=dict)
    runs: dict[str, Run] = field(default_factory=dict)
    num_kept: int = 0

    def run(self, nodes: Sequence[Node]) -> dict[str, Run]:
        """Run the nodes; return each node's run by name, kept or new."""
        self.keys = keys_of(nodes, self.ledger, self.entry)
        latest = self.ledger.latest()
        waiting = {node.name: node for node in nodes}
        futures: dict[Future[End], Node] = {}
        tries: Counter[str] = Counter()
        clock, last = Clock(nodes, self.ledger.mean_seconds(), self.slots), time.monotonic()
        while waiting or futures:
            is_busy = self._submit(waiting, futures, latest, clock)
            ended, _ = wait(futures, timeout=AGAIN_S if is_busy else STILL_S, return_when=FIRST_COMPLETED)
            now = time.monotonic()
            if not ended and now - last >= STILL_S:
                names = [node.name for node in futures.values()] or ["what another batch runs"]
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                self.progress.log(f"batch: still waits for {names[0]}{more}{self.hint()}")
            last = now if ended or now - last >= STILL_S else last
            if is_busy and not futures:
                time.sleep(AGAIN_S)
            latest = self.ledger.latest() if is_busy else latest
            for future in ended:
                node, end = futures.pop(future), _end_of(future)
                tries[node.name] += 1
                may_pass = end.exit_code == DISK_FULL or end.cause.startswith(MAY_PASS)
                if tries[node.name] <= node.job.retries and may_pass:
                    self.progress.log(f"batch: {node.name}: {end.cause or 'disk full'}, once more")
                    waiting[node.name] = node
                else:
                    run = run_of(node, self.keys[node.name], end, self.ledger.folder)
                    self._settle(node, self.ledger.record(run), clock)
        return {node.name: self.runs[node.name] for node in nodes}

    def _submit(
        self,
        waiting: dict[str, Node],
        futures: "dict[Future[End], Node]",
        latest: Mapping[str, Run],
        clock: "Clock",
    ) -> bool:
        """Settle nodes with kept runs, submit due nodes; True if another batch runs one."""
        is_busy = False
        for node in list(waiting.values()):
            if len(futures) >= self.slots:
                break
            if any(need not in self.runs for need in node.needs):
                continue
            run = self._reuse_run(node, latest.get(node.name))
            if run is None and not self.ledger.claim(node.name):
                is_busy = True
                continue
            if run is None:  # another batch may have run it since `latest`
                run = self._reuse_run(node, next(self.ledger.runs([f"node={node.name}"]), None))
                if run is not None:
                    self.ledger.release(node.name)
            del waiting[node.name]
            if run is not None:
                self._settle(node, run, clock)
            else:
                Path(self._place(node, ".end")).unlink(missing_ok=True)
                task = Task(
                    entry=self.entry,
                    words=[*node.words],
                    key=self.keys[node.name],
                    out="" if node.out is None else str(node.out.absolute()),
                    result=self._place(node, ".json"),
                    log=self._place(node, ".log"),
                    end=self._place(node, ".end"),
                    timeout=node.job.timeout,
                    memory=node.job.memory,
                )
                futures[self.executor.submit(run_task, task)] = node
        return is_busy

    def _reuse_run(self, node: Node, before: Run | None) -> Run | None:
        """Earlier or skipped run of a node; None if the node must run."""
        key, folder = self.keys[node.name], self.ledger.folder
        if missing := [need for need in node.needs if not self.runs[need].stamp]:
            run = not_run(node, key, folder, state=SKIPPED, cause=f"needs {missing[0]}, which left nothing")
            is_known = before is not None and (before.state, before.key) == (SKIPPED, key)
            return run if is_known else self.ledger.record(run)
        if self.again:
            return None
        stamp = None if node.out is None else stamp_of(node.out)
        is_same = before is not None and before.key == key and before.state in (DONE, FAILED)
        # both stamps are empty after an expected error
        if before is not None and is_same and stamp in (None, before.stamp):
            self.num_kept += 1
            judged = _judge_again(before, node)
            return judged if judged == before else self.ledger.record(judged)
        end = read_end(Path(self._place(node, ".end")), key)
        if end is None or end.exit_code is None or stamp not in (None, end.stamp):
            return None
        if before is not None and end.started <= before.started:
            return None
        run = self.ledger.record(run_of(node, key, end, folder))
        return run if run.state in (DONE, FAILED) else None

    def _settle(self, node: Node, run: Run, clock: "Clock") -> None:
        self.runs[node.name] = run
        line = clock.passed(run)
        if run.started >= clock.started or run.state == SKIPPED:
            self.progress.log(f"{line} {node.name}: {describe_run(run)}{clock.left()}")

    def _place(self, node: Node, ending: str) -> str:
        return str((self.ledger.folder / node.name).absolute()) + ending


def run_of(node: Node, key: str, end: End, folder: Path) -> Run:
    place = folder / node.name
    verdict = verdict_in(Path(f"{place}.json")) if end.exit_code is not None else {}
    code, outcome, label = end.exit_code, verdict.get("outcome", ""), verdict.get("label", "")
    if not verdict and code is not None:
        outcome, label = ("passed", "done") if code in (0, 3) else ("", f"exit {code}")
    last = last_lines(Path(f"{place}.log"), 1)
    run = Run(
        node=node.name,
        recording=node.recording,
        job=node.job.name,
        command=node.job.command,
        key=key,
        state=ERROR,
        expect=node.job.expect,
        outcome=outcome,
        label=label,
        sentence=verdict.get("sentence", "") or (last[0].removeprefix("splatctrl: ") if last and code else ""),
        exit_code=code,
        cause=end.cause,
        started=end.started,
        seconds=round(end.seconds, 3),
        peak_mb=round(end.peak_mb, 1),
        variant=json.dumps(dict(node.variant)),
        words=json.dumps(node.words),
        needs=json.dumps(node.needs),
        out="" if node.out is None else os.path.relpath(node.out, folder),
        result=f"{node.name}.json",
        log=f"{node.name}.log",
        stamp=end.stamp if node.out is not None else PRINTED if end.exit_code is not None else "",
        version=__version__,
        host=socket.gethostname(),
    )
    return _judge_again(run, node)


def _judge_again(run: Run, node: Node) -> Run:
    if run.cause:
        return replace(run, state=ERROR)
    is_expected = node.job.expect in {run.label, run.outcome, f"exit {run.exit_code}"}
    state = DONE if is_expected else ERROR if run.exit_code in (2, 4, 6, 70, 130) else FAILED  # without a verdict
    return replace(run, state=state, expect=node.job.expect)


def describe_run(run: Run) -> str:
    if run.state == SKIPPED:
        return f"skipped: {run.cause}"
    what = run.cause or (run.label.upper() if run.outcome else run.label)
    odd = "" if run.state == DONE else f", expected {run.expect}" if run.state == FAILED else ", an error"
    return f"{what}{run.damage}{odd} ({run.seconds:.1f} s)"


@contextmanager
def local_executor(workers: int) -> Iterator[Executor]:
    """Yield an executor of local processes that end with the block and this process."""
    executor = ThreadPoolExecutor(workers, thread_name_prefix="node")
    before = None
    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        stop_runners()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
        stop_runners()
        if before is not None:
            signal.signal(signal.SIGTERM, before)


class Clock:
    """Count of finished nodes, and time left by each job's mean time."""

    def __init__(self, nodes: Sequence[Node], means: Mapping[str, float], slots: int) -> None:
        self.started = time.time()
        self._total, self._slots = len(nodes), slots
        self._left = Counter(node.job.name for node in nodes)
        self._means = dict(means)
        self._seen: dict[str, list[float]] = {}

    def passed(self, run: Run) -> str:
        """Count a run, and return "[finished/all]"."""
        self._left[run.job] -= 1
        if run.started >= self.started and run.state != SKIPPED:
            self._seen.setdefault(run.job, []).append(run.seconds)
        return f"[{self._total - self._left.total()}/{self._total}]"

    def left(self) -> str:
        """Time left in words, with "over" if a job has no mean time yet."""
        means = self._means | {job: sum(each) / len(each) for job, each in self._seen.items()}
        known = Counter({job: count for job, count in self._left.items() if count and job in means})
        if not known:
            return ""
        seconds = sum(count * means[job] for job, count in known.items()) / min(self._slots, known.total())
        return f", {'about' if len(known) == len(+self._left) else 'over'} {duration(seconds)} left"


def _end_of(future: "Future[End]") -> End:
    try:
        return future.result()
    except Exception as error:  # of the executor: a worker that died, a machine that is gone
        return End(key="", cause=f"lost: {type(error).__name__}: {error}"[:200])


def verdict_in(result: Path) -> dict[str, Any]:
    with suppress(OSError, ValueError):
        document = json.loads(result.read_bytes())
        verdict = document.get("verdict") if isinstance(document, dict) else None
        return verdict if isinstance(verdict, dict) else {}
    return {}


def not_run(node: Node, key: str, folder: Path, *, state: str, cause: str) -> Run:
    return replace(run_of(node, key, End(key=key, cause=cause), folder), state=state)

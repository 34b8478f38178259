"""One node's run in a forked child under limits, with log, result and end.

A runner process has imported the commands, so a node costs only a fork. It reads a node per line of JSON from stdin,
runs one at a time, and exits when stdin ends.
"""

import contextlib
import ctypes
import importlib
import itertools
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NoReturn

from splatctrl_cli.files.output import partial_path, remove, write_durably
from splatctrl_cli.kernels.cuda.memory import num_cards

Entry = Callable[[list[str]], int]

PART = ".part"  # suffix of an incomplete result
_LAST = 4096  # bytes of a log searched for its last lines
_local = threading.local()  # each thread's runner
_runners: list["subprocess.Popen[str]"] = []
_numbers = itertools.count()  # of the runners
VISIBLE, CARD = "CUDA_VISIBLE_DEVICES", "SPLATCTRL_CARD_OF_RUNNER"  # a runner's card, where there are several
BY_THE_BATCH = ("GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY")  # reported by the batch, not by its nodes


@dataclass(frozen=True, kw_only=True)
class Task:
    """Work of a runner: call `entry` with `words`, write `result` (stdout), `log` (stderr), `end`.

    key: the node's key, stored in `end`. timeout [s], memory [bytes]: 0 for no limit.
    """

    entry: str
    words: Sequence[str]
    key: str
    out: str
    result: str
    log: str
    end: str
    timeout: float = 0.0
    memory: int = 0


@dataclass(frozen=True, kw_only=True)
class End:
    """End of a run. exit_code: None if `cause` killed or prevented the run.

    started: [s since 1970]. stamp: changes when the output is rewritten.
    """

    key: str
    exit_code: int | None = None
    cause: str
    started: float = field(default_factory=time.time)
    seconds: float = 0.0
    peak_mb: float = 0.0
    stamp: str = ""


def run_task(task: Task) -> End:
    """Run a task in this thread's runner, unless the task already ended.

    A killed runner is started once more, but not after `stop_runners`.
    """
    known = read_end(Path(task.end), task.key)
    if known is not None and known.exit_code is not None and known.stamp in ("", stamp_of(Path(task.out))):
        return known  # ended by a worker that was lost before it reported
    for _ in range(2):
        runner = getattr(_local, "runner", None)
        if runner is None or runner.poll() is not None:
            runner = _local.runner = _start(task.entry)
        assert runner.stdin is not None and runner.stdout is not None
        try:
            runner.stdin.write(json.dumps(asdict(task)) + "\n")
            runner.stdin.flush()
            line = runner.stdout.readline()
        except (BrokenPipeError, ValueError):  # killed, or closed by stop_runners
            line = ""
        if line:
            return End(**json.loads(line))
        if runner not in _runners:  # ended by stop_runners: another would only delay the end of the batch
            return End(key=task.key, cause="ended with its batch")
        runner.kill()
        runner.wait()
    return End(key=task.key, cause="its runner was killed twice")


def stop_runners() -> None:
    """End every runner of this process, and its run."""
    while _runners:
        runner = _runners.pop()
        assert runner.stdin is not None and runner.stdout is not None
        with contextlib.suppress(OSError):
            runner.stdin.close()
        try:
            runner.wait(2.0)  # [s] for a runner to see that its stdin ended, before it is killed
        except subprocess.TimeoutExpired:  # it still imports the commands, and runs nothing
            runner.kill()
            runner.wait()
        runner.stdout.close()


def read_end(path: Path, key: str) -> End | None:
    """End of a node's run with this key, None without one."""
    try:
        end = End(**json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError):
        return None
    return end if end.key == key else None


def stamp_of(out: Path) -> str:
    """Size and time of an output's run.json, capture.json or file; empty without output."""
    for place in (out / "run.json", out / "capture.json", out):
        with contextlib.suppress(OSError):
            status = place.stat()
            return f"{status.st_size} {status.st_mtime_ns}" if place != out or not out.is_dir() else "folder"
    return ""


def last_lines(log: Path, number: int = 5) -> list[str]:
    """Last lines of a log, without control characters."""
    try:
        with log.open("rb") as stream:
            stream.seek(max(log.stat().st_size - _LAST, 0))
            text = stream.read(_LAST).decode("utf-8", "replace")
    except OSError:
        return []
    lines = ["".join(c for c in line if c.isprintable()) for line in text.replace("\r", "\n").splitlines()]
    return [line for line in lines if line.strip()][-number:]


def _start(entry: str) -> "subprocess.Popen[str]":
    words = [sys.executable, "-m", __name__, entry]
    inherited = {name: value for name, value in os.environ.items() if name not in BY_THE_BATCH}
    environment = {**inherited, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if VISIBLE not in environment and (cards := num_cards()) > 1:
        environment[CARD] = str(next(_numbers) % cards)
    pipe = subprocess.PIPE
    runner = subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, start_new_session=True, env=environment)
    _runners.append(runner)
    return runner


def main(entry: str) -> None:
    """Run tasks from stdin and write their ends to stdout, until stdin ends."""
    module = importlib.import_module(entry.partition(":")[0])
    function: Entry = getattr(module, entry.partition(":")[2])
    getattr(module, "preload", lambda: None)()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pending = b""
    while True:
        while b"\n" not in pending:
            part = os.read(0, 1 << 16)
            if not part:
                return
            pending += part
        line, _, pending = pending.partition(b"\n")
        end = _run(function, Task(**json.loads(line)))
        try:
            os.write(1, (json.dumps(asdict(end)) + "\n").encode())
        except BrokenPipeError:  # its reader is gone; the end is in its file
            return


def _run(function: Entry, task: Task) -> End:
    Path(task.end).parent.mkdir(parents=True, exist_ok=True)
    _clear(task)
    started, start = time.time(), time.perf_counter()
    pid = os.fork()
    if pid == 0:
        _be_child(function, task)
    cause = _wait(pid, task)
    _, status, used = os.wait4(pid, 0)
    if os.WIFSIGNALED(status) and not cause:
        cause = f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    if not cause:
        Path(task.result + PART).replace(task.result)
    end = End(
        key=task.key,
        exit_code=None if cause else os.WEXITSTATUS(status),
        cause=cause,
        started=started,
        seconds=time.perf_counter() - start,
        peak_mb=used.ru_maxrss * 1024 / 1e6,
        stamp=stamp_of(Path(task.out)) if not cause and os.WEXITSTATUS(status) in (0, 1, 3, 5) else "",
    )
    write_durably(Path(task.end), lambda path: path.write_text(json.dumps(asdict(end)) + "\n"))
    return end


def _clear(task: Task) -> None:
    begun = Path(task.end).with_suffix(".begun")
    if begun.is_file() and begun.read_text() != task.key and task.out:
        remove(Path(task.out))
        remove(partial_path(Path(task.out)))
    begun.write_text(task.key)


def _be_child(function: Entry, task: Task) -> NoReturn:
    code = 70
    try:
        os.setsid()
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: the signal when the parent dies
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number, path in ((0, os.devnull), (1, task.result + PART), (2, task.log)):
            os.dup2(os.open(path, os.O_RDWR if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        has_begun = bool(task.out) and partial_path(Path(task.out)).exists()
        words = [word for word in task.words if has_begun or word != "--resume"]  # only with a partial output
        sys.argv = ["splatctrl", *words]
        if CARD in os.environ and not any(word.startswith("cuda:") for word in words):
            os.environ[VISIBLE] = os.environ[CARD]
        code = function(words)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 70
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _wait(pid: int, task: Task) -> str:
    """Wait for the child, or end it and return why. Exits if stdin ends."""
    start, interrupted, cause = time.monotonic(), 0.0, ""
    ended, look = os.pidfd_open(pid), 0.02 if task.memory else 1.0  # [s] between looks at a child's memory
    try:
        while True:
            ready, _, _ = select.select([ended, 0], [], [], look)
            if ended in ready:
                return cause
            if 0 in ready and not os.read(0, 1):  # its reader is gone
                _signal(pid, signal.SIGKILL)
                os._exit(1)
            if task.memory and _memory_of(pid) > task.memory:
                _signal(pid, signal.SIGKILL)
                cause = f"took more memory than {task.memory / 1e6:.0f} MB"
            elif task.timeout and not interrupted and time.monotonic() - start > task.timeout:
                _signal(pid, signal.SIGINT)
                interrupted, cause = time.monotonic(), f"timed out after {task.timeout:g} s"
            elif interrupted and time.monotonic() - interrupted > 10.0:  # [s] from asking a child to end to ending it
                _signal(pid, signal.SIGKILL)
    finally:
        os.close(ended)


def _signal(pid: int, number: signal.Signals) -> None:
    """Signal a child's process group, or the child before it has one."""
    try:
        os.killpg(pid, number)
    except ProcessLookupError:
        os.kill(pid, number)


def _memory_of(pid: int) -> int:
    """Resident memory [bytes], 0 if gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


if __name__ == "__main__":
    main(sys.argv[1])

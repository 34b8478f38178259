"""`python -m benchmarks.kill_test [--kills N]`: kills commands at random moments; partial outputs must not be
readable.

Each command first runs to its end. Then it is killed (SIGKILL) N times, after a random part of that time; every other
time it has --force and an existing output. After each kill, the output must be missing or equal the complete output
(except times and paths in run.json). NAME.partial must be complete, too, or be refused by the tool's readers.
Commands that can resume are killed N times again, every third time once more while they resume (`reconstruct` up to
nine times, on one to four threads). They then end with --resume, and every byte must equal the complete run's, except
times in run.json. Commands run in forked children after their imports, so that the moments fall where files are
written.
"""

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measure import ROBOT, SAMPLE
from splatctrl_cli.cli.common import table
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.files.output import partial_path
from splatctrl_cli.formats.splat.splats import FORMATS
from splatctrl_cli.recording.source import describe, open_source
from tests.formats.splat.test_gaussian_ply import gaussian_set

_OWN = ("seconds", "arguments")  # of run.json
_TIMED = ("run.json", "SHA256SUMS")  # SHA256SUMS holds the sum of run.json where it lists it


@dataclass(frozen=True, kw_only=True)
class Task:
    """A command's arguments before ``-o OUT``, and the name of its output.

    again: how often it is killed while it resumes. threads: numbers of its threads, in turn.
    """

    name: str
    arguments: tuple[str, ...]
    out: str
    resumes: bool = False
    again: int = 1
    threads: tuple[str, ...] = ()


def tasks(folder: Path) -> list[Task]:
    """Tasks to kill; each task may use outputs of earlier tasks."""
    audit = ("replay", str(SAMPLE / "log.mcap"), "--field", str(folder / "field"), *ROBOT, "--max-unknown", "1")
    bake = ("sdf-bake", str(folder / "splats.ply"), "--set", "field.max_loss=1", "--no-report", "--voxel", "0.1")
    fine = (*bake[:-1], "0.06", "--threads", "1")
    fit = ("reconstruct", str(SAMPLE / "log.mcap"), "--cameras", "cam0,cam1,cam2", *ROBOT)
    return [
        Task(name="ingest", arguments=("ingest", str(SAMPLE / "log.mcap")), out="log.capture", resumes=True),
        Task(name="export", arguments=("export", str(folder / "a.ply"), "--isotropic"), out="splats.ply"),
        Task(name="sdf-bake", arguments=bake, out="field"),
        Task(name="sdf-bake, fine", arguments=fine, out="fine", resumes=True),
        Task(name="replay", arguments=audit, out="replay"),
        Task(name="reconstruct", arguments=fit, out="scene", resumes=True, again=9, threads=("1", "2", "4")),
    ]


def run(argv: Sequence[str] | None = None) -> int:
    """Kill each task and print a table; return 1 if a partial output reads as complete."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kill_test", description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", nargs="+", help="names of commands")
    args = parser.parse_args(argv)
    rows, resumed, faults = [], [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        FORMATS[".ply"].write(folder / "a.ply", gaussian_set(2000), {})
        for task in tasks(folder):
            row, found = kill(task, folder, args.kills, random.Random(args.seed), args.only)
            if row:
                rows.append([task.name, *row])
                print("\t".join(map(str, rows[-1])), flush=True)
            faults += found
            if task.resumes and (args.only is None or task.name in args.only):
                row, found = kill_and_resume(task, folder, args.kills, random.Random(args.seed + 1))
                resumed.append([task.name, *row])
                print("\t".join(map(str, resumed[-1])), flush=True)
                faults += found
    print("\n".join(table(["command", "seconds", "killed", "ended first", "left partial", "faults"], rows)))
    print("\n".join(table(["command", "seconds", "kills", "went on", "while going on", "differ"], resumed)))
    print("\n".join(faults))
    return 1 if faults else 0


def kill(
    task: Task, folder: Path, num: int, moments: random.Random, only: Sequence[str] | None = None
) -> tuple[list[object], list[str]]:
    """Run a task to its end, then kill it `num` times; return its row of the table, and faults."""
    out = folder / task.out
    _wait(_start([*task.arguments, "-o", str(out)]), None)  # the first run also imports what it needs
    start = time.monotonic()
    _wait(_start([*task.arguments, "-o", str(out), "--force"]), None)
    seconds = time.monotonic() - start
    if only is not None and task.name not in only:
        return [], []
    whole = contents(out)
    box = folder / "box"
    ended, partial, faults = 0, 0, []
    for number in range(num):
        shutil.rmtree(box, ignore_errors=True)
        box.mkdir()
        target = box / task.out
        is_forced = number % 2 == 1
        if is_forced:
            (shutil.copytree if out.is_dir() else shutil.copy)(out, target)
        force = ["--force"] if is_forced else []
        moment = moments.uniform(0.0, 1.05 * seconds)
        ended += _wait(_start([*task.arguments, "-o", str(target), *force]), moment)
        fault = judge(target, whole)
        partial += partial_path(target).exists()
        if fault:
            faults.append(f"{task.name}, killed after {moment:.3f} s: {fault}")
    return [f"{seconds:.2f}", num - ended, ended, partial, len(faults)], faults


def kill_and_resume(task: Task, folder: Path, num: int, moments: random.Random) -> tuple[list[object], list[str]]:
    """Kill and resume a task `num` times, each time from the start; return its row of the table, and faults."""
    out, box = folder / task.out, folder / "box"
    start = time.monotonic()
    _wait(_start([*task.arguments, "-o", str(out), "--force"]), None)
    seconds = time.monotonic() - start
    whole = exact(out)
    kills, went_on, further, faults = 0, 0, 0, []
    while kills < num:
        shutil.rmtree(box, ignore_errors=True)
        box.mkdir()
        target = box / task.out
        threads = ["--threads", task.threads[kills % len(task.threads)]] if task.threads else []
        arguments = [*task.arguments, "-o", str(target), *threads]
        again = [*arguments, "--resume", "--force"]  # it may have been killed when all was done
        moment = moments.uniform(0.0, seconds)
        if _wait(_start(arguments), moment):
            continue
        kills += 1
        went_on += partial_path(target).exists()
        for _ in range(task.again if kills % 3 == 0 or task.threads else 0):
            if _wait(_start(again), moments.uniform(0.0, seconds / task.again)):
                break
            kills, further = kills + 1, further + 1
        _wait(_start(again), None)
        if exact(target) != whole or partial_path(target).exists():
            faults.append(f"{task.name}, killed after {moment:.3f} s: goes on to other bytes")
    return [f"{seconds:.2f}", kills, went_on, further, len(faults)], faults


def exact(path: Path) -> dict[str, object]:
    """sha256 of each file of a folder, by name; for run.json, its content without times and paths."""
    found: dict[str, object] = {}
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        data, name = file.read_bytes(), str(file.relative_to(path))
        if file.name == "run.json":
            found[name] = {key: value for key, value in json.loads(data).items() if key not in _OWN}
        elif file.name == "SHA256SUMS":
            found[name] = [line for line in data.decode().splitlines() if not line.endswith("run.json")]
        else:
            found[name] = hashlib.sha256(data).hexdigest()
    return found


def judge(target: Path, whole: dict[str, str]) -> str:
    """The fault in the output that a killed run left; "" without a fault."""
    if target.exists() and contents(target) != whole:
        return f"{target.name} is there and differs"
    left = partial_path(target)
    if left.exists() and contents(left) != whole and _reads(left):
        return f"{left.name} reads as whole"
    return ""


def contents(path: Path) -> dict[str, str]:
    """sha256 of each file, by name in the output; for files with times, whether they end as they should."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    found = {}
    for file in files:
        name = str(file.relative_to(path)) if path.is_dir() else ""
        data = file.read_bytes()
        found[name] = str(data.endswith(b"\n")) if file.name in _TIMED else hashlib.sha256(data).hexdigest()
    return found


def _reads(path: Path) -> bool:
    """Whether a reader takes it as it is, without a word."""
    try:
        if path.is_dir():
            source = open_source(path)
            num = sum(1 for _ in source.records())
            return num > 0 and not source.loss.damaged
        return not describe(path).damaged
    except SplatCtrlError:
        return False


def _start(arguments: list[str]) -> int:
    child = os.fork()
    if child == 0:
        code = 70
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            with contextlib.suppress(SystemExit):
                code = main(arguments)
        finally:
            os._exit(code)
    return child


def _wait(child: int, moment: float | None) -> bool:
    """Wait for a child, or kill it at `moment` [s]; return True if it ended by itself. Raises if it failed."""
    start = time.monotonic()
    while moment is None or time.monotonic() - start < moment:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            if code not in {0, 1}:
                raise SystemExit(f"a command that was not killed ended with {code}")
            return True
        time.sleep(0.001)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


if __name__ == "__main__":
    sys.exit(run())

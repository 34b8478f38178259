"""Medians of wall time, and what a benchmark hands back."""

import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatctrl_cli.kernels import num_threads
from splatctrl_cli.records import Float64

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data" / "tabletop"
ROBOT = ("--urdf", str(SAMPLE / "robot.urdf"), "--spheres", str(SAMPLE / "robot_spheres.yaml"))


@dataclass(frozen=True, kw_only=True)
class Options:
    """is_quick: fewer repeats, small sizes only. with_demo: time `splatctrl demo` as well. plots: folder for the
    plots of docs/, None to write none.
    """

    is_quick: bool
    with_demo: bool = False
    plots: Path | None = None

    def rounds(self, full: int) -> int:
        """How often to repeat what a full run repeats `full` times."""
        return max(3, full // 4) if self.is_quick else full


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A bound of a figure: its largest or, with `is_least`, its least allowed value."""

    figure: str
    bound: float
    is_least: bool = False

    def holds(self, value: float) -> bool:
        """Whether `value` keeps the bound."""
        return value >= self.bound if self.is_least else value <= self.bound


@dataclass(frozen=True, kw_only=True)
class Result:
    """What one benchmark measured.

    columns, rows: the printed table. figures: its numbers by name; a name ends in the unit. ratios: how many times
    faster than a reference of the same run (larger is better); they are comparable between machines and days. more:
    lines of further tables.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    figures: Mapping[str, float] = field(default_factory=dict)
    ratios: Mapping[str, float] = field(default_factory=dict)
    limits: Sequence[Limit] = ()
    notes: Sequence[str] = ()
    more: Sequence[str] = ()


def seconds(task: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Time of one call, by default on the wall's clock."""
    start = clock()
    task()
    return clock() - start


def medians(
    tasks: Mapping[str, Callable[[], object]],
    rounds: int,
    *,
    num_untimed: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median seconds of each task over `rounds`, after `num_untimed` more.

    The tasks take turns, so that a temporary slowdown of the machine slows all tasks.
    """
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for index in range(num_untimed + rounds):
        for name, task in tasks.items():
            elapsed = seconds(task, clock)
            if index >= num_untimed:
                times[name].append(elapsed)
    return {name: statistics.median(values) for name, values in times.items()}


@dataclass(frozen=True, kw_only=True)
class Spent:
    """Cost of a process: wall, user and system time [s], largest resident memory [MiB], and its exit code."""

    seconds: float
    processor_s: float
    mebibytes: float
    code: int


_WAIT = """
import resource, subprocess, sys, time
start = time.perf_counter()
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
seconds, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
print(seconds, used.ru_utime + used.ru_stime, used.ru_maxrss, code)
"""


def measured(command: Sequence[str]) -> Spent:
    """Run a command and wait for it, from a small process: a child's largest memory begins with its parent's."""
    waiting = [sys.executable, "-S", "-c", _WAIT, *command]
    answer = subprocess.run(waiting, capture_output=True, text=True, check=True)
    seconds, processor, memory, code = answer.stdout.split()[-4:]
    per_mebibyte = 2**20 if sys.platform == "darwin" else 2**10
    mebibytes = float(memory) / per_mebibyte
    return Spent(seconds=float(seconds), processor_s=float(processor), mebibytes=mebibytes, code=int(code))


def rms(error: Float64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(error**2)))


class OtherLoad:
    """Number of cores that other processes keep busy, from its creation on. On a shared machine, it affects every
    figure.
    """

    def __init__(self) -> None:
        self._start, self._before = time.perf_counter(), _others_seconds()

    def cores(self) -> float:
        """Mean number of cores; 0 where the system does not say."""
        return max(0.0, _others_seconds() - self._before) / (time.perf_counter() - self._start)


def _others_seconds() -> float:
    """Busy seconds of all cores, without this process and the children that it has waited for."""
    stat = Path("/proc/stat")
    if not stat.is_file():
        return 0.0
    user, nice, system, _, _, irq, soft_irq, steal = map(
        int, stat.read_text(encoding="ascii").splitlines()[0].split()[1:9]
    )
    busy = (user + nice + system + irq + soft_irq + steal) / os.sysconf("SC_CLK_TCK")
    return busy - sum(os.times()[:4])


def machine() -> dict[str, str | int]:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    return {
        "processor": model,
        "cores": num_threads(),
        "system": platform.system(),
        "python": platform.python_version(),
    }

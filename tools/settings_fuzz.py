"""`python -m tools.settings_fuzz`: tries each configuration key with invalid values, and a command that uses it.

A value must be refused (exit 2, a line with key, range and value, nothing left behind) or be harmless (exit 0, 1 or 5
in time). Faults are: a crash, a hang, another exit code, an accepted value out of range, or a refusal in other words.
"""

import argparse
import importlib
import math
import os
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from splatctrl_cli.cli.common import table
from splatctrl_cli.cli.main import main as splatctrl
from splatctrl_cli.config import Config
from splatctrl_cli.config.ranges import Section, Within

NUMBERS = ("nan", "inf", "-inf", "0", "0.0", "-0.0", "1e308", "-1e308", "1e-320", "9" * 400, "'word'", "true", "[]")
WORDS = ("bogus", "''", "nan", "0", "true", "[]")
HARMLESS = (0, 1, 5)
TIME_LIMIT = 60.0  # [s] of a command that takes about two
WARM = (
    "numpy",
    "scipy.spatial",
    "cv2",
    "pinocchio",
    "clarabel",
    "matplotlib.figure",
    "rosbags.typesys",
    "mcap.reader",
)
FAST = (
    "scene.first_iterations=4",
    "scene.iterations_per_step=1",
    "scene.refine_iterations=2",
    "scene.max_splats=300",
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A key of a section and what is assigned to it."""

    section: str
    key: str
    text: str

    @property
    def is_in_range(self) -> bool:
        """True if the value is valid for the key, without regard to other keys."""
        kind = type(getattr(section_of(self.section), self.key))
        try:
            value = tomllib.loads(f"value = {self.text}")["value"]
        except ValueError:
            value = self.text
        if kind is str and type(value) is not str:  # a bare word that is a number to TOML
            value = self.text
        if kind is float and type(value) is int:
            value = float(value) if abs(value) < 1 << 1023 else math.inf
        return type(value) is kind and section_of(self.section).declared[self.key].holds(value)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a case's command: its exit code (None if killed at the time limit), its output, and the fault."""

    case: Case
    code: int | None
    seconds: float
    said: str
    fault: str


def section_of(name: str) -> type[Section]:
    """The class of a section."""
    section = type(getattr(Config(), name))
    assert issubclass(section, Section)
    return section


def cases() -> Iterator[Case]:
    """Every key with every value."""
    for section in fields(Config):
        for key, declared in section_of(section.name).declared.items():
            for text in NUMBERS if isinstance(declared, Within) else WORDS:
                yield Case(section=section.name, key=key, text=text)


def fault_of(case: Case, code: int | None, said: str, left: Sequence[str]) -> str:
    """The fault in a command's end, given the files that it left; "" without a fault."""
    if code is None:
        return "hang"
    if code < 0:
        return f"crash by signal {-code}"
    if code == 2:
        is_told = all(word in said for word in (f"{case.section}.{case.key}", "expected", "got")) and len(said) < 600
        return "" if is_told and not left else "left behind: " + ", ".join(left) if left else "refused in other words"
    if code not in HARMLESS:
        return f"exit {code}"
    return "" if case.is_in_range else "taken out of its range"


class Desk:
    """Small inputs, made once, and the command that uses each section."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        log, quiet = folder / "log", ("--threads", "1", "-q")
        self._make_channels("simulate", "-o", log, "--duration", "0.6", "--width", "64", "--height", "48", "-q")
        robot = ("--urdf", log / "robot.urdf", "--spheres", log / "robot_spheres.yaml")
        fast = [word for setting in FAST for word in ("--set", setting)]
        made = ("reconstruct", log / "log.mcap", *robot, *quiet, *fast)
        self._make_channels(*made, "-o", folder / "scene")
        drive = ("replay", log / "log.mcap", "--scene", folder / "scene", *robot, *quiet, "--mode", "closed-loop")
        short = (*drive, "--set", "control.max_time=0.2", "--set", "planner.max_iterations=20")
        stalling = [f"--set=control.{name}" for name in ("max_detours=1", "stall_time=0.02", "stall_speed=10")]
        coarse = ("--set", "field.max_loss=1", "--set", "field.voxel=0.05")
        self.commands: dict[str, tuple[object, ...]] = {
            **dict.fromkeys(("scene", "occupancy", "human"), made),
            "field": ("sdf-bake", folder / "scene", *quiet, *coarse, "--no-report"),
            **dict.fromkeys(("control", "verdict"), short),
            "planner": (*short, *stalling),
        }

    def ask(self, case: Case, limit: float = TIME_LIMIT) -> Outcome:
        """Run the command that uses a key with a value for it."""
        with tempfile.TemporaryDirectory(dir=self.folder) as name:
            out = Path(name) / "out"
            setting = ("--set", f"{case.section}.{case.key}={case.text}")
            code, said, seconds = run((*self.commands[case.section], *setting, "-o", out), limit)
            left = sorted(path.name for path in Path(name).iterdir())
        return Outcome(case=case, code=code, seconds=seconds, said=said, fault=fault_of(case, code, said, left))

    def _make_channels(self, *words: object) -> None:
        code, said, _ = run(words, 10 * TIME_LIMIT)
        if code != 0:
            raise SystemExit(f"{words[0]}: exit {code}: {said}")


def run(words: Sequence[object], limit: float) -> tuple[int | None, str, float]:
    """Exit code (None at the limit [s], negative for a signal), stderr, and seconds of a command in a fork of this
    process, which has everything imported.
    """
    with tempfile.TemporaryFile("w+b") as said:
        start = time.perf_counter()
        child = os.fork()
        if child == 0:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(said.fileno(), 2)
            code = 70
            try:
                code = splatctrl([str(word) for word in words])
                sys.stderr.flush()
            finally:
                os._exit(code)
        status = _waited(child, start + limit)
        seconds = time.perf_counter() - start
        said.seek(0)
        text = said.read().decode("utf-8", "replace")
    return (None if status is None else os.waitstatus_to_exitcode(status)), text, seconds


def _waited(child: int, end: float) -> int | None:
    while time.perf_counter() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def main(argv: Sequence[str] | None = None) -> int:
    """Run every case and print a table by section, then each fault; return 1 if there is one."""
    parser = argparse.ArgumentParser(prog="python -m tools.settings_fuzz", description=__doc__, allow_abbrev=False)
    parser.add_argument("--only", default="", metavar="TEXT", help="keys that begin so, like control. (default: all)")
    args = parser.parse_args(argv)
    wanted = [case for case in cases() if f"{case.section}.{case.key}".startswith(args.only)]
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    for name in WARM:  # so that no fork has to
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as name:
        desk = Desk(Path(name))
        outcomes: list[Outcome] = []
        for case in wanted:
            if not outcomes or outcomes[-1].case.key != case.key:
                print(f"{len(outcomes)} of {len(wanted)}: {case.section}.{case.key}", file=sys.stderr, flush=True)
            outcomes.append(desk.ask(case))
            if outcomes[-1].fault:
                print(
                    f"{case.section}.{case.key}={case.text[:20]}: {outcomes[-1].fault}: {outcomes[-1].said.strip()}"
                )
    for line in table_of(outcomes):
        print(line)
    return int(any(outcome.fault for outcome in outcomes))


def table_of(outcomes: Sequence[Outcome]) -> list[str]:
    """A row per section: keys, cases, how they ended, and the slowest."""
    rows = []
    for name in (*dict.fromkeys(outcome.case.section for outcome in outcomes), "all"):
        own = [outcome for outcome in outcomes if name in {"all", outcome.case.section}]
        ends = Counter("fault" if o.fault else "refused" if o.code == 2 else "harmless" for o in own)
        keys = len({(o.case.section, o.case.key) for o in own})
        counts = [str(ends[end]) for end in ("refused", "harmless", "fault")]
        rows.append([name, str(keys), str(len(own)), *counts, f"{max(o.seconds for o in own):.1f}"])
    return table(("section", "keys", "cases", "refused", "harmless", "faults", "slowest [s]"), rows)


if __name__ == "__main__":
    raise SystemExit(main())

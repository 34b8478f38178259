"""`python -m benchmarks.fuzz --minutes N`: mutated inputs must neither crash, hang, nor write where they should not.

Each input is a small valid input with some bytes, numbers or lengths changed; its seed reproduces it. A child process
reads the input under limits of memory and time. It must end with an exit code listed in `splatctrl --help`, one line
on stderr and no traceback. It may write files only in the output, and none if it refused the input.
"""

import argparse
import collections
import contextlib
import os
import random
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzz_mutate import mutated
from benchmarks.fuzz_samples import Sample, make_samples
from splatctrl_cli.cli.commands import COMMANDS
from splatctrl_cli.cli.common import table
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import SplatCtrlError

ALLOWED = {0, 1, 2, 3, 4, 5, 6}
MEMORY = 1 << 30  # bytes of address space a child may add
SECONDS = 20
JOINTS = ("joint_a", "joint_b")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one input; `fault` is "" without a fault."""

    sample: str
    command: str
    seed: int
    code: int
    seconds: float
    peak_mib: int
    fault: str
    said: str


def campaign(samples: Sequence[Sample], folder: Path, *, seed: int, stop: float, most: int) -> Iterator[Outcome]:
    """Yield outcomes of at most `most` inputs, numbered from `seed`, until time.monotonic exceeds `stop`."""
    for number in range(seed, seed + most):
        if time.monotonic() > stop:
            return
        yield attempt(samples, folder, number)


def attempt(samples: Sequence[Sample], folder: Path, seed: int) -> Outcome:
    """Mutate one input by its seed, read it by one command in a child process, and judge what happens."""
    rng = random.Random(seed)
    sample = samples[seed % len(samples)]
    command = rng.choice(sample.commands)
    box = folder / "box"
    shutil.rmtree(box, ignore_errors=True)
    (box / "out").mkdir(parents=True)
    given = _mutated_copy(sample, box / "in", rng)
    before = _files(folder)
    start = time.monotonic()
    code, peak = _in_child([_filled(part, given, box) for part in command], box)
    seconds = time.monotonic() - start
    said = (box / "said").read_text(errors="replace") if (box / "said").exists() else ""
    (box / "said").unlink(missing_ok=True)
    fault = fault_of(code, seconds, said, _files(folder) - before, box)
    return Outcome(
        sample=sample.name,
        command=" ".join(command[:2] if command[0] == "robot" else command[:1]),
        seed=seed,
        code=code,
        seconds=seconds,
        peak_mib=peak,
        fault=fault,
        said=said[-2000:],
    )


def _filled(part: str, given: Path, box: Path) -> str:
    if part == "IN":
        return str(given)
    return str(box / part.lower().replace("out", "out/x")) if part.startswith("OUT") else part


def _mutated_copy(sample: Sample, folder: Path, rng: random.Random) -> Path:
    """A copy of the sample with one or two of its files changed, or removed."""
    root = sample.path if sample.path.is_dir() else sample.path.parent
    chosen = {rng.choice(sample.files) for _ in range(rng.choice([1, 1, 1, 2]))}
    for file in sample.files:
        target = folder / root.name / file.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        if file not in chosen:
            target.write_bytes(file.read_bytes())
        elif rng.random() < 0.05:
            no_file(target, rng)
        elif len(sample.files) == 1 or rng.random() > 0.05:
            target.write_bytes(mutated(file.read_bytes(), rng))
    return folder / root.name / sample.path.relative_to(root)


def no_file(path: Path, rng: random.Random) -> None:
    """Put something other than a file at `path`; reading it may wait forever or never end."""
    match rng.choice(["fifo", "folder", "loop", "endless", "nowhere", "socket"]):
        case "fifo":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "loop":
            path.symlink_to(path.name)
        case "endless":
            path.symlink_to("/dev/zero")
        case "nowhere":
            path.symlink_to("nothing")
        case "socket":
            os.mknod(path, stat.S_IFSOCK | 0o600)


def _in_child(arguments: list[str], box: Path) -> tuple[int, int]:
    """Exit code (negative: the signal) and peak of the memory [MiB] of a forked child that runs the command."""
    child = os.fork()
    if child == 0:
        _run(arguments, box)
    start = time.monotonic()
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss >> 10
        if time.monotonic() - start > SECONDS:
            os.kill(child, signal.SIGKILL)
            os.wait4(child, 0)
            return -int(signal.SIGALRM), 0
        time.sleep(0.002)


def _run(arguments: list[str], box: Path) -> None:
    """Run a command in the child with limited memory and all output in one file; never return."""
    code = 70
    try:
        said = os.open(box / "said", os.O_WRONLY | os.O_CREAT)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.chdir(box / "out")
        limit = _address_space() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = _states(Path(arguments[1])) if arguments[0] == "states" else main(arguments)
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else 70
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _states(path: Path) -> int:
    """What `replay` reads of a log."""
    from splatctrl_cli.recording.source_options import SourceOptions
    from splatctrl_cli.recording.state.state_source import open_states

    try:
        source = open_states(path, SourceOptions(), JOINTS)
        for _ in source.records():
            pass
    except SplatCtrlError as error:
        print(f"splatctrl: {error}", file=sys.stderr)
        return error.exit_code
    except (MemoryError, RecursionError, OSError):
        return 4  # as the command line has it
    return 3 if source.loss.damaged else 0


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.name != "said"}


def fault_of(code: int, seconds: float, said: str, new: set[Path], box: Path) -> str:
    """Why this outcome is not as it should be; empty if it is."""
    if code == -signal.SIGALRM:
        return f"hangs: over {SECONDS} s"
    if code < 0:
        return f"dies of {signal.Signals(-code).name}"
    if code not in ALLOWED:
        return f"exit code {code}"
    if "Traceback" in said:
        return "prints a traceback"
    outside = [path for path in new if not path.is_relative_to(box / "out")]
    if outside:
        return f"writes outside its output: {outside[0]}"
    if code not in {0, 1, 3} and any((box / "out").iterdir()):
        return "leaves an output behind"
    if any(path.name.endswith(".partial") for path in (box / "out").iterdir()):
        return "leaves a partial output behind"
    return ""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Nothing is printed in the block."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):  # noqa: PTH123
        yield


def warm_up(samples: Sequence[Sample], folder: Path) -> None:
    """Import the commands' modules, so that each child starts with them; check that every valid sample is read."""
    box = folder / "box"
    for sample in samples:
        for command in sample.commands:
            shutil.rmtree(box, ignore_errors=True)
            (box / "out").mkdir(parents=True)
            with quiet():
                arguments = [_filled(part, sample.path, box) for part in command]
                code = _states(sample.path) if command[0] == "states" else main(arguments)
            if code not in {0, 1}:
                raise SystemExit(f"the valid sample {sample.name} is not read by {' '.join(command)}: {code}")


def _keep(box: Path, kept: Path) -> None:
    """Copy an input, whatever it is made of."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(["cp", "-a", str(box), str(kept)], check=True)


def run(argv: Sequence[str] | None = None) -> int:
    """Run a campaign; return 1 if a fault was found. Its input is kept in --keep."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first input; the others follow")
    parser.add_argument("--most", type=int, default=1_000_000, help="inputs")
    parser.add_argument("--keep", type=Path, default=Path("bench_output/fuzz"), help="folder for inputs at fault")
    parser.add_argument("--kinds", nargs="+", help="of input; default: all")
    args = parser.parse_args(argv)
    found: collections.Counter[tuple[str, str]] = collections.Counter()
    codes: collections.Counter[int] = collections.Counter()
    faults: list[Outcome] = []
    slowest, which, peak, largest = 0.0, 0, 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "samples").mkdir()
        samples = make_samples(folder / "samples", tuple(COMMANDS))
        samples = [s for s in samples if args.kinds is None or s.name in args.kinds]
        warm_up(samples, folder)
        start = time.monotonic()
        stop = start + 60 * args.minutes
        for outcome in campaign(samples, folder, seed=args.seed, stop=stop, most=args.most):
            found[(outcome.sample, outcome.command)] += 1
            codes[outcome.code] += 1
            if outcome.seconds > slowest:
                slowest, which = outcome.seconds, outcome.seed
            if outcome.peak_mib > peak:
                peak, largest = outcome.peak_mib, outcome.seed
            if outcome.fault:
                faults.append(outcome)
                kept = args.keep / str(outcome.seed)
                shutil.rmtree(kept, ignore_errors=True)
                _keep(folder / "box" / "in", kept)
                print(
                    f"seed {outcome.seed}: {outcome.sample} {outcome.command}: {outcome.fault}\n{outcome.said}",
                    flush=True,
                )
    print("\n".join(table(["input", "command", "tried"], [[*key, n] for key, n in sorted(found.items())])))
    print(f"exit codes: {', '.join(f'{code}: {n}' for code, n in sorted(codes.items()))}")
    print(f"{codes.total()} inputs in {time.monotonic() - start:.0f} s, peak {peak} MiB, seed {largest}")
    print(f"slowest: {slowest:.1f} s, seed {which}")
    print(f"{len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(run())

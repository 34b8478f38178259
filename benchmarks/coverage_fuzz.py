"""`python -m benchmarks.coverage_fuzz --minutes N`: coverage-guided fuzzing of the readers, with atheris.

atheris (PyPI, no dependency) instruments this program's Python and keeps the inputs that reach new code. Each reader
of `benchmarks.readers` runs in a process of its own for its share of the time. A fault is an undeclared exception, an
input that takes over 20 s, or a process that dies or grows beyond 2 GiB. A fault does not end the run; its input is
kept.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.cli.common import table
from splatctrl_cli.cli.main import MAX_PIXELS

MEMORY, SECONDS = 2048, 20  # [MiB], for one input
LONGEST = 1 << 16  # bytes of an input
_STATUS = re.compile(rb"#(\d+)\s+(?:INITED|NEW|REDUCE|pulse|DONE|RELOAD)\s+cov: (\d+)")
_STARTED = re.compile(rb"INITED\s+cov: (\d+)")


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """What came of one reader."""

    executions: int
    seconds: float
    first_coverage: int
    coverage: int
    faults: tuple[str, ...]


def fuzz(name: str, folder: Path, seconds: int) -> None:
    """In a process of its own: run one reader; never returns."""
    import atheris

    with atheris.instrument_imports(include=["splatctrl_cli"]):
        from benchmarks.readers import all_readers

        reader = next(r for r in all_readers(folder / "readers") if r.name == name)
    corpus, kept = folder / "corpus", folder / "faults"
    for place in (corpus, kept):
        place.mkdir()
    for number, seed in enumerate(reader.seeds):
        (corpus / f"seed{number}").write_bytes(seed)
    seen: set[str] = set()
    warnings.simplefilter("ignore")

    def one_input(data: bytes) -> None:
        try:
            reader.read(data)
        except (*reader.errors, MemoryError):
            pass
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"
            if place not in seen:
                seen.add(place)
                (kept / hashlib.sha1(data).hexdigest()).write_bytes(data)
                (kept / "faults.json").write_text(json.dumps(sorted(seen)))

    limits = [f"-rss_limit_mb={MEMORY}", f"-timeout={SECONDS}", f"-max_len={LONGEST}"]
    atheris.Setup([name, str(corpus), f"-max_total_time={seconds}", *limits, f"-artifact_prefix={kept}/"], one_input)
    atheris.Fuzz()


def campaign(name: str, folder: Path, seconds: int, keep: Path) -> Campaign:
    """Fuzz one reader for so long."""
    folder.mkdir()
    command = [sys.executable, "-m", "benchmarks.coverage_fuzz", "--one", name, str(folder), str(seconds)]
    start = time.monotonic()
    limits = os.environ | {"OPENCV_IO_MAX_IMAGE_PIXELS": str(MAX_PIXELS)}  # as the command line has it
    done = subprocess.run(command, capture_output=True, check=False, env=limits)
    took = time.monotonic() - start
    statuses, started = _STATUS.findall(done.stderr), _STARTED.findall(done.stderr)
    told = folder / "faults" / "faults.json"
    faults = json.loads(told.read_text()) if told.is_file() else []
    if done.returncode:
        faults.append(f"ended with {done.returncode}: {done.stderr.decode(errors='replace').splitlines()[-1:]}")
    for file in (folder / "faults").glob("*") if faults else ():
        keep.mkdir(parents=True, exist_ok=True)
        (keep / f"{name}-{file.name}").write_bytes(file.read_bytes())
    return Campaign(
        executions=int(statuses[-1][0]) if statuses else 0,
        seconds=took,
        first_coverage=int(started[0]) if started else 0,
        coverage=int(statuses[-1][1]) if statuses else 0,
        faults=tuple(faults),
    )


def run(argv: Sequence[str] | None = None) -> int:
    """Fuzz each reader in turn and print a table; return 1 if a fault was found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="of all readers together")
    parser.add_argument("--only", nargs="+", help="names of readers")
    parser.add_argument("--keep", type=Path, default=Path("bench_output/fuzz"), help="folder for inputs at fault")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.one:
        fuzz(args.one[0], Path(args.one[1]), int(args.one[2]))
    from benchmarks.readers import all_readers

    rows, faults = [], []
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        names = args.only or [reader.name for reader in all_readers(Path(name) / "first")]
        seconds = max(1, round(60 * args.minutes / len(names)))
        for number, reader in enumerate(names):
            found = campaign(reader, Path(name) / str(number), seconds, args.keep)
            faults += [f"{reader}: {fault}" for fault in found.faults]
            figures = (
                found.executions,
                round(found.seconds),
                found.first_coverage,
                found.coverage,
                len(found.faults),
            )
            rows.append([reader, *figures])
            print("\t".join(map(str, rows[-1])), flush=True)
    print("\n".join(table(["reader", "inputs", "seconds", "reached at first", "at last", "faults"], rows)))
    print("\n".join(faults))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(run())

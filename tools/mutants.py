"""Plant the bugs of mutants.toml one at a time in a copy of the project, and see whether the tests notice.

``python -m tools.mutants`` prints killed or survived for each bug, and the share killed by room. ``--room R`` or
``--only NAME`` selects bugs. It ends with 1 if a bug survived. A test run that takes too long counts as killed.

An entry is ``[room.what-is-wrong]`` with four keys. `file` is the name of a file below splatctrl_cli/ or
experiments/; `old` is text that the file contains once. `new` replaces `old`; `tests` are names of test files. Names,
not paths, let files move.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).parent.parent
TABLE = Path(__file__).with_name("mutants.toml")
PLANTED = ("splatctrl_cli", "experiments")  # where bugs are planted
TESTS = ("tests", "experiments/tests")
COPIED = (*PLANTED, "tests", "tools")  # everything else is linked to
PREBUILT = "_native_*.so"
# An editable install finds the package where it is; in the copy, the copy's is wanted.
IN_THE_COPY = """import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "Redirecting" not in type(finder).__name__]
"""


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One bug: in `file`, `new` replaces `old`; `tests` should fail."""

    room: str
    name: str
    file: str
    old: str
    new: str
    tests: Sequence[str]

    def place(self, root: Path) -> Path:
        """The file below `root`. Raises ValueError unless exactly one file of that name contains `old`, once."""
        places = sorted(path for room in PLANTED for path in (root / room).rglob(self.file))
        counts = {path: path.read_text().count(self.old) for path in places}
        if list(filter(None, counts.values())) != [1]:
            raise ValueError(f"{self.name}: expected the text once in {self.file}, got {sum(counts.values())} times")
        return max(counts, key=counts.__getitem__)

    def test_files(self, root: Path) -> list[Path]:
        """Raises ValueError for a name that no test file has."""
        found = {name: [p for room in TESTS for p in sorted((root / room).rglob(name))] for name in self.tests}
        if not found or not all(found.values()):
            raise ValueError(f"{self.name}: no test file {', '.join(name for name in found if not found[name])}")
        return [path for paths in found.values() for path in paths]


def read_mutants(path: Path = TABLE) -> list[Mutant]:
    """The table, in its order."""
    rooms = tomllib.loads(path.read_text())
    return [
        Mutant(room=room, name=name, **entry) for room, entries in rooms.items() for name, entry in entries.items()
    ]


@contextmanager
def copied(root: Path = ROOT) -> Iterator[Path]:
    """A copy of the project in which python finds the copy's package."""
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        copy = Path(folder)
        for path in root.iterdir():
            if path.name in COPIED:
                shutil.copytree(path, copy / path.name, ignore=shutil.ignore_patterns("__pycache__"))
            elif not path.name.startswith(".") and path.name != "build":
                (copy / path.name).symlink_to(path)
        (copy / "sitecustomize.py").write_text(IN_THE_COPY)
        from splatctrl_cli.kernels import native

        for library in Path(native.__file__).parent.glob(PREBUILT):
            shutil.copy(library, copy / "splatctrl_cli" / "kernels")
        yield copy


def tested(copy: Path, files: Sequence[Path], limit_s: float, *, plain: bool = False) -> str:
    """Result of the tests: `passed`, `failed`, `too slow`, or another end. plain: use the kernels of `build`."""
    command = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *map(str, files)]
    environment = os.environ | {"PYTHONPATH": str(copy), "SPLATCTRL_KERNELS": "base" if plain else "auto"}
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return "too slow"
    tail = done.stdout.decode(errors="replace").strip().splitlines()[-1:]
    return {0: "passed", 1: "failed"}.get(done.returncode, f"exit code {done.returncode}: {''.join(tail)}")


def build(copy: Path) -> str:
    """Compile the plain kernels of the copy; return the first error, or ""."""
    folder = copy / "build"
    steps = [["cmake", "-S", str(copy), "-B", str(folder), "-G", "Ninja", f"-DPython_EXECUTABLE={sys.executable}"]]
    steps = [] if folder.is_dir() else steps
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    for step in [*steps, ["cmake", "--build", str(folder), "--target", "_native_base"]]:
        done = subprocess.run(step, env=os.environ | {"PATH": path}, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stdout + done.stderr).splitlines()
            return next((line for line in said if "error" in line), "\n".join(said))
    for library in folder.glob("_native_base*.so"):
        shutil.copy(library, copy / "splatctrl_cli" / "kernels")
    return ""


def tried(mutant: Mutant, copy: Path, limit_s: float) -> str:
    """Result of the tests on a copy with the bug; the bug is then removed."""
    place, files = mutant.place(copy), mutant.test_files(copy)
    text = place.read_text()
    is_compiled = place.suffix != ".py"
    try:
        place.write_text(text.replace(mutant.old, mutant.new))
        complaint = build(copy) if is_compiled else ""
        return f"does not compile: {complaint}" if complaint else tested(copy, files, limit_s, plain=is_compiled)
    finally:
        place.write_text(text)
        if is_compiled:
            build(copy)


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the bugs, and print the shares; return 1 if one survived or could not be tried."""
    args = _parser().parse_args(arguments)
    mutants = [
        mutant
        for mutant in read_mutants()
        if args.room in {None, mutant.room} and (not args.only or mutant.name in args.only)
    ]
    if not mutants:
        raise SystemExit("mutants: none of that name or room")
    killed: dict[str, bool] = {}
    with ExitStack() as stack, ThreadPoolExecutor(args.jobs) as pool:
        copies: SimpleQueue[Path] = SimpleQueue()
        for _ in range(min(args.jobs, len(mutants))):
            copies.put(stack.enter_context(copied()))
        complaint = _sound(mutants, copies, args.limit)
        if complaint:
            raise SystemExit(f"mutants: without a bug the tests end with: {complaint}")

        def in_turn(mutant: Mutant) -> tuple[Mutant, str, float]:
            copy, started = copies.get(), time.monotonic()
            try:
                return mutant, tried(mutant, copy, args.limit), time.monotonic() - started
            finally:
                copies.put(copy)

        for mutant, outcome, seconds in pool.map(in_turn, mutants):
            killed[mutant.name] = outcome in {"failed", "too slow"}
            said = {"passed": "SURVIVED", "failed": "killed", "too slow": "killed by time"}.get(outcome, outcome)
            print(f"{mutant.room}: {mutant.name}: {said}, {seconds:.0f} s", flush=True)
    for room in dict.fromkeys(mutant.room for mutant in mutants):
        own = [killed[mutant.name] for mutant in mutants if mutant.room == room]
        print(f"{room}: {sum(own)} of {len(own)} killed")
    return int(not all(killed.values()))


def _sound(mutants: Sequence[Mutant], copies: SimpleQueue[Path], limit_s: float) -> str:
    """Return "" if all tests of the bugs pass without a bug, because a test that fails anyway kills nothing."""
    copy = copies.get()
    try:
        is_compiled = any(mutant.place(copy).suffix != ".py" for mutant in mutants)
        complaint = build(copy) if is_compiled else ""
        files = dict.fromkeys(path for mutant in mutants for path in mutant.test_files(copy))
        outcome = complaint or tested(copy, list(files), limit_s * len(files), plain=is_compiled)
        return "" if outcome == "passed" else outcome
    finally:
        copies.put(copy)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.mutants", description=__doc__, allow_abbrev=False)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these alone")
    parser.add_argument("--room", metavar="ROOM", help="those of one room alone")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="copies at work (default: 1)")
    parser.add_argument("--limit", type=float, default=180.0, metavar="S", help="for one test run (default: 180)")
    return parser


if __name__ == "__main__":
    sys.exit(main())

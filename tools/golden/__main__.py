"""Run the commands of cases.toml and compare digests of all that they write with digests.txt.

``python -m tools.golden`` runs all of them; ``python -m tools.golden readme-replay`` runs one case and the cases that
it needs. It ends with 1 if a digest changed. ``--write`` renews digests.txt; ``--out FOLDER`` keeps the outputs, to
be compared by hand.
"""

import argparse
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from splatctrl_cli.kernels import arithmetic
from tools.golden.digest import lines, of_json, parse, stamps, written

ROOT = Path(__file__).parent.parent.parent
CASES = Path(__file__).with_name("cases.toml")
DIGESTS = Path(__file__).with_name("digests.txt")
# With AVX-512, NumPy and OpenCV round otherwise: the last digit of a logarithm, pixels of an enlarged photo.
AT_MOST_AVX2 = {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR", "OPENCV_IPP": "avx2"}
LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "matplotlib", "pin", "clarabel", "daqp")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A command line without its program, the command before it, and the cases and recording that it needs."""

    run: str
    before: str = ""
    needs: Sequence[str] = ()
    data: str = ""


def read_cases(path: Path = CASES) -> dict[str, Case]:
    """The table, in its order."""
    return {name: Case(**entry) for name, entry in tomllib.loads(path.read_text()).items()}


def ordered(cases: Mapping[str, Case], names: Sequence[str]) -> list[str]:
    """`names` (all, if empty), each after the cases that it needs."""
    found: dict[str, None] = {}
    for name in names or cases:
        if name not in cases:
            raise SystemExit(f"golden: no case '{name}'; expected one of: {', '.join(cases)}")
        found.update(dict.fromkeys(ordered(cases, cases[name].needs) if cases[name].needs else []))
        found[name] = None
    return list(found)


def run_case(name: str, case: Case, scratch: Path, places: Mapping[str, str]) -> dict[str, str]:
    """Run a case in `scratch`; return digests of its exit code, its JSON and its files, by `case artefact`."""
    program, environment = str(Path(sys.executable).with_name("splatctrl")), os.environ | AT_MOST_AVX2
    run = partial(subprocess.run, cwd=scratch, env=environment, capture_output=True, text=True)
    if case.before:
        run([program, *shlex.split(case.before), "-q"], check=True)
    before = stamps(scratch)
    done = run([program, *shlex.split(case.run), "--json", "-q"], check=False)
    if done.returncode not in {0, 1, 3, 4, 5}:
        raise SystemExit(f"golden: {name}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    found = {"exit code": str(done.returncode), "--json": of_json(done.stdout, places)}
    found |= written(scratch, before, places)
    return {f"{name} {artefact}": value for artefact, value in found.items()}


def prepare(scratch: Path, recordings: Path) -> dict[str, str]:
    """Link the commands' inputs; return the names that replace the folders' paths in outputs."""
    folders = [ROOT / "sample_data", ROOT / "docs"]
    folders += sorted(path for path in recordings.iterdir() if path.is_dir()) if recordings.is_dir() else []
    for folder in folders:
        (scratch / folder.name).symlink_to(folder.resolve())
    return {str(scratch): "SCRATCH", str(recordings.resolve()): "RECORDINGS", str(ROOT): "REPOSITORY"}


def header() -> list[str]:
    """What digests depend on beside the code."""
    kernels = arithmetic().rpartition("_")[2]
    return [
        "# Written by `python -m tools.golden --write`; compared by `python -m tools.golden`.",
        f"# {platform.machine()}, kernels {kernels}, " + ", ".join(f"{name} {version(name)}" for name in LIBRARIES),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, compare or write; 1 where a digest changed."""
    args = _parser().parse_args(arguments)
    cases = read_cases()
    text = DIGESTS.read_text() if DIGESTS.exists() else ""
    kept = parse(text)
    if args.out:
        args.out.mkdir(parents=True)
    with nullcontext(str(args.out)) if args.out else tempfile.TemporaryDirectory() as folder:
        found = _run_all(cases, ordered(cases, args.names), Path(folder).resolve(), kept)
    digests = {key: value for of_case in found.values() for key, value in of_case.items()}
    if args.write:
        others = {key: value for key, value in kept.items() if _case(key) in cases and _case(key) not in found}
        DIGESTS.write_text("\n".join([*header(), *lines(others | digests)]) + "\n")
        return 0
    if text.splitlines()[:2] != header():
        print(f"digests.txt is of another machine or other libraries, whose digests may differ for that alone:\n"
              f"{''.join(text.splitlines()[1:2])}\n{header()[1]}")  # fmt: skip
    changed = _differences({key: value for key, value in kept.items() if _case(key) in found}, digests)
    print("\n".join([*changed, f"{len(changed)} of {len(digests)} digests changed"]))
    return int(bool(changed))


def _run_all(
    cases: Mapping[str, Case], names: Sequence[str], scratch: Path, kept: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Digests by case; cases without their recording are omitted with a message."""
    recordings = Path(os.environ.get("SPLATCTRL_REAL_DATA", ROOT.parent / "shared" / "data"))
    places = prepare(scratch, recordings)
    found: dict[str, dict[str, str]] = {}
    for name in names:
        case = cases[name]
        if case.data and not (scratch / case.data).is_dir():
            print(f"{name}: LEFT OUT, no {recordings / case.data}", flush=True)
            continue
        started = time.monotonic()
        found[name] = run_case(name, case, scratch, places)
        changed = _differences({key: value for key, value in kept.items() if _case(key) == name}, found[name])
        verdict = f"{len(changed)} CHANGED" if changed else "same"
        print(f"{name}: {len(found[name])} digests, {verdict}, {time.monotonic() - started:.1f} s", flush=True)
    return found


def _case(key: str) -> str:
    return key.partition(" ")[0]


def _differences(kept: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    return [
        f"{name}: expected {kept.get(name, 'nothing')}, got {found.get(name, 'nothing')}"
        for name in sorted({*kept, *found})
        if kept.get(name) != found.get(name)
    ]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.golden", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "names", nargs="*", metavar="CASE", help="these of cases.toml, and what they need (default: all)"
    )
    parser.add_argument("--write", action="store_true", help=f"write {DIGESTS.name} instead of comparing")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="run in this new folder and keep it")
    return parser


if __name__ == "__main__":
    sys.exit(main())

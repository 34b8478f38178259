"""Output folder of a finished run or batch."""

import csv
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli import __version__
from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.files.output import PARTIAL, Parts, sha256
from splatctrl_cli.jobs.batch.ledger import FILE, FILE_VERSION, FORMAT, Run, run_of_document
from splatctrl_cli.records import Float64, Stamps

REPLAY = "replay"


@dataclass(frozen=True, kw_only=True)
class States:
    """Columns of a replay's ``steps.csv`` (T rows); NaN for empty cells.

    seconds: since the first row. joints: (T,) by name. clearance: (T,) [m] by measure, including `truth`. rungs,
    obstacles: (T,), or empty.
    """

    stamps_ns: Stamps
    seconds: Float64
    joints: Mapping[str, Float64]
    clearance: Mapping[str, Float64]
    rungs: tuple[str, ...]
    obstacles: tuple[str, ...]

    @property
    def judged(self) -> Float64:
        """Clearance (T,) [m] to the splats, else the least of all measures."""
        measures = [self.clearance["exact"]] if "exact" in self.clearance else list(self.clearance.values())
        return np.asarray(np.fmin.reduce([np.full(len(self.seconds), np.nan), *measures]))

    def worst(self) -> int | None:
        """Index of the least judged clearance, None without values."""
        return int(np.nanargmin(self.judged)) if np.isfinite(self.judged).any() else None


@dataclass(frozen=True)
class RunFolder:
    """Command's folder; words: its command line, if ``run.json`` records an outer program's."""

    path: Path
    run: Mapping[str, Any]
    words: tuple[str, ...] = ()

    @cached_property
    def parts(self) -> Parts:
        """Digests to check files on opening."""
        return Parts.from_run(self.path, self.run)

    @property
    def command(self) -> str:
        return str(self.run.get("command", ""))

    @property
    def verdict(self) -> Mapping[str, Any]:
        return self._object("verdict")

    @property
    def metrics(self) -> Mapping[str, Any]:
        return self._object("metrics")

    def _object(self, name: str) -> Mapping[str, Any]:
        value = self.run.get(name, {})
        if not isinstance(value, dict):
            raise InputError(f"{self.path / 'run.json'}: {name}: expected an object, got {type(value).__name__}")
        return value

    @property
    def arguments(self) -> list[str]:
        words = list(self.words) or self.run.get("arguments", [])
        return [str(word) for word in words] if isinstance(words, list) else []

    def options(self, name: str) -> list[str]:
        words = self.arguments
        values = [words[i + 1] for i, word in enumerate(words[:-1]) if word == name]
        return values + [word.partition("=")[2] for word in words if word.startswith(f"{name}=")]

    def option(self, name: str) -> str | None:
        return next(iter(self.options(name)[::-1]), None)

    def json_of(self, name: str) -> Any:
        """Content of a JSON file, None if missing. Raises InputError for invalid JSON."""
        file = self.path / name
        if not self.parts.has(file):
            return None
        with refuse_faults(f"{file}: is not JSON", ValueError):
            return json.loads(self.parts.checked(file).read_text(encoding="utf-8"))

    def pictures(self) -> list[Path]:
        files = [*sorted(self.path.glob("*.png")), *sorted(self.path.glob("report/*.png"))]
        return [self.parts.checked(path) for path in files if self.parts.has(path)]

    @cached_property
    def states(self) -> States | None:
        """States of a replay, else None. Raises InputError for other columns."""
        file = self.path / "steps.csv"
        if self.command != REPLAY or not self.parts.has(file):
            return None
        with refuse_faults(f"{file}: expected the columns of a replay", ValueError, KeyError, StopIteration):
            return _states(read_columns(self.parts.checked(file)))

    def place_of(self, word: str, roots: tuple[Path, ...], digest: str | None = None) -> Path | None:
        """Find a command line's path: as typed, in a parent folder, or in `roots`.

        None if missing, or if its digest is not `digest`.
        """
        above = [Path(), *self.path.absolute().parents, *roots]
        places = [root / word for root in above if (root / word).exists()]
        return next((path for path in places if digest is None or sha256(path) == digest), None)


@dataclass(frozen=True, kw_only=True)
class FolderRequest:
    """File `out` made from `path`; roots: folders with a replay's scene and robot."""

    path: Path
    out: Path | None = None
    roots: tuple[Path, ...] = ()
    force: bool = False


def sibling_path(path: Path, ending: str) -> Path:
    """Path of the same name and folder, with another ending."""
    place = path if path.name.strip(".") else Path(os.path.realpath(path))  # . and .. have no name of their own
    return place.with_name(f"{place.name if place.is_dir() else place.stem}{ending}")


def open_run(path: Path) -> RunFolder:
    """Open a run's folder.

    Raises InputError if it is no run, incomplete, or of a newer version.
    """
    partial = path if path.name.endswith(PARTIAL) else path.with_name(path.name + PARTIAL)
    refuse_if(
        partial.exists() and (partial == path or not path.exists()),
        f"{partial}: incomplete: its run is still writing, or was interrupted",
        remedy="wait for it, or run its command again",
    )
    refuse_if(not path.exists(), f"{path}: no such folder", remedy="give the folder that a command wrote with --out")
    file = path / "run.json"
    refuse_if(
        not file.is_file(),
        f"{path}: expected a run, got a folder without run.json",
        remedy="give a folder that a command wrote with --out",
    )
    run = read_object(file)
    refuse_if(
        "command" not in run, f"{file}: expected what a command of splatctrl writes", remedy="make the run again"
    )
    version = str(run.get("splatctrl", ""))
    # values of a newer version may mean something else
    refuse_if(
        _numbers(version) > _numbers(__version__),
        f"{file}: written by splatctrl {version}, this is {__version__}",
        remedy="update splatctrl",
    )
    return RunFolder(path, run)


def read_object(file: Path) -> dict[str, Any]:
    """Read a JSON object. Raises InputError for anything else."""
    with refuse_faults(f"{file}: cannot be read", OSError, ValueError):
        document = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        raise InputError(
            f"{file}: expected what a command of splatctrl writes, got {type(document).__name__}",
            remedy="make it again",
        )
    return document


def read_columns(file: Path) -> dict[str, tuple[str, ...]]:
    with file.open(encoding="utf-8", newline="") as stream:
        rows = csv.reader(stream)
        header = next(rows)
        return dict(zip(header, zip(*rows, strict=True), strict=False))


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".") if part.isdigit())


def _states(columns: Mapping[str, tuple[str, ...]]) -> States:
    def floats(name: str) -> Float64:
        return np.array([float(cell) if cell else np.nan for cell in columns[name]], np.float64)

    measures = {name.removeprefix("clearance_"): name for name in columns if name.startswith("clearance_")}
    return States(
        stamps_ns=np.array([int(cell) for cell in columns["stamp_ns"]], np.int64),
        seconds=floats("time_s"),
        joints={name.removeprefix("q_"): floats(name) for name in columns if name.startswith("q_")},
        clearance={"truth" if key == "true" else key: floats(name) for key, name in measures.items()},
        rungs=columns.get("rung", ()),
        obstacles=columns.get("obstacle", ()),
    )


@dataclass(frozen=True, kw_only=True)
class BatchFolder:
    """Batch and the last run of each node; jobs in the suite's order."""

    path: Path
    suite: str
    jobs: tuple[str, ...]
    runs: tuple[Run, ...]

    def inside(self, name: str) -> Path:
        """Path in the batch's folder. Raises InputError for a name that leads outside."""
        refuse_if(
            not name or Path(name).is_absolute() or ".." in Path(name).parts,
            f"{self.path / FILE}: {name!r}: expected a path in the batch",
            remedy="run it again",
        )
        return self.path / name


def is_batch(path: Path) -> bool:
    return (path / FILE).is_file()


def open_batch(path: Path) -> BatchFolder:
    """Open a batch. Raises InputError for another kind of file, or a newer version."""
    file = path / FILE
    batch = read_object(file)
    try:
        refuse_if(batch["format"] != FORMAT, f"format {batch['format']}", error=ValueError)
        refuse_if(
            int(batch["version"]) > FILE_VERSION,
            f"{file}: version {batch['version']}, this program reads {FILE_VERSION}",
            remedy="update splatctrl",
        )
        jobs, runs = map(str, batch["jobs"]), map(run_of_document, batch["nodes"])
        return BatchFolder(path=path, suite=str(batch["suite"]), jobs=tuple(jobs), runs=tuple(runs))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else f"{error}"
        raise InputError(
            f"{file}: not what a batch writes (suite, jobs and nodes): {why}", remedy="run the batch again"
        ) from None

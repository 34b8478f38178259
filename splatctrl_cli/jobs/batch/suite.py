"""SUITE.toml: recordings, and their commands."""

import glob
import os
import re
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatctrl_cli.config.ranges import format_value
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_faults, refuse_if

Table = Mapping[str, Any]

OF_JOB = ("command", "matrix", "expect", "timeout", "memory", "retries")  # keys of a job that are no options
_ODD = re.compile(r"[^\w.+-]")  # in no name of a folder
UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
SECONDS = {"s": 1, "m": 60, "min": 60, "h": 3600}
EXPECTED = (  # labels and outcomes of verdicts, and of a command without one
    *("passed", "failed", "not evaluable", "done", "safe", "margin broken", "contact", "limits broken"),
    *("controller failed", "goal not reached", "gate failed"),
)


@dataclass(frozen=True, kw_only=True)
class Job:
    """Command of a suite.

    options: by long name. matrix: values by option; each combination is a variant. expect: a verdict's label or
    outcome, or "exit N". timeout [s], memory [bytes]: 0 for no limit.
    """

    name: str
    command: str
    options: Table = field(default_factory=dict)
    matrix: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    expect: str = "passed"
    timeout: float = 0.0
    memory: int = 0
    retries: int = 1


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One recording: one file, or several files of a session.

    only: names of its jobs, empty for all. overrides: options by job.
    """

    name: str
    paths: tuple[Path, ...]
    only: tuple[str, ...] = ()
    overrides: Mapping[str, Table] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Suite's file; its paths are relative to `folder`."""

    name: str
    folder: Path
    out: Path
    recordings: tuple[Recording, ...]
    jobs: tuple[Job, ...]


def read_suite(path: Path, commands: Sequence[str]) -> Suite:
    """Read a suite of allowed `commands`. Raises InputError if unreadable, UsageError if invalid."""
    example = "see splatctrl help batch for an example"
    refuse_if(path.is_dir(), f"{path}: is a folder", remedy="give the suite's file, or --list with it")
    with (
        refuse_faults(lambda error: f"{path}: cannot be read: {error.strerror}", OSError, remedy="check the path"),
        refuse_faults(f"{path}: is not TOML", ValueError, remedy=example, error=UsageError),
    ):
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    _check_keys(path.name, document, ("name", "out", "recordings", "jobs"))
    folder = path.absolute().parent
    name = _worded(path.name, "name", document.get("name", path.stem))
    jobs = tuple(_job(key, table, commands) for key, table in _tables(path.name, document, "jobs").items())
    tables = _list(path.name, document, "recordings")
    recordings = _check_names([one for table in tables for one in _recordings(folder, table)])
    refuse_if(
        not jobs or not recordings,
        f"{path.name}: expected [[recordings]] and [jobs.NAME], got none of the {'first' if jobs else 'second'}",
        error=UsageError,
    )
    _check_recordings(recordings, [job.name for job in jobs])
    return Suite(
        name=name,
        folder=folder,
        out=folder / _worded(path.name, "out", document.get("out", f"{path.stem}.out")),
        recordings=tuple(recordings),
        jobs=jobs,
    )


def jobs_for(recording: Recording, jobs: Sequence[Job], commands: Sequence[str]) -> list[Job]:
    """Jobs of a recording with its overrides. Raises UsageError for an invalid override."""
    chosen = [job for job in jobs if job.name in recording.only or not recording.only]
    own = [_job(job.name, recording.overrides.get(job.name, {}), commands, job) for job in chosen]
    return [
        replace(its, options={**job.options, **its.options}, matrix={**job.matrix, **its.matrix})
        for job, its in zip(chosen, own, strict=True)
    ]


def _job(name: str, table: Table, commands: Sequence[str], base: Job | None = None) -> Job:
    where, base = f"[jobs.{name}]", base or Job(name=name, command=name)
    refuse_if(
        not isinstance(table, Mapping), f"{where}: expected a table, got {format_value(table)}", error=UsageError
    )
    _check_name(where, name)
    command = _worded(where, "command", table.get("command", base.command))
    refuse_if(
        command not in commands,
        f"{where}: no job is called {command!r}",
        remedy=_suggest(command, commands, "give command = one of"),
        error=UsageError,
    )
    own = next((option for option in ("out", "force", "resume", "json", "verbose", "quiet") if option in table), None)
    refuse_if(own is not None, f"{where}: a batch gives {own} itself", remedy="leave it out", error=UsageError)
    matrix = table.get("matrix", {})
    refuse_if(
        not isinstance(matrix, Mapping) or not all(isinstance(v, list) and v for v in matrix.values()),
        f"{where} matrix: expected OPTION = [VALUE, ...] each, got {format_value(matrix)}",
        error=UsageError,
    )
    expect = _worded(where, "expect", table.get("expect", base.expect))
    refuse_if(
        expect not in EXPECTED and not re.fullmatch(r"exit \d+", expect),
        f"{where} expect: no verdict is called {expect!r}",
        remedy=_suggest(expect, (*EXPECTED, "exit N")),
        error=UsageError,
    )
    return Job(
        name=name,
        command=command,
        matrix=matrix,
        expect=expect,
        timeout=_amount(where, table, "timeout", SECONDS, base.timeout),
        memory=int(_amount(where, table, "memory", UNITS, base.memory)),
        retries=int(_amount(where, table, "retries", {}, base.retries)),
        options={key: value for key, value in table.items() if key not in OF_JOB},
    )


def _recordings(folder: Path, table: Table) -> list[Recording]:
    where = "[[recordings]]"
    refuse_if(
        not isinstance(table, Mapping),
        f"{where}: expected a table, got {format_value(table)}",
        remedy="give it paths = [...]",
        error=UsageError,
    )
    _check_keys(where, table, ("name", "paths", "session", "only", "jobs"))
    only = tuple(_worded(where, "only", name) for name in _list(where, table, "only"))
    refuse_if(
        ("paths" in table) == ("session" in table),
        f"{where}: expected paths or session, and not both",
        error=UsageError,
    )
    key = "paths" if "paths" in table else "session"
    paths = list(
        dict.fromkeys(path for each in _list(where, table, key) for path in _find_files(folder, where, each))
    )
    name = _worded(where, "name", table.get("name", ""))
    refuse_if(
        name and key == "paths" and len(paths) > 1,
        f"{where} name = {name!r}: {len(paths)} recordings match",
        remedy="leave the name out",
        error=UsageError,
    )
    each = [tuple(paths)] if key == "session" else [(path,) for path in paths]
    jobs = _tables(where, table, "jobs")
    return [Recording(name=name, paths=files, only=only, overrides=jobs) for files in each]


def _find_files(folder: Path, where: str, pattern: object) -> list[Path]:
    places = sorted(glob.glob(_worded(where, "paths", pattern), root_dir=folder, recursive=True))  # noqa: PTH207
    refuse_if(not places, f"{where}: nothing matches {pattern!r} in {folder}", remedy="check the pattern")
    return [folder / place for place in places]


def _check_names(recordings: Sequence[Recording]) -> list[Recording]:
    """Name the recordings by file, with the folders or ending that distinguish them."""
    files = [Path(os.path.normpath(each.paths[0])) for each in recordings]
    counts = Counter(map(_strip_ending, set(files)))
    places = [path if counts[_strip_ending(path)] > 1 else _strip_ending(path) for path in files]
    # a common name gets the folder's in front
    own = [
        f"{p.parent.name}-{p.name}" if p.name in ("log", "capture", "recording", "data") else p.name for p in places
    ]
    names = [each.name or _ODD.sub("_", name) for each, name in zip(recordings, own, strict=True)]
    for above in range(max((len(place.parts) - 1 for place in places), default=0)):
        alike: dict[str, list[int]] = {}
        for k, name in enumerate(names):
            alike.setdefault(name.lower(), []).append(k)
        for group in alike.values():
            folders = {k: "".join(parent.name for parent in [*places[k].parents][above : above + 1]) for k in group}
            for k in group if len(set(folders.values())) > 1 else ():
                names[k] = names[k] if recordings[k].name else _ODD.sub("_", f"{folders[k]}-{names[k]}".lstrip("-"))
    return [replace(each, name=name) for each, name in zip(recordings, names, strict=True)]


def _strip_ending(path: Path) -> Path:
    return path.with_suffix("") if path.suffix in (".mcap", ".bag", ".db3", ".toml", ".capture") else path


def _check_recordings(recordings: Sequence[Recording], jobs: Sequence[str]) -> None:
    by_name: dict[str, Recording] = {}
    for recording in recordings:
        _check_name("[[recordings]] name", recording.name)
        other = by_name.setdefault(recording.name, recording)
        refuse_if(
            other is not recording,
            f"two recordings are called {recording.name!r}: {other.paths[0]} and {recording.paths[0]}",
            remedy="give one a [[recordings]] of its own, with a name",
            error=UsageError,
        )
        for job in recording.only:
            refuse_if(
                job not in jobs,
                f"[[recordings]] only: no job is called {job!r}",
                remedy=_suggest(job, jobs),
                error=UsageError,
            )
        for job in recording.overrides:
            refuse_if(
                job not in (recording.only or jobs),
                f"[recordings.jobs.{job}]: no job has this name",
                remedy=_suggest(job, jobs),
                error=UsageError,
            )


def _check_keys(where: str, table: Table, known: Sequence[str]) -> None:
    for key in table:
        refuse_if(key not in known, f"{where}: unknown key {key!r}", remedy=_suggest(key, known), error=UsageError)


def _suggest(word: str, known: Sequence[str], otherwise: str = "known here") -> str:
    return did_you_mean(word, known, f"{otherwise}: {', '.join(known)}")


def _check_name(where: str, name: str) -> None:
    refuse_if(
        not re.fullmatch(r"\w[\w.+-]*", name),
        f"{where}: {name!r} is no name of a folder",
        remedy="use letters, digits, . _ + -",
        error=UsageError,
    )


def _worded(where: str, key: str, value: object) -> str:
    if not isinstance(value, str):
        raise UsageError(f"{where} {key}: expected text, got {format_value(value)}")
    return value


def _list(where: str, table: Table, key: str) -> list[Any]:
    value = table.get(key, [])
    if not isinstance(value, list) or (key in table and not value):
        raise UsageError(f"{where} {key}: expected a list, got {format_value(value)}")
    return value


def _tables(where: str, table: Table, key: str) -> dict[str, Table]:
    value = table.get(key, {})
    if not isinstance(value, dict) or not all(isinstance(each, dict) for each in value.values()):
        raise UsageError(f"{where} {key}: expected [{key}.NAME], got {format_value(value)}")
    return value


def _amount(where: str, table: Table, key: str, units: Mapping[str, int], default: float) -> float:
    """Parse a number, "10 min" or "4GiB"."""
    value = table.get(key, default)
    match = re.fullmatch(r"\s*([\d.]+)\s*(\w+)\s*", value) if isinstance(value, str) else None
    try:
        amount = float(match[1]) * units[match[2]] if match else float(value)
    except (KeyError, TypeError, ValueError):
        amount = -1.0
    example = f" or with one of {', '.join(units)}" if units else ""
    refuse_if(
        isinstance(value, bool) or not 0 <= amount < 1e15,
        f"{where} {key}: expected a number, 0 or more{example}, got {format_value(value)}",
        error=UsageError,
    )
    return amount

"""Runs by node and key in SQLite, with claims and input digests.

A key covers a node's words, the content of its inputs, and the code.
"""

import fcntl
import hashlib
import json
import os
import re
import socket
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO
from uuid import uuid4

import splatctrl_cli
from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if
from splatctrl_cli.evaluate.verdict import damage_mark
from splatctrl_cli.files.output import PACKAGES, sha256, write_durably, write_table
from splatctrl_cli.jobs.batch.graph import Node

NAME, OWNERS = "ledger.sqlite", ".owners"
FILE, FORMAT, FILE_VERSION = "batch.json", "splatctrl-batch", 1  # what a batch says of itself
VERSION = 1  # of the tables
BUSY_S, WAIT_S = 30.0, 0.02  # longest wait for another writer, and between attempts
THREADS = "--threads"  # changes no byte
_MESH = re.compile(r'filename\s*=\s*"([^"]+)"')
_PATTERN = {"=": "GLOB", "==": "GLOB", "!=": "NOT GLOB"}  # of texts with a *


@dataclass(frozen=True, kw_only=True)
class Run:
    """Ended run of a node; `state` is done (as expected), failed, error or skipped."""

    node: str
    recording: str = ""
    job: str = ""
    command: str = ""
    key: str = ""
    state: str = ""
    expect: str = ""
    outcome: str = ""
    label: str = ""
    sentence: str = ""
    exit_code: int | None = None
    cause: str = ""
    started: float = 0.0
    seconds: float = 0.0
    peak_mb: float = 0.0
    variant: str = "{}"
    words: str = "[]"
    needs: str = "[]"
    out: str = ""
    result: str = ""
    log: str = ""
    stamp: str = ""
    version: str = ""
    host: str = ""

    @property
    def damage(self) -> str:
        """Mark of a damaged recording, else empty."""
        return damage_mark(self.sentence, self.exit_code)

    @property
    def column(self) -> str:
        return self.node.removeprefix(f"{self.recording}/")

    def document(self) -> dict[str, Any]:
        plain = asdict(self) | {name: json.loads(getattr(self, name)) for name in _OF_JSON}
        return {"id": plain.pop("node"), **plain, "outcome": self.outcome or None}


COLUMNS = tuple(column.name for column in fields(Run))
_OF_JSON = ("variant", "words", "needs")  # columns of JSON text
_NUMBERS = ("exit_code", "started", "seconds", "peak_mb")
_TABLES = f"""
CREATE TABLE IF NOT EXISTS runs (id INTEGER PRIMARY KEY, {
    ", ".join(f"{name} {'REAL' if name in _NUMBERS else 'TEXT'}" for name in COLUMNS)
});
CREATE INDEX IF NOT EXISTS runs_by_node ON runs (node, id);
CREATE TABLE IF NOT EXISTS claims (node TEXT PRIMARY KEY, owner TEXT);
CREATE TABLE IF NOT EXISTS digests (path TEXT PRIMARY KEY, stamp TEXT, digest TEXT);
"""


class Ledger(AbstractContextManager["Ledger"]):
    """Ledger of batches in one folder; several processes may open it."""

    def __init__(self, folder: Path) -> None:
        """Open the ledger. Raises InputError for another kind of file, or a newer ledger."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.path = folder, folder / NAME
        self._owner = f"{socket.gethostname()}-{os.getpid()}-{uuid4().hex[:8]}"
        self._lock: TextIO | None = None
        with refuse_faults(f"{self.path}: is no ledger", sqlite3.DatabaseError, remedy="move it away; outputs stay"):
            self._base = self._open()

    def _open(self) -> sqlite3.Connection:
        base = sqlite3.connect(self.path, timeout=BUSY_S, isolation_level=None)
        base.row_factory = sqlite3.Row
        version = int(base.execute("PRAGMA user_version").fetchone()[0])
        refuse_if(
            version > VERSION,
            f"{self.path}: is of version {version}, expected {VERSION}",
            remedy="use a newer splatctrl",
        )
        until = time.monotonic() + BUSY_S
        while base.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
            try:
                base.execute("PRAGMA journal_mode = WAL")
            except sqlite3.OperationalError:  # sqlite does not wait for other processes here
                if time.monotonic() > until:
                    raise
                time.sleep(WAIT_S)
        base.execute("PRAGMA synchronous = NORMAL")
        base.executescript(_TABLES)
        base.execute(f"PRAGMA user_version = {VERSION}")
        return base

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            with suppress(sqlite3.Error):
                self._base.execute("DELETE FROM claims WHERE owner = ?", (self._owner,))
            Path(self._lock.name).unlink(missing_ok=True)
            self._lock.close()
        self._base.close()

    def claim(self, node: str) -> bool:
        """Claim a node for this process; False if another live process has it."""
        with self._transaction():
            row = self._base.execute("SELECT owner FROM claims WHERE node = ?", (node,)).fetchone()
            if row is not None and row["owner"] != self._owner and self._is_alive(row["owner"]):
                return False
            if self._lock is None:  # a file of this process, locked until it ends
                place = self.folder / OWNERS / self._owner
                place.parent.mkdir(exist_ok=True)
                self._lock = place.open("w")
                fcntl.flock(self._lock, fcntl.LOCK_EX)
            self._base.execute("INSERT OR REPLACE INTO claims VALUES (?, ?)", (node, self._owner))
        return True

    def record(self, run: Run) -> Run:
        """Store an ended run, release its node, and return the run."""
        places = ", ".join("?" * len(COLUMNS))
        with self._transaction():
            self._base.execute(
                f"INSERT INTO runs ({', '.join(COLUMNS)}) VALUES ({places})", tuple(asdict(run).values())
            )
            self._base.execute("DELETE FROM claims WHERE node = ?", (run.node,))
        return run

    def release(self, node: str) -> None:
        self._base.execute("DELETE FROM claims WHERE node = ? AND owner = ?", (node, self._owner))

    def latest(self) -> dict[str, Run]:
        return {run.node: run for run in self.runs()}

    def mean_seconds(self) -> dict[str, float]:
        rows = self._base.execute("SELECT job, avg(seconds) AS mean FROM runs WHERE cause = '' GROUP BY job")
        return {row["job"]: float(row["mean"]) for row in rows}

    def runs(self, conditions: Sequence[str] = (), *, only_last: bool = True) -> Iterator[Run]:
        """Runs that meet conditions like "job=audit", "node=a/*", "seconds>10".

        Raises UsageError for an invalid condition.
        """
        clauses, values = ["id IN (SELECT max(id) FROM runs GROUP BY node)"] if only_last else [], list[Any]()
        for condition in conditions:
            match = re.fullmatch(r"(\w+)\s*(!=|>=|<=|==?|>|<)\s*(.*)", condition.strip())
            if match is None or match[1] not in COLUMNS:
                raise UsageError(
                    f"--where {condition}: expected COLUMN=VALUE", remedy=f"columns: {', '.join(COLUMNS)}"
                )
            column, comparison, text = match.groups()
            clauses.append(f"{column} {_PATTERN.get(comparison, comparison) if '*' in text else comparison} ?")
            try:
                values.append(float(text) if column in _NUMBERS else text)
            except ValueError:
                raise UsageError(f"--where {condition}: {column} is a number, got {text!r}") from None
        where = f" WHERE {' AND '.join(clauses)}" if clauses else ""
        for row in self._base.execute(f"SELECT * FROM runs{where} ORDER BY id", values):
            plain = {name: row[name] for name in COLUMNS}
            yield Run(**plain | {"exit_code": None if plain["exit_code"] is None else int(plain["exit_code"])})

    def digest(self, path: Path) -> str:
        """sha256 of a file, or a folder's names and files; cached by sizes and times."""
        key, status = str(path.resolve()), path.stat()
        stamp = f"{status.st_size} {status.st_mtime_ns} {status.st_ino}"
        files = {place: place.stat() for place in sorted(path.rglob("*")) if place.is_file()}
        if path.is_dir():
            lines = [f"{place.relative_to(path)} {s.st_size} {s.st_mtime_ns}" for place, s in files.items()]
            stamp = hashlib.sha256("\n".join(lines).encode()).hexdigest()
        row = self._base.execute("SELECT stamp, digest FROM digests WHERE path = ?", (key,)).fetchone()
        if row is not None and row["stamp"] == stamp:
            return str(row["digest"])
        listing = "\n".join(f"{place.relative_to(path)} {sha256(place)}" for place in files)
        digest = hashlib.sha256(listing.encode()).hexdigest() if path.is_dir() else sha256(path)
        self._base.execute("INSERT OR REPLACE INTO digests VALUES (?, ?, ?)", (key, stamp, digest))
        return digest

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._base.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._base.execute("ROLLBACK")
            raise
        self._base.execute("COMMIT")

    def _is_alive(self, owner: str) -> bool:
        place = self.folder / OWNERS / owner
        try:
            with place.open() as stream:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False
        place.unlink(missing_ok=True)
        return False


def write_csv(path: Path, runs: Iterable[Run]) -> None:
    write_durably(path, lambda place: write_table(place, COLUMNS, map(asdict, runs)))


def run_of_document(plain: Mapping[str, Any]) -> Run:
    """Run of an entry of batch.json. Raises TypeError, KeyError or AttributeError."""
    known = {name: value for name, value in plain.items() if name in COLUMNS and value is not None}
    return Run(node=plain["id"], **known | {name: json.dumps(known[name]) for name in _OF_JSON if name in known})


def keys_of(nodes: Sequence[Node], ledger: Ledger, entry: str) -> dict[str, str]:
    """Key of each node; needed nodes come first. Raises InputError for a missing input."""
    code, digests = code_version(), dict[Path, str]()
    keys: dict[str, str] = {}
    outs = {node.name: str(node.out) for node in nodes}
    for node in nodes:
        digests |= {path: _digest(path, ledger) for path in node.inputs if path not in digests}
        named = {str(path): digests[path] for path in node.inputs} | {outs[need]: keys[need] for need in node.needs}
        named[str(node.out)] = "out"
        inputs = [digests[path] for path in node.inputs] + [keys[need] for need in node.needs]
        keys[node.name] = hashlib.sha256(
            json.dumps([entry, code, node.job.command, *inputs, *_deciding_words(node.words, named)]).encode()
        ).hexdigest()
    return keys


@cache
def code_version() -> str:
    """Digest of the package's files, and of package versions that decide figures."""
    folder, sha = Path(splatctrl_cli.__file__).parent, hashlib.sha256()
    for place in sorted(place for place in folder.rglob("*") if place.suffix in {".py", ".so", ".toml", ".json"}):
        sha.update(f"{place.relative_to(folder)}\0".encode() + place.read_bytes())
    for name in PACKAGES:
        sha.update(f"{name} {metadata.version(name)}\0".encode())
    return sha.hexdigest()


def _deciding_words(words: Sequence[str], named: Mapping[str, str]) -> list[str]:
    left_out = ("--force", "--resume", "--quiet", "-q", "--json")
    pairs = zip(words, ("", *words), strict=False)
    deciding = [w for w, before in pairs if w not in left_out and before != THREADS and not w.startswith(THREADS)]
    for path in sorted(named, key=len, reverse=True):
        deciding = [word.replace(path, f"<{named[path]}>") for word in deciding]
    return deciding


def _digest(path: Path, ledger: Ledger) -> str:
    """Digest of an input and the files that it names: images, a URDF's meshes."""
    with refuse_faults(
        lambda error: f"{path}: cannot be read: {error.strerror}", OSError, remedy="check the suite's paths"
    ):
        digest = ledger.digest(path.parent if path.suffix == ".toml" and path.parent != Path() else path)
        meshes = [place for place in _meshes(path) if place.is_file()] if path.suffix == ".urdf" else []
        return " ".join([digest, *(ledger.digest(place) for place in meshes)])


def _meshes(urdf: Path) -> Iterator[Path]:
    for name in dict.fromkeys(_MESH.findall(urdf.read_text(encoding="utf-8", errors="replace"))):
        if "://" not in name:
            yield urdf.parent / name
            continue
        parts = Path(name.split("://", 1)[1]).parts
        for folder in urdf.absolute().parents:
            yield folder.joinpath(*parts)
            yield folder.joinpath(*parts[1:])

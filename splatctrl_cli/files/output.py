"""Atomic outputs with one writer at a time, and ``run.json`` with their digests."""

import csv
import errno
import fcntl
import hashlib
import json
import math
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.errors import DeviceFault, InputError, UsageError, WriteError, refuse_faults, refuse_if, require

REMEDY = "make it again with the command in run.json"


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Digests of a folder's files as written; None from an older version."""

    folder: Path
    digests: Mapping[str, str] | None = None
    remedy: str = REMEDY

    @classmethod
    def from_run(cls, folder: Path, run: Mapping[str, object]) -> "Parts":
        """Read the digests in ``run.json``. Raises InputError for invalid ones."""
        digests = run.get("parts")
        if digests is not None and not (
            isinstance(digests, dict) and all(isinstance(value, str) for value in digests.values())
        ):
            raise InputError(f"{folder / 'run.json'}: parts: expected digests by file name", remedy=REMEDY)
        return cls(folder=folder, digests=digests)

    @classmethod
    def from_folder(cls, path: Path) -> "Parts":
        """Read the digests in a file's folder; None without ``run.json`` or from an older version.

        Raises InputError for an unreadable ``run.json``.
        """
        file = path.parent / "run.json"
        if not file.is_file():
            return cls(folder=path.parent)
        with refuse_faults(f"{file}: cannot be read", OSError, ValueError):
            run = json.loads(file.read_text(encoding="utf-8"))
        return cls.from_run(path.parent, run if isinstance(run, dict) else {})

    def has(self, path: Path) -> bool:
        """True if a file is listed; without digests, if it exists."""
        return path.is_file() if self.digests is None else self._name(path) in self.digests

    def checked(self, path: Path) -> Path:
        """Return the path. Raises InputError if the file is not as written."""
        if self.digests is None:
            return path
        listed, what = self.digests.get(self._name(path)), f"{path}: expected a file that its run wrote, got none"
        digest = require(listed, what, remedy=self.remedy)
        refuse_if(not path.is_file(), f"{path}: missing, though its run wrote it", remedy=self.remedy)
        refuse_if(
            sha256(path) != digest, f"{path}: was changed after it was written (another sha256)", remedy=self.remedy
        )
        return path

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()


LOCKS = Path("/proc/locks")
_WITHOUT_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF})  # some network file systems


@contextmanager
def lock_output(partial: Path, *, is_folder: bool) -> Iterator[None]:
    """Lock a partial output during the block; create it if missing.

    The lock follows a rename, and ends with the process. Without flock(2) nothing is locked. Raises UsageError if
    another run has the lock.
    """
    descriptor = _acquire(partial, is_folder=is_folder)
    try:
        yield
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _acquire(partial: Path, *, is_folder: bool) -> int:
    while True:
        if partial.is_symlink():
            partial.unlink(missing_ok=True)
        if not partial.exists():
            partial.mkdir(exist_ok=True) if is_folder else partial.touch()
        try:
            descriptor = os.open(partial, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError:
            continue  # its run ended between
        try:
            _lock(descriptor, partial)
            if _is_at(partial, descriptor):  # else another process renamed or removed it
                if partial.is_dir() == is_folder:
                    return descriptor
                remove(partial)
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _lock(descriptor: int, partial: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        process = _holder(os.fstat(descriptor).st_ino)
        who = "another run" if process is None else f"another run (process {process})"
        raise UsageError(f"{partial}: {who} writes it", remedy="wait for it to end, or give another --out") from None
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _holder(inode: int) -> int | None:
    try:
        lines = LOCKS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    for line in lines:  # 1: FLOCK  ADVISORY  WRITE 4711 08:01:131 0 EOF
        words = line.split()
        if (
            len(words) >= 6
            and words[1] == "FLOCK"
            and words[5].rpartition(":")[2] == str(inode)
            and int(words[4]) > 0
        ):
            return int(words[4])
    return None


MARKERS = ("run.json", "capture.json")  # one is in every folder a command wrote
PARTIAL = ".partial"  # suffix of an incomplete output
PACKAGES = ("numpy", "scipy", "opencv-python-headless", "pin", "clarabel", "mcap", "rosbags")
_WRITE_FAILURES = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG, errno.EBADF})
WITH_PARTS = ("reconstruct", "sdf-bake", "replay")  # commands whose folders others rely on


def is_write_failure(error: OSError, output: Path | None = None) -> bool:
    """True if writing failed: a full or broken disk, or a file in `output`."""
    if error.errno in _WRITE_FAILURES:
        return True
    if output is None or not isinstance(error.filename, str):
        return False
    return Path(error.filename).absolute().is_relative_to(output.absolute())


@contextmanager
def output_path(
    path: Path, *, force: bool, is_folder: bool, checkpoint: str | None = None, resume: bool = False
) -> Iterator[Path]:
    """Yield ``NAME.partial`` (an empty folder, or a file name); rename it to `path` on success.

    A failure removes it; an interrupted run leaves it. If it contains the file `checkpoint`, failed writes and device
    faults leave it, too. `resume` yields such a folder, and no failure removes it. If `path` is a link, its target is
    written. Raises UsageError if `path` has no name, exists without `force`, or is of the wrong kind. Also for a
    foreign folder, another writer, or an unwritable parent. Raises WriteError if writing failed; other errors pass.
    """

    def can_go_on() -> bool:
        return checkpoint is not None and (partial / checkpoint).is_file()

    with ExitStack() as stack:
        with refuse_faults(
            lambda error: f"{path}: cannot be written: {error.strerror}",
            OSError,
            remedy="give another --out",
            error=UsageError,
        ):
            path = follow_link(path)
            _check_replaceable(path, is_folder=is_folder)
            _check_not_there(path, force=force)
            partial = partial_path(path)
            partial.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock_output(partial, is_folder=is_folder))
            is_resumed = resume and can_go_on()
            if is_folder and not is_resumed:
                for entry in partial.iterdir():
                    remove(entry)
            elif not is_resumed:
                os.truncate(partial, 0)
        try:
            _check_not_there(path, force=force)  # another run may have ended since
            yield partial
            _replace(partial, path)
        except Exception as error:
            failed_to_write = isinstance(error, OSError) and is_write_failure(error, partial)
            is_kept = can_go_on() and (failed_to_write or is_resumed or isinstance(error, DeviceFault))
            if not is_kept:
                remove(partial)
            if isinstance(error, OSError) and failed_to_write:
                remedy = f"make room and go on from {partial} with --resume" if is_kept else "make room"
                raise WriteError(
                    f"{error.filename or path}: writing failed: {error.strerror or error}",
                    remedy=f"{remedy}, or give another --out",
                ) from error
            raise


def follow_link(path: Path) -> Path:
    """Target of a link, else the path itself. Raises UsageError for a loop."""
    if not path.is_symlink():
        return path
    target = Path(os.path.realpath(path))
    refuse_if(target.is_symlink(), f"{path}: is a link to itself", remedy="give another --out", error=UsageError)
    return target


def partial_path(path: Path) -> Path:
    """``NAME.partial`` next to the path, or to a link's target."""
    target = follow_link(path)
    return target.with_name(target.name + PARTIAL)


def check_can_be_written(path: Path) -> None:
    """Raise UsageError early if the nearest existing folder is not writable."""
    try:
        above = next(folder for folder in follow_link(path).absolute().parents if folder.exists())
        is_good = above.is_dir() and os.access(above, os.W_OK | os.X_OK)
        reason = "" if is_good else f"{above} is {'read-only' if above.is_dir() else 'no folder'}"
    except OSError as error:
        reason = str(error.strerror)
    refuse_if(reason, f"{path}: cannot be written: {reason}", remedy="give another --out", error=UsageError)


def write_durably(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write` with a temporary name, then replace `path` on disk in one step."""
    temporary = path.with_name(path.name + ".new")
    try:
        write(temporary)
        flush(temporary)
        temporary.replace(path)
        flush(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def flush(path: Path) -> None:
    """Wait until a file, or a folder's names, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_replaceable(path: Path, *, is_folder: bool) -> None:
    is_there, other, rights = path.is_dir(), "give another --out", os.W_OK | os.X_OK
    is_foreign = is_there and any(path.iterdir()) and not any((path / name).is_file() for name in MARKERS)
    for is_bad, what, remedy in (
        (path.name in ("", ".."), "has no name of its own to write under", other),
        (is_folder and path.is_file(), "is a file, expected a folder to write", other),
        (not is_folder and is_there, "is a folder, expected a file to write", other),
        (is_foreign, "was not written by splatctrl (no run.json)", other),
        (is_there and os.path.ismount(path), "is a mount point", "give a folder in it"),
        (is_there and not os.access(path, rights), "cannot be replaced: it is read-only", other),
    ):
        refuse_if(is_bad, f"{path}: {what}", remedy=remedy, error=UsageError)


def _check_not_there(path: Path, *, force: bool) -> None:
    refuse_if(
        not force and path.exists(),
        f"{path}: already exists",
        remedy="give --force to replace it, or another --out",
        error=UsageError,
    )


def _replace(partial: Path, path: Path) -> None:
    old = path.with_name(path.name + ".partial.old")  # no name that a person gives to a copy
    if path.is_dir() and not path.is_symlink():
        remove(old)
        path.rename(old)
        partial.rename(path)
    else:
        partial.replace(path)
    remove(old)  # also of a run killed right above


@dataclass
class Stopwatch:
    """Wall time by stage [s]."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def part_digests(folder: Path) -> dict[str, str]:
    """sha256 of every file below `folder` except run.json and the checkpoint, by relative name."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    # the digests' own file, and what only an interrupted run reads
    return {name: sha256(folder / name) for name in names if name.partition("/")[0] not in ("run.json", "checkpoint")}


def write_run(
    folder: Path,
    *,
    command: str,
    config: Mapping[str, Any],
    inputs: Mapping[str, str],
    metrics: Mapping[str, Any],
    stopwatch: Stopwatch,
    seed: int = 0,
    verdict: Mapping[str, Any] | None = None,
) -> None:
    """Write ``run.json``: command, settings, sha256 of inputs, times, metrics and verdict.

    Write it last: for commands in WITH_PARTS it lists every file's sha256, checked on opening. It omits ``--resume``.
    """
    run = {
        "command": command,
        "arguments": [argument for argument in sys.argv[1:] if argument != "--resume"],
        "splatctrl": __version__,
        "versions": {name: metadata.version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "seed": seed,
        "config": config,
        "inputs": inputs,
        "metrics": metrics,
        **({} if verdict is None else {"verdict": verdict}),
        "seconds": {name: round(value, 4) for name, value in stopwatch.seconds.items()},
    }
    if command in WITH_PARTS:
        run["parts"] = part_digests(folder)
    write_json(folder / "run.json", run)


@contextmanager
def recorded_as(words: Sequence[str]) -> Iterator[None]:
    """Let `write_run` record `words` as the command line in the block."""
    arguments = sys.argv
    sys.argv = [arguments[0], *words]
    try:
        yield
    finally:
        sys.argv = arguments


def write_table(path: Path, names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(stream, fieldnames=names, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def write_json(path: Path, value: object) -> None:
    """Write indented JSON without NaN."""
    path.write_text(json.dumps(value, indent=2, allow_nan=False, default=plain) + "\n", encoding="utf-8")


def sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def plain(value: object) -> object:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

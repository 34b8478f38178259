"""Outputs that appear whole or not at all, and the ``run.json`` in every output folder."""

import errno
import hashlib
import json
import platform
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.errors import UsageError, WriteError

_WRITE_FAILURES = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG})


def is_write_failure(error: OSError, output: Path | None = None) -> bool:
    """Whether `error` came from writing: a disk that is full or broken, or a file in `output`. Else from reading."""
    if error.errno in _WRITE_FAILURES:
        return True
    if output is None or not isinstance(error.filename, str):
        return False
    return Path(error.filename).absolute().is_relative_to(output.absolute())


@contextmanager
def output_path(path: Path, *, force: bool, is_folder: bool) -> Iterator[Path]:
    """Yield ``NAME.partial`` (an empty folder, or a file name to write to); rename it to `path` on success.

    A failure leaves nothing behind; an interrupted run leaves ``NAME.partial``.
    Raises UsageError when `path` exists without `force`, or its parent cannot be written; WriteError where
    `is_write_failure` (a full disk); every other error as it is.
    """
    if path.exists() and not force:
        raise UsageError(f"{path}: already exists", remedy="give --force to replace it, or another --out")
    partial = path.with_name(path.name + ".partial")
    try:
        _remove(partial)
        partial.parent.mkdir(parents=True, exist_ok=True)
        if is_folder:
            partial.mkdir()
        else:
            partial.touch()
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}", remedy="give another --out") from None
    try:
        yield partial
        _replace(partial, path)
    except Exception as error:
        _remove(partial)
        if isinstance(error, OSError) and is_write_failure(error, partial):
            raise WriteError(
                f"{error.filename or path}: writing failed: {error.strerror or error}",
                remedy="make room, or give another --out",
            ) from error
        raise


def _replace(partial: Path, path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        old = path.with_name(path.name + ".old")
        _remove(old)
        path.rename(old)
        partial.rename(path)
        _remove(old)
    else:
        partial.replace(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


class Stopwatch:
    """Wall time by stage, for ``run.json``."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to stage `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def write_run(
    folder: Path,
    *,
    command: str,
    config: Mapping[str, Any],
    inputs: Mapping[str, str],
    metrics: Mapping[str, Any],
    stopwatch: Stopwatch,
    seed: int = 0,
) -> None:
    """Write ``run.json``: what ran, with what, on what (sha256 by name), how long, and what came out."""
    packages = ("numpy", "scipy", "torch", "opencv-python-headless", "pin", "clarabel", "mcap", "rosbags")
    run = {
        "command": command,
        "arguments": sys.argv[1:],
        "splatctrl": __version__,
        "versions": {name: metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "seed": seed,
        "config": config,
        "inputs": inputs,
        "metrics": metrics,
        "seconds": {name: round(value, 4) for name, value in stopwatch.seconds.items()},
    }
    write_json(folder / "run.json", run)


def write_json(path: Path, value: object) -> None:
    """Indented JSON without NaN, ending in a newline."""
    path.write_text(json.dumps(value, indent=2, allow_nan=False, default=_plain) + "\n", encoding="utf-8")


def sha256(path: Path) -> str:
    """sha256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _plain(value: object) -> object:
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)

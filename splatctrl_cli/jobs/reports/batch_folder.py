"""The folder of a batch as a report reads it: the last state of each of its jobs."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError

FILE, FORMAT, VERSION = "batch.json", "splatctrl-batch", 1
AS_EXPECTED = "done"


@dataclass(frozen=True, kw_only=True)
class Node:
    """One job of a batch: its command on a recording, and what came of it.

    words: the command line. state: done (as expected), failed (judged, not as expected), error, or skipped (what it
    needs is not there). out, log: paths below the batch. peak_mb: of memory. cause: of an error.
    """

    id: str
    recording: str = ""
    job: str = ""
    command: str = ""
    variant: Mapping[str, Any] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    key: str = ""
    state: str = ""
    expect: str | None = None
    outcome: str | None = None
    label: str | None = None
    sentence: str | None = None
    exit_code: int | None = None
    seconds: float | None = None
    peak_mb: float | None = None
    out: str = ""
    log: str = ""
    version: str | None = None
    cause: str | None = None

    @property
    def column(self) -> str:
        """The job and its variant."""
        return self.id.removeprefix(f"{self.recording}/")


@dataclass(frozen=True, kw_only=True)
class BatchFolder:
    """A batch and its nodes; jobs: the names of the suite's, in its order."""

    path: Path
    suite: str
    jobs: tuple[str, ...]
    nodes: tuple[Node, ...]

    def inside(self, name: str) -> Path:
        """A path that the batch names. Raises InputError where it leads out of its folder."""
        if not name or Path(name).is_absolute() or ".." in Path(name).parts:
            raise InputError(f"{self.path / FILE}: {name!r}: expected a path in the batch", remedy="run it again")
        return self.path / name


def is_batch(path: Path) -> bool:
    return (path / FILE).is_file()


def open_batch(path: Path) -> BatchFolder:
    """The batch in a folder. Raises InputError for a file that is not one, or that a newer version wrote."""
    file = path / FILE
    try:
        batch = json.loads(file.read_text(encoding="utf-8"))
        if batch["format"] != FORMAT:
            raise ValueError(f"format {batch['format']}")
        version, suite, nodes = int(batch["version"]), str(batch["suite"]), batch["nodes"]
        jobs = tuple(map(str, batch["jobs"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: expected what batch writes: {error!r}", remedy="run the batch again") from None
    if version > VERSION:
        raise InputError(f"{file}: version {version}, this program reads {VERSION}", remedy="update splatctrl")
    known = {each.name for each in fields(Node)}
    try:
        made = tuple(Node(**{key: value for key, value in node.items() if key in known}) for node in nodes)
    except (TypeError, AttributeError) as error:
        raise InputError(f"{file}: nodes: {error}", remedy="run the batch again") from None
    return BatchFolder(path=path, suite=suite, jobs=jobs, nodes=made)

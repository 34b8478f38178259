"""What `ingest` has written so far, a line a frame: rows and checksums need no memory, and a killed run goes on."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from splatctrl_cli.captures.capture_header import MASKS
from splatctrl_cli.errors import InputError, UsageError

JOURNAL = "ingest.jsonl"  # in the folder while it is partial


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A frame that is on disk: its row of frames.csv, (sha256, name) of its files, its row of provenance.csv."""

    row: Mapping[str, str]
    sums: Sequence[tuple[str, str]]
    provenance: Mapping[str, str]


def _entry(line: Mapping[str, Any]) -> Entry:
    sums = [(digest, name) for digest, name in line["sums"]]
    return Entry(row=line["row"], sums=sums, provenance=line["provenance"])


class Journal:
    """The journal of a partial folder; entries of an earlier run come back one by one, then new ones are added."""

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        """identity: what decides the bytes; kept for whoever goes on."""
        self._path = folder / JOURNAL
        self._files = ExitStack()
        self.num_entries = 0
        self.masks: set[str] = set()  # the columns that some frame has
        self.has_provenance = False
        folder.mkdir(parents=True, exist_ok=True)
        if not self._path.is_file():
            self._path.write_text(json.dumps({"identity": identity}) + "\n", encoding="utf-8")
        self._cut()
        self._kept = _lines(self._path)
        next(self._kept, None)
        self._stream: TextIO = self._files.enter_context(self._path.open("a", encoding="utf-8"))

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def kept(self) -> Entry | None:
        """The next frame of the earlier run; None after the last."""
        found = next(self._kept, None)
        if found is None:
            return None
        entry = _entry(found)
        self._count(entry)
        return entry

    def add(self, entry: Entry) -> None:
        """A frame whose files are written."""
        self._count(entry)
        self._stream.write(json.dumps({"row": entry.row, "sums": entry.sums, "provenance": entry.provenance}) + "\n")
        self._stream.flush()

    def entries(self) -> Iterator[Entry]:
        """All so far, in their order."""
        lines = _lines(self._path)
        next(lines, None)
        yield from map(_entry, lines)

    def remove(self) -> None:
        """Once everything is written."""
        self._files.close()
        self._path.unlink()

    def _count(self, entry: Entry) -> None:
        self.num_entries += 1
        self.masks |= set(MASKS) & entry.row.keys()
        self.has_provenance |= bool(entry.provenance)

    def _cut(self) -> None:
        """Leave out a last line that was not finished."""
        size = 0
        with self._path.open("rb") as stream:
            for line in stream:
                if not line.endswith(b"\n"):
                    break
                size += len(line)
        with self._path.open("r+b") as stream:
            stream.truncate(size)


def read_identity(folder: Path) -> Mapping[str, Any] | None:
    """What decided the bytes of the run that was interrupted; None where there is none to go on with."""
    path = folder / JOURNAL
    first = next(_lines(path), None) if path.is_file() else None
    return None if first is None else first.get("identity")


def check_not_partial(folder: Path) -> None:
    """Raise InputError for what an interrupted run left."""
    if (folder / JOURNAL).is_file():
        raise InputError(
            f"{folder}: an ingest that was interrupted", remedy="continue it with the same command and --resume"
        )


def check_same_frame(folder: Path, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Raise UsageError where a frame that was written is not the one that the source gives now."""
    differing = [name for name in now if before.get(name) != now[name]]
    if differing:
        name = differing[0]
        raise UsageError(
            f"{folder}: --resume: {before.get('color')}: {name} was {before.get(name)}, is {now[name]}",
            remedy="the source has changed; start over without --resume",
        )


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """Of a file as long as it is read."""
    with path.open(encoding="utf-8") as stream:
        for line in stream:
            if line.endswith("\n"):
                yield json.loads(line)

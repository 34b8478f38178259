"""Files of an archive in a new folder, under the names that the archive gives them, and nowhere else."""

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from splatctrl_cli.errors import InputError

MOST_FILES = 1 << 20  # an empty file takes a disk's block, its name in an archive thirty bytes
_LONGEST = 255  # bytes of a name
_PIECE = 1 << 20


class NewFolder:
    """An empty folder that files are written into. `digests`: sha256 of what was written, by name."""

    def __init__(self, path: Path) -> None:
        self.digests: dict[str, str] = {}
        self._path = path
        self._taken: set[str] = set()
        self._folders: set[str] = set()

    def write(self, name: str, pieces: Iterable[bytes]) -> None:
        """Write a file.

        Raises InputError for a name that leads elsewhere, that a file system may not hold or not tell from another
        (case), or that is taken.
        """
        parts = PurePosixPath(name).parts
        is_odd = not name.isprintable() or any(len(part.encode(errors="replace")) > _LONGEST for part in parts)
        if not parts or name.startswith("/") or ".." in parts or "\\" in name or is_odd:
            raise InputError(
                f"{name[:_LONGEST]!r}: not the name of a file of a capture", remedy="do not trust this file"
            )
        self._take(parts)
        path = self._path.joinpath(*parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256()
        with path.open("xb") as stream:
            for piece in pieces:
                digest.update(piece)
                stream.write(piece)
        self.digests["/".join(parts)] = digest.hexdigest()

    def _take(self, parts: tuple[str, ...]) -> None:
        names = ["/".join(parts[: i + 1]).casefold() for i in range(len(parts))]
        if names[-1] in self._taken or names[-1] in self._folders or not self._taken.isdisjoint(names[:-1]):
            raise InputError(f"{'/'.join(parts)!r}: two files of that name", remedy="do not trust this file")
        if len(self._taken) >= MOST_FILES:
            raise InputError(f"over {MOST_FILES} files, expected fewer", remedy="do not trust this file")
        self._taken.add(names[-1])
        self._folders.update(names[:-1])


def attachment_at(stream: BinaryIO, offset: int) -> tuple[str, Iterator[bytes]]:
    """Name and content of the attachment whose record begins at `offset`, of a file whose records are whole."""
    stream.seek(offset + 9 + 16)  # behind opcode, length and two times
    name = stream.read(_u32(stream)).decode("utf-8", "replace")
    stream.seek(_u32(stream), 1)  # the media type
    return name, _pieces(stream, int.from_bytes(stream.read(8), "little"))


def _u32(stream: BinaryIO) -> int:
    return int.from_bytes(stream.read(4), "little")


def _pieces(stream: BinaryIO, size: int) -> Iterator[bytes]:
    while size > 0 and (piece := stream.read(min(size, _PIECE))):
        size -= len(piece)
        yield piece

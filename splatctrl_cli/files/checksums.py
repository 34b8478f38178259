"""SHA256SUMS of a folder with any number of files, sorted by name, in little memory."""

import tempfile
import weakref
from pathlib import Path
from typing import IO

from splatctrl_cli.files.rows import scratch_folder

IN_MEMORY = 1 << 16  # [bytes] of the lines of one folder


class Checksums:
    """Lines by name. Those of a folder wait in a file without a name, as they come in the order of their names."""

    def __init__(self) -> None:
        self._folders: dict[str, IO[bytes]] = {}
        self._others: dict[str, str] = {}

    def add(self, digest: str, name: str) -> None:
        """Of a file in a folder, after those before it there."""
        folder = name.rpartition("/")[0]
        if folder not in self._folders:
            self._folders[folder] = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY, dir=str(scratch_folder()))  # noqa: SIM115
            weakref.finalize(self, self._folders[folder].close)
        self._folders[folder].write(_line(digest, name))

    def add_other(self, digest: str, name: str) -> None:
        """Of one of few files, in any order, any number of times; not in a folder of `add`."""
        self._others[name] = digest

    def write(self, path: Path) -> None:
        """All lines, by name."""
        blocks = sorted([*(f"{folder}/" for folder in self._folders), *self._others])
        with path.open("wb") as stream:
            for block in blocks:
                if block in self._others:
                    stream.write(_line(self._others[block], block))
                    continue
                lines = self._folders[block[:-1]]
                lines.seek(0)
                while piece := lines.read(1 << 20):
                    stream.write(piece)


def _line(digest: str, name: str) -> bytes:
    return f"{digest}  {name}\n".encode()

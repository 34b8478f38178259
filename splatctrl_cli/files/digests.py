"""The digests by which a folder's ``run.json`` knows its files, and their check when one is opened."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import sha256

REMEDY = "make it again with the command in run.json"


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What a folder was when it was written; digests: None where an older version wrote it."""

    folder: Path
    digests: Mapping[str, str] | None = None
    remedy: str = REMEDY

    @classmethod
    def of_run(cls, folder: Path, run: Mapping[str, object]) -> "Parts":
        """Of what ``run.json`` holds. Raises InputError for values that are not digests."""
        digests = run.get("parts")
        if digests is not None and not (
            isinstance(digests, dict) and all(isinstance(value, str) for value in digests.values())
        ):
            raise InputError(f"{folder / 'run.json'}: parts: expected digests by file name", remedy=REMEDY)
        return cls(folder=folder, digests=digests)

    @classmethod
    def beside(cls, path: Path) -> "Parts":
        """Of the folder that a file is in; without digests where there is no ``run.json``, or an older version's.

        Raises InputError for a ``run.json`` that cannot be read.
        """
        file = path.parent / "run.json"
        if not file.is_file():
            return cls(folder=path.parent)
        try:
            run = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{file}: cannot be read: {error}") from None
        return cls.of_run(path.parent, run if isinstance(run, dict) else {})

    def has(self, path: Path) -> bool:
        """Whether a file is to be there: listed, or where nothing is, there."""
        return path.is_file() if self.digests is None else self._name(path) in self.digests

    def checked(self, path: Path) -> Path:
        """The path itself. Raises InputError where the file is not what was written."""
        if self.digests is None:
            return path
        wanted = self.digests.get(self._name(path))
        if wanted is None:
            raise InputError(f"{path}: not among the parts that were listed", remedy=self.remedy)
        if not path.is_file():
            raise InputError(f"{path}: missing; it was listed", remedy=self.remedy)
        if sha256(path) != wanted:
            raise InputError(f"{path}: was changed after it was written (another sha256)", remedy=self.remedy)
        return path

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

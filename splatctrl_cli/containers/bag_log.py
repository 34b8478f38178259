"""Opens a recorded log by its content: one file, or the folder of a ROS 2 bag."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from splatctrl_cli.containers.bag1_log import Bag1Log
from splatctrl_cli.containers.compressed_log import (
    UnpackedFile,
    UnpackedFileLog,
    UnpackedMessagesLog,
    check_compression,
)
from splatctrl_cli.containers.db3_log import Db3Log
from splatctrl_cli.containers.mcap_log import McapLog
from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.listing import names_in

_ZSTD = b"\x28\xb5\x2f\xfd"


class SplitLog:
    """Files of one recording, read one after the other."""

    def __init__(self, path: Path, parts: tuple[RawLog, ...], container: str, note: str = "") -> None:
        """note: what is wrong with the folder itself, counted as damage; empty where nothing."""
        self.path = path
        self.files = tuple(file for part in parts for file in part.files)
        self.container = container
        self._parts, self._note = parts, note

    def topics(self) -> tuple[Topic, ...]:
        """The topics of all parts, each once."""
        return tuple(dict.fromkeys(topic for part in self._parts for topic in part.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of each part in turn."""
        if self._note:
            damage.add(self._note)
        for part in self._parts:
            yield from part.messages(damage, names)


def open_raw_log(path: Path) -> RawLog:
    """The log at `path`: .mcap, .bag, .db3 or a ROS 2 bag folder.

    Raises InputError where it is none of these, or cannot be read at all.
    """
    if path.is_dir():
        return _open_folder(path)
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty (0 bytes)", remedy="record or copy it again")
    with path.open("rb") as stream:
        magic = stream.read(16)
    if magic.startswith(b"\x89MCAP0\r\n"):
        return McapLog(path)
    if magic.startswith(b"#ROSBAG V"):
        return Bag1Log(path)
    if magic.startswith(b"SQLite format 3"):
        return Db3Log(path)
    if magic.startswith(_ZSTD):
        return _open_compressed(path)
    if path.suffix in {".mcap", ".bag", ".db3"}:
        raise InputError(
            f"{path}: does not begin like a {path.suffix} file (first bytes {magic[:8]!r})",
            remedy="the file is damaged or has the wrong name",
        )
    raise InputError(
        f"{path}: unknown kind of file", remedy="expected .mcap, .bag, .db3, a bag folder, X.capture/ or a .toml"
    )


def is_bag_folder(path: Path) -> bool:
    """Whether a folder looks like a ROS 2 bag."""
    return bool(_storage_files(path)) or (path / "metadata.yaml").is_file()


def _open_folder(path: Path) -> RawLog:
    told, note = _metadata(path)
    files = _ordered_files(path, told)
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{path}: metadata.yaml names {missing[0]}, which is not there", remedy="copy the whole bag")
    if not files:
        raise InputError(f"{path}: a bag folder without .mcap or .db3 files", remedy="copy the whole bag")
    mode = str(told.get("compression_mode", "")).lower()
    if mode:
        check_compression(path, str(told.get("compression_format")))
    parts = tuple(open_raw_log(file) for file in files)
    kind = "mcap" if ".mcap" in files[0].suffixes else "sqlite3"
    container = f"ROS 2 bag ({kind}, {len(parts)} file{'s' if len(parts) > 1 else ''})"
    log = SplitLog(path, parts, container, note)
    is_by_message = mode == "message" or (not told and _begins_compressed(parts))
    return UnpackedMessagesLog(log) if is_by_message else log


def told_formats(path: Path) -> set[str]:
    """The serialization formats that a bag folder's metadata.yaml names; none for anything else."""
    if not path.is_dir():
        return set()
    try:
        topics = _metadata(path)[0].get("topics_with_message_count") or ()
        return {str(topic["topic_metadata"]["serialization_format"]) for topic in topics}
    except (KeyError, TypeError):
        return set()


def _begins_compressed(parts: tuple[RawLog, ...]) -> bool:
    """Whether the first message is a zstd frame: CDR begins with its own four bytes, of which the first is 0."""
    first = next((message for part in parts for message in part.messages(Damage())), None)
    return first is not None and first.data.startswith(_ZSTD)


def _open_compressed(path: Path) -> RawLog:
    file = UnpackedFile(path)
    if file.unpacked.stat().st_size == 0:
        raise InputError(f"{path}: {file.note or 'holds nothing'}", remedy="copy it again")
    with file.unpacked.open("rb") as stream:
        if stream.read(4) == _ZSTD:
            raise InputError(f"{path}: compressed twice", remedy="unpack it with zstd -d")
    try:
        return UnpackedFileLog(file, open_raw_log(file.unpacked))
    except InputError as error:
        message = error.message.removeprefix(f"{file.unpacked}: ")
        raise InputError(f"{path}: {message}", remedy=error.remedy) from None


def _ordered_files(path: Path, told: dict[str, Any]) -> list[Path]:
    """The storage files in recording order: as metadata.yaml lists them, else by the numbers in their names."""
    names = told.get("relative_file_paths")
    if names:
        return [path / Path(name).name for name in dict.fromkeys(names)]
    return sorted(_storage_files(path), key=lambda p: [int(n) for n in re.findall(r"\d+", p.name)])


def _storage_files(path: Path) -> list[Path]:
    return [path / name for name in names_in(path) if name.endswith((".mcap", ".db3", ".mcap.zstd", ".db3.zstd"))]


def _metadata(path: Path) -> tuple[dict[str, Any], str]:
    """What metadata.yaml says, and what is wrong with it; a bag can be read without."""
    file = path / "metadata.yaml"
    if not file.is_file():
        return {}, ""
    try:
        told = dict(yaml.safe_load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"])
        if not all(isinstance(name, str) for name in told.get("relative_file_paths") or ()):
            raise ValueError("a file's name is no text")
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):  # an undecodable text is a ValueError
        return {}, f"{file.name}: is not the metadata of a ROS 2 bag; read without it, files by their numbers"
    return told, ""

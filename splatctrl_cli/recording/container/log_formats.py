"""Recorded logs opened by content: files, ROS 2 bag folders, logs of one session.

Files or messages may be compressed with zstd.
"""

import heapq
import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import yaml
import zstandard

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.summary import names_in
from splatctrl_cli.formats.unpacking import (
    FREE_BYTES,
    MAX_BLOCK,
    MAX_WINDOW,
    PIECE,
    BadBlockError,
    Budget,
    unpacked_start,
)
from splatctrl_cli.recording.container.bag_logs import Bag1Log, Db3Log
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, JoinedLog, RawLog, RawMessage

_MOST_RATIO = 100  # of an unpacked file, on disk, to the compressed one


def unpack(path: Path, target: Path) -> str:
    """Unpack a .zstd as far as possible; return the fault, or ""."""
    left = FREE_BYTES + _MOST_RATIO * path.stat().st_size
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    with path.open("rb") as source, target.open("wb") as written:
        stream = decompressor.stream_reader(source, read_across_frames=True)
        while True:
            try:
                piece = stream.read(PIECE)
            except zstandard.ZstdError:
                return "cannot be decompressed further"
            if not piece:
                return ""
            left -= len(piece)
            if left < 0:
                return f"unpacks to over {_MOST_RATIO} times its size"
            written.write(piece)


class UnpackedMessagesLog(JoinedLog):
    """A log of zstd messages."""

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield unpacked messages; failures are counted."""
        budget = Budget(sum(file.stat().st_size for file in self.files))
        for message in super().messages(damage, names):
            try:
                yield replace(message, data=_unpacked_message(message.data, budget))
            except BadBlockError as error:
                damage.add(f"{message.topic.name}: a message was left out: {error}")


def _unpacked_message(data: bytes, budget: Budget) -> bytes:
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError:
        raise BadBlockError("is not a zstd frame") from None
    if size >= 0:
        return budget.unpacked(data, "zstd", size)
    return budget.unpacked(data, "zstd", len(unpacked_start(data, "zstd", MAX_BLOCK)))


_ZSTD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, kw_only=True)
class Container:
    """A log format: suffix, first bytes, opener."""

    suffix: str
    magic: bytes
    open: Callable[[Path], RawLog]


CONTAINERS = (
    Container(suffix=".mcap", magic=b"\x89MCAP0\r\n", open=McapLog),
    Container(suffix=".bag", magic=b"#ROSBAG V", open=Bag1Log),
    Container(suffix=".db3", magic=b"SQLite format 3", open=Db3Log),
)
SUFFIXES = tuple(kind.suffix for kind in CONTAINERS)


class SessionLog(JoinedLog):
    """Logs recorded at the same time, such as cameras and joints, merged by log time."""

    def __init__(self, parts: tuple[RawLog, ...]) -> None:
        path = parts[0].path.with_name("+".join(part.path.name for part in parts))
        super().__init__(path, parts, " + ".join(dict.fromkeys(part.container for part in parts)))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of all parts by log time.

        If parts share a topic, all are read: skipping would reorder its messages between passes.
        """
        pushed = None if names is None or self._share(names) else names
        parts = (part.messages(damage, pushed) for part in self._parts)
        for message in heapq.merge(*parts, key=lambda message: message.log_time_ns):
            if names is None or message.topic.name in names:
                yield message

    def _share(self, names: Collection[str]) -> bool:
        seen: set[str] = set()
        for part in self._parts:
            here = {topic.name for topic in part.topics()}
            if not here or seen & here & set(names):  # a log without index may hold anything
                return True
            seen |= here
        return False


def open_raw_log(path: Path) -> RawLog:
    """Open .mcap, .bag, .db3 or a ROS 2 bag folder, with zstd messages unpacked.

    Raises InputError for others, and unreadable ones.
    """
    if path.is_dir():
        return _open_folder(path)
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty (0 bytes)", remedy="record or copy it again")
    with path.open("rb") as stream:
        magic = stream.read(16)
    kind = next((kind for kind in CONTAINERS if magic.startswith(kind.magic)), None)
    if kind is not None:
        log = kind.open(path)
        first = () if isinstance(log, Bag1Log) else islice(log.messages(Damage()), 5)  # some may be damaged
        is_packed = any(m.topic.encoding == "cdr" and m.data.startswith(_ZSTD) for m in first)  # CDR begins with a 0
        return UnpackedMessagesLog(path, (log,), log.container) if is_packed else log
    if magic.startswith(_ZSTD):
        return _open_compressed(path)
    if path.suffix in SUFFIXES:
        raise InputError(
            f"{path}: does not begin like a {path.suffix} file (first bytes {magic[:8]!r})",
            remedy="the file is damaged or has the wrong name",
        )
    raise InputError(
        f"{path}: unknown kind of file", remedy="expected .mcap, .bag, .db3, a bag folder, X.capture/ or a .toml"
    )


def is_bag_folder(path: Path) -> bool:
    """True for a likely ROS 2 bag."""
    return bool(_storage_files(path)) or (path / "metadata.yaml").is_file()


def _open_folder(path: Path) -> RawLog:
    told, note = _metadata(path)
    files = _ordered_files(path, told)
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{path}: metadata.yaml names {missing[0]}, which is not there", remedy="copy the whole bag")
    if not files:
        raise InputError(f"{path}: a bag folder without .mcap or .db3 files", remedy="copy the whole bag")
    mode, compression = str(told.get("compression_mode", "")).lower(), str(told.get("compression_format"))
    if mode and compression != "zstd":
        raise InputError(
            f"{path}: compression {compression!r} is unknown, expected zstd", remedy="rewrite the bag with zstd"
        )
    parts = tuple(open_raw_log(file) for file in files)
    kind = "mcap" if ".mcap" in files[0].suffixes else "sqlite3"
    return JoinedLog(path, parts, f"ROS 2 bag ({kind}, {len(parts)} file{'s' if len(parts) > 1 else ''})", note=note)


def told_formats(path: Path) -> set[str]:
    """Serialization formats in a bag folder's metadata.yaml."""
    if not path.is_dir():
        return set()
    try:
        topics = _metadata(path)[0].get("topics_with_message_count") or ()
        return {str(topic["topic_metadata"]["serialization_format"]) for topic in topics}
    except (KeyError, TypeError):
        return set()


def _open_compressed(path: Path) -> RawLog:
    """Unpack into a temporary folder that lives as long as the log."""
    folder = Path(tempfile.mkdtemp(prefix="splatctrl-"))
    file = folder / path.stem
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        note = unpack(path, file)
        with file.open("rb") as stream:
            start = stream.read(4)
        if not start:
            raise InputError(f"{path}: {note or 'holds nothing'}", remedy="copy it again")
        if start == _ZSTD:
            raise InputError(f"{path}: compressed twice", remedy="unpack it with zstd -d")
        try:
            part = open_raw_log(file)
        except InputError as error:
            message = error.message.removeprefix(f"{file}: ")
            raise InputError(f"{path}: {message}", remedy=error.remedy) from None
        log = JoinedLog(path, (part,), part.container, files=(path,), note=f"{path.name}: {note}" if note else "")
        weakref.finalize(log, stack.pop_all().close)
    return log


def _ordered_files(path: Path, told: dict[str, Any]) -> list[Path]:
    """Files in recording order: metadata.yaml's, else by numbers in names."""
    names = told.get("relative_file_paths")
    if names:
        return [path / Path(name).name for name in dict.fromkeys(names)]
    return sorted(_storage_files(path), key=lambda p: [int(n) for n in re.findall(r"\d+", p.name)])


def _storage_files(path: Path) -> list[Path]:
    return [path / name for name in names_in(path) if name.endswith((".mcap", ".db3", ".mcap.zstd", ".db3.zstd"))]


def _metadata(path: Path) -> tuple[dict[str, Any], str]:
    """Metadata and its fault; a bag can be read without."""
    file = path / "metadata.yaml"
    if not file.is_file():
        return {}, ""
    try:
        told = dict(yaml.safe_load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"])
        if not all(isinstance(name, str) for name in told.get("relative_file_paths") or ()):
            raise ValueError("a file's name is not text")
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):  # an undecodable text is a ValueError
        return {}, f"{file.name}: is not the metadata of a ROS 2 bag; read without it, files by their numbers"
    return told, ""

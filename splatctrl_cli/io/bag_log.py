"""Opens a recorded log by its content; ROS 2 sqlite3 bags and compressed bag folders are read through rosbags."""

import re
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader as Bag2Reader
from rosbags.rosbag2 import ReaderError as Bag2Error
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.bag1_log import Bag1Log
from splatctrl_cli.io.mcap_log import McapLog
from splatctrl_cli.io.raw_log import Damage, RawLog, RawMessage, Topic

_UNREADABLE = (Bag2Error, ValueError, RuntimeError, KeyError, EOFError, AssertionError, OSError)


class BagLog:
    """A log that one rosbags reader reads: one sqlite3 file, or a compressed ROS 2 bag folder."""

    def __init__(self, path: Path, reader_type: Any, container: str) -> None:
        self.path = path
        self.files = (path,) if path.is_file() else tuple(sorted(p for p in path.iterdir() if p.is_file()))
        self.container = container
        self._reader_type = reader_type
        with closing(self._opened()) as reader:
            self._topics = {connection.id: self._topic(connection) for connection in reader.connections}

    def topics(self) -> tuple[Topic, ...]:
        """The connections of the bag's index."""
        return tuple(self._topics.values())

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages by log time; reading stops at the first damaged place."""
        with closing(self._opened()) as reader:
            wanted = [c for c in reader.connections if names is None or c.topic in names]
            if not wanted:
                return
            messages = iter(reader.messages(connections=wanted))
            while True:
                try:
                    connection, log_time_ns, data = next(messages)
                except StopIteration:
                    return
                except Exception as error:  # the readers let errors of sqlite, bz2 and lz4 through as they are
                    damage.add(f"{self.path.name}: unreadable from here on: {error}")
                    return
                yield RawMessage(topic=self._topics[connection.id], log_time_ns=log_time_ns, data=bytes(data))

    def _opened(self) -> Any:
        reader = self._reader_type(self.path)
        try:
            reader.open()
        except _UNREADABLE as error:
            raise InputError(
                f"{self.path}: not a readable {self.container}: {error}", remedy="try 'ros2 bag reindex'"
            ) from None
        return reader

    def _topic(self, connection: Any) -> Topic:
        return Topic(
            name=connection.topic,
            type_name=connection.msgtype,
            encoding=connection.ext.serialization_format,
            definition=connection.msgdef.data,
            definition_format="idl" if connection.msgdef.format == MessageDefinitionFormat.IDL else "msg",
        )


class SplitLog:
    """Files of one recording, read one after the other."""

    def __init__(self, path: Path, parts: tuple[RawLog, ...], container: str) -> None:
        self.path = path
        self.files = tuple(file for part in parts for file in part.files)
        self.container = container
        self._parts = parts

    def topics(self) -> tuple[Topic, ...]:
        """The topics of all parts, each once."""
        return tuple(dict.fromkeys(topic for part in self._parts for topic in part.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of each part in turn."""
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
        return BagLog(path, Sqlite3Reader, "ROS 2 bag (sqlite3)")
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
    files = _ordered_files(path)
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{path}: metadata.yaml names {missing[0]}, which is not there", remedy="copy the whole bag")
    if not files:
        raise InputError(f"{path}: a bag folder without .mcap or .db3 files", remedy="copy the whole bag")
    if any(file.suffix == ".zstd" for file in files) or _metadata(path).get("compression_mode"):
        return BagLog(path, Bag2Reader, "ROS 2 bag (compressed)")
    parts = tuple(open_raw_log(file) for file in files)
    kind = "mcap" if files[0].suffix == ".mcap" else "sqlite3"
    return SplitLog(path, parts, f"ROS 2 bag ({kind}, {len(parts)} file{'s' if len(parts) > 1 else ''})")


def _ordered_files(path: Path) -> list[Path]:
    """The storage files in recording order: as metadata.yaml lists them, else by the numbers in their names."""
    names = _metadata(path).get("relative_file_paths")
    if names:
        return [path / Path(name).name for name in names]
    return sorted(_storage_files(path), key=lambda p: [int(n) for n in re.findall(r"\d+", p.name)])


def _storage_files(path: Path) -> list[Path]:
    return [p for p in sorted(path.iterdir()) if p.name.endswith((".mcap", ".db3", ".mcap.zstd", ".db3.zstd"))]


def _metadata(path: Path) -> dict[str, Any]:
    file = path / "metadata.yaml"
    if not file.is_file():
        return {}
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        return dict(content["rosbag2_bagfile_information"])
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError):
        raise InputError(f"{file}: not the metadata of a ROS 2 bag", remedy="try 'ros2 bag reindex'") from None

"""ROS 2 bags that were compressed with zstd, file by file or message by message."""

import shutil
import tempfile
import weakref
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import zstandard

from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.unpacking import (
    FREE_BYTES,
    MAX_BLOCK,
    MAX_WINDOW,
    BadBlockError,
    Budget,
    unpacked_start,
)

_PIECE = 1 << 20
_MOST_RATIO = 100  # of an unpacked file, on disk, to the compressed one


class UnpackedFile:
    """A .zstd file, unpacked into a temporary folder that goes when this object does."""

    def __init__(self, path: Path) -> None:
        self.path = path
        folder = tempfile.mkdtemp(prefix="splatctrl-")
        self._remove = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.unpacked = Path(folder) / path.stem
        self.note = self._unpack()

    def _unpack(self) -> str:
        """Unpack as far as it goes; what stopped it, empty where nothing."""
        left = FREE_BYTES + _MOST_RATIO * self.path.stat().st_size
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        with self.path.open("rb") as source, self.unpacked.open("wb") as target:
            stream = decompressor.stream_reader(source, read_across_frames=True)
            while True:
                try:
                    piece = stream.read(_PIECE)
                except zstandard.ZstdError:
                    return "cannot be decompressed further"
                if not piece:
                    return ""
                left -= len(piece)
                if left < 0:
                    return f"unpacks to over {_MOST_RATIO} times its size"
                target.write(piece)


class UnpackedFileLog:
    """The log in a .zstd file."""

    def __init__(self, file: UnpackedFile, log: RawLog) -> None:
        self.path = file.path
        self.files = (file.path,)
        self.container = log.container
        self._file, self._log = file, log  # the file keeps its folder

    def topics(self) -> tuple[Topic, ...]:
        """Those of the log."""
        return self._log.topics()

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the log's messages, as far as the file could be unpacked."""
        if self._file.note:
            damage.add(f"{self.path.name}: {self._file.note}")
        yield from self._log.messages(damage, names)


class UnpackedMessagesLog:
    """A log whose messages are zstd frames."""

    def __init__(self, log: RawLog) -> None:
        self.path, self.files, self.container = log.path, log.files, log.container
        self._log = log

    def topics(self) -> tuple[Topic, ...]:
        """Those of the log."""
        return self._log.topics()

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages unpacked; one that does not unpack is counted."""
        budget = Budget(sum(file.stat().st_size for file in self.files))
        for message in self._log.messages(damage, names):
            try:
                yield replace(message, data=_unpacked_message(message.data, budget))
            except BadBlockError as error:
                damage.add(f"{message.topic.name}: a message was left out: {error}")


def _unpacked_message(data: bytes, budget: Budget) -> bytes:
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError:
        raise BadBlockError("is no zstd frame") from None
    if size >= 0:
        return budget.unpacked(data, "zstd", size)
    content = unpacked_start(data, "zstd", MAX_BLOCK)
    return budget.unpacked(data, "zstd", len(content))


def check_compression(path: Path, kind: str) -> None:
    """Raise InputError for a compression other than zstd."""
    if kind != "zstd":
        raise InputError(
            f"{path}: compression {kind!r} is unknown, expected zstd", remedy="rewrite the bag with zstd"
        )

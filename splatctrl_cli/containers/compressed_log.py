"""ROS 2 bags that were compressed with zstd, file by file or message by message."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import zstandard

from splatctrl_cli.containers.raw_log import Damage, JoinedLog, RawLog, RawMessage
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.unpacking import (
    FREE_BYTES,
    MAX_BLOCK,
    MAX_WINDOW,
    PIECE,
    BadBlockError,
    Budget,
    unpacked_start,
)

_MOST_RATIO = 100  # of an unpacked file, on disk, to the compressed one


def unpack(path: Path, target: Path) -> str:
    """Write what a .zstd file holds, as far as it unpacks; what stopped it, empty where nothing."""
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
    """A log whose messages are zstd frames."""

    def __init__(self, log: RawLog) -> None:
        super().__init__(log.path, (log,), log.container)

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages unpacked; one that does not unpack is counted."""
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
    content = unpacked_start(data, "zstd", MAX_BLOCK)
    return budget.unpacked(data, "zstd", len(content))


def check_compression(path: Path, kind: str) -> None:
    """Raise InputError for a compression other than zstd."""
    if kind != "zstd":
        raise InputError(
            f"{path}: compression {kind!r} is unknown, expected zstd", remedy="rewrite the bag with zstd"
        )

"""A video file beside a log, with the stamps of its images in a file of its own, as a log of one colour topic."""

import re
from collections.abc import Collection, Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from splatctrl_cli.containers.log_formats import open_raw_log
from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.errors import InputError
from splatctrl_cli.libraries import of_extra
from splatctrl_cli.logs.decoder import IMAGE, VIDEO, pack_image
from splatctrl_cli.logs.video import EXTRA, LIBRARY, with_video
from splatctrl_cli.records import SECOND_NS, Stamps

SUFFIXES = (".mp4", ".mkv", ".mov", ".avi")
_BESIDE = ("{}.csv", "{}.txt", "{}_timestamps.csv", "{}_timestamps.txt")
_UNITS_NS = ((11, SECOND_NS), (14, 1_000_000), (17, 1_000), (99, 1))  # by at most so many digits before the point
_TIME = re.compile("time|stamp", re.IGNORECASE)


def open_log(path: Path) -> RawLog:
    """A log, or a video file with its stamps beside it. Raises InputError."""
    return VideoFileLog(path) if path.suffix.lower() in SUFFIXES else with_video(open_raw_log(path))


class VideoFileLog:
    """The images of ``X.mp4`` as topic ``/X``, stamped and logged at the times that ``X.csv`` or its kin has.

    The file beside it has a line for each image: a stamp, or of a table the column whose name says time or stamp. Of
    its digits before the point 10 are seconds since 1970, 13 milliseconds, 16 microseconds and 19 nanoseconds; fewer
    than ten are seconds. The images name no frame.
    """

    container = "video"

    def __init__(self, path: Path) -> None:
        self._av = of_extra(LIBRARY, EXTRA, "video files")
        self.path = path
        beside = next((file for form in _BESIDE if (file := path.with_name(form.format(path.stem))).is_file()), None)
        if beside is None:
            raise InputError(
                f"{path}: no stamps beside it",
                remedy=f"write {path.stem}.csv, a line for each image: its time in seconds",
            )
        self.files = (path, beside)
        self._stamps = _read_stamps(beside)
        self._topic = Topic(name=f"/{path.stem}", type_name=IMAGE, encoding=VIDEO, schema=path.suffix)

    def topics(self) -> tuple[Topic, ...]:
        """The one."""
        return (self._topic,)

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the images. Raises InputError where there are more, or fewer, than stamps."""
        if names is not None and self._topic.name not in names:
            return
        num, found = 0, Damage()
        for frame in self._frames(found):
            if frame is not None and num < len(self._stamps):
                yield self._message(frame, int(self._stamps[num]))
            num += 1
        for note in found.notes:
            damage.add(note)
        if num != len(self._stamps) and not found.count:
            raise InputError(
                f"{self.path}: {num} images, but {len(self._stamps)} stamps in {self.files[1].name}",
                remedy="write a stamp for each image of the file",
            )

    def _frames(self, damage: Damage) -> Iterator[Any]:
        """Images in the order in which they are shown, None for one that is damaged."""
        try:
            with self._av.open(str(self.path)) as container:
                if not container.streams.video:
                    raise InputError(f"{self.path}: a file without video", remedy="give the colour camera's video")
                for frame in container.decode(video=0):
                    if frame.is_corrupt:
                        damage.add(f"{self.path.name}: an image at {frame.time} s is damaged")
                    yield None if frame.is_corrupt else frame
        except (self._av.FFmpegError, OSError) as error:
            damage.add(f"{self.path.name}: cannot be decoded further: {error}")

    def _message(self, frame: Any, stamp_ns: int) -> RawMessage:
        stamp = SimpleNamespace(sec=stamp_ns // SECOND_NS, nanosec=stamp_ns % SECOND_NS)
        header = SimpleNamespace(stamp=stamp, frame_id="")
        data = pack_image(header, frame.to_ndarray(format="rgb24"))
        return RawMessage(topic=self._topic, log_time_ns=stamp_ns, data=data, file=self.path.name)


def _read_stamps(path: Path) -> Stamps:
    """The stamps [ns] of the images in their order. Raises InputError."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows, column = [re.split(r"[,;\s]+", line) for line in lines], 0
    if rows and _number(rows[0][0]) is None:
        column = next((i for i, name in enumerate(rows[0]) if _TIME.search(name)), -1)
        lines, rows = lines[1:], rows[1:]
    elif rows and len(rows[0]) > 1:
        column = -1
    if column < 0 or not rows:
        raise InputError(
            f"{path}: expected a stamp a line, or columns whose first line names one time or stamp",
            remedy="write the images' times alone, in seconds",
        )
    values = []
    for row, line in zip(rows, lines, strict=True):
        value = _number(row[column]) if column < len(row) else None
        if value is None:
            raise InputError(f"{path}: expected a time, got {line[:80]!r}", remedy="correct the line")
        values.append(value)
    digits = len(str(abs(int(values[0]))))
    unit_ns = next(unit for most, unit in _UNITS_NS if digits <= most)
    return np.array([round(value * unit_ns) for value in values], dtype=np.int64)


def _number(text: str) -> Decimal | None:
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    return value if value.is_finite() and abs(value) < 1 << 61 else None

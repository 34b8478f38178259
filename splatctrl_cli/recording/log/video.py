"""Logs with compressed video decoded to images, and video files with stamps as logs.

Reads H.264 and H.265 of foxglove.CompressedVideo (Annex B, an image per message; docs.foxglove.dev, CompressedVideo)
and ffmpeg_image_transport's FFMPEGPacket. Images without a prior key frame, or after a missing image, are dropped and
counted until the next key frame.
"""

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if, require
from splatctrl_cli.libraries import import_extra, is_installed
from splatctrl_cli.recording.container.log_formats import AZURE_KINECT, open_raw_log, refuse_foreign
from splatctrl_cli.recording.container.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.recording.log.decoder import IMAGE, VIDEO, MessageDecoder, UndecodableMessageError, pack_image
from splatctrl_cli.records import SECOND_NS, Stamps

LIBRARY, EXTRA = "av", "video"
CODECS = {"264": "h264", "265": "hevc", "hevc": "hevc"}  # by a part of the format's name
FORMATS = {  # the field that names the format, by the type of message
    "foxglove_msgs/msg/CompressedVideo": "format",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "encoding",
}
_GAP = "Frame num gap"  # FFmpeg says this of H.264 for its developers only
KEY_FRAME = "key frame"  # in every note on what was lost
OFTENER = "record a key frame every second, or cut the log at one"
_EARLY, _LATE = f"before its first {KEY_FRAME}", f"that follow missing or damaged ones, up to the next {KEY_FRAME},"


def is_video(topic: Topic) -> bool:
    return topic.type_name in FORMATS


@dataclass(kw_only=True)
class _Stream:
    """A topic's decoder.

    num: packets. waiting: (message without data, header) by packet. key: the last key frame. broken: packets since
    then with losses. num_early, num_late: images lost before the first key frame, and after it.
    """

    context: Any
    num: int = 0
    waiting: dict[int, tuple[RawMessage, Any]] = field(default_factory=dict)
    key: int | None = None
    broken: list[int] = field(default_factory=list)
    num_early: int = 0
    num_late: int = 0


class VideoLog(RawLog):
    def __init__(self, log: RawLog) -> None:
        self.inner = log
        self.path, self.files, self.container = log.path, log.files, log.container

    def topics(self) -> tuple[Topic, ...]:
        return tuple(map(_decoded_topic, self.inner.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        return self.decoded(self.inner.messages(damage, names), damage)

    def decoded(self, messages: Iterable[RawMessage], damage: Damage) -> Iterator[RawMessage]:
        streams: dict[str, _Stream | None] = {}
        decoder = MessageDecoder()
        for message in messages:
            if not is_video(message.topic):
                yield message
                continue
            try:
                packet = decoder.decode(message)
            except UndecodableMessageError as error:
                damage.add(str(error))
                continue
            name = message.topic.name
            if name not in streams:
                streams[name] = _stream(getattr(packet, FORMATS[message.topic.type_name]))
            stream = streams[name]
            if stream is None:  # no codec that is read
                yield message
                continue
            number, stream.num = stream.num, stream.num + 1
            stream.waiting[number] = replace(message, data=b""), packet.header
            yield from _images(stream, bytes(packet.data), number)
        for name, stream in streams.items():
            if stream is not None:
                yield from _images(stream, None)
                _lose(stream, list(stream.waiting))
                for num, where in ((stream.num_early, _EARLY), (stream.num_late, _LATE)):
                    if num:
                        damage.add(f"{name}: {num} images of video {where} left out: {OFTENER}", num)


def _stream(name: str) -> _Stream | None:
    codec = next((codec for word, codec in CODECS.items() if word in name.lower()), None)
    if codec is None:
        return None
    context = import_extra(LIBRARY, EXTRA, "video topics").CodecContext.create(codec, "r")
    context.thread_count = 1
    return _Stream(context=context)


def _decoded_topic(topic: Topic) -> Topic:
    return replace(topic, type_name=IMAGE, encoding=VIDEO, schema=topic.schema or topic.type_name, definition="")


def _images(stream: _Stream, data: bytes | None, number: int = 0) -> Iterator[RawMessage]:
    """Yield undamaged images that a packet completes; without data, the remaining ones."""
    frames, is_broken = _decode(stream.context, data, number)
    if is_broken:
        stream.broken.append(number)
    for frame in frames:
        if frame.is_corrupt:
            stream.broken.append(frame.pts)
        if frame.key_frame:
            _lose(stream, [other for other in stream.waiting if other < frame.pts])
            stream.key = frame.pts
            stream.broken = [other for other in stream.broken if other >= frame.pts]
        if frame.pts not in stream.waiting:
            continue
        if stream.key is None or any(stream.key <= other <= frame.pts for other in stream.broken):
            _lose(stream, [frame.pts])
            continue
        message, header = stream.waiting.pop(frame.pts)
        data = pack_image(header, frame.to_ndarray(format="rgb24"))
        yield replace(message, topic=_decoded_topic(message.topic), data=data)


def _decode(context: Any, data: bytes | None, number: int) -> tuple[list[Any], bool]:
    av = import_extra(LIBRARY, EXTRA, "video topics")
    packet = None if data is None else av.Packet(data)
    if packet is not None:
        packet.pts = number
    level = av.logging.get_level()
    av.logging.set_level(av.logging.DEBUG)
    av.logging.set_skip_repeated(False)
    try:
        with av.logging.Capture(local=True) as captured:
            frames, is_broken = list(context.decode(packet)), False
    except av.FFmpegError:
        frames, is_broken = [], True
    finally:
        av.logging.set_level(level)
    return frames, is_broken or any(how <= av.logging.ERROR or _GAP in words for how, _, words in captured)


def _lose(stream: _Stream, numbers: list[int]) -> None:
    for number in numbers:
        del stream.waiting[number]
    if stream.key is None:
        stream.num_early += len(numbers)
    else:
        stream.num_late += len(numbers)


SUFFIXES = (".mp4", ".mkv", ".mov", ".avi")
_STAMP_FILES = ("{}.csv", "{}.txt", "{}_timestamps.csv", "{}_timestamps.txt")
_UNITS_NS = ((11, SECOND_NS), (14, 1_000_000), (17, 1_000), (99, 1))  # by at most so many digits before the point
_TIME = re.compile("time|stamp", re.IGNORECASE)


def open_log(path: Path) -> RawLog:
    """Open a log, or a video file with stamps. Raises InputError for others.

    Video is decoded if the library is installed.
    """
    refuse_foreign(path)
    if path.suffix.lower() in SUFFIXES:
        return VideoFileLog(path)
    log = open_raw_log(path)
    topics = log.topics()  # none where there is no index
    return VideoLog(log) if (any(map(is_video, topics)) or not topics) and is_installed(LIBRARY) else log


class VideoFileLog(RawLog):
    """The images of ``X.mp4`` as topic ``/X``, at the times in ``X.csv`` or its kin.

    The stamp file has a stamp per line, or a column named time or stamp. Stamps with 10 digits before the point are
    seconds since 1970, with 13 milliseconds, 16 microseconds, 19 nanoseconds; with fewer than ten, seconds.
    """

    container = "video"

    def __init__(self, path: Path) -> None:
        self.path = path
        folder = require(
            next((file for form in _STAMP_FILES if (file := path.with_name(form.format(path.stem))).is_file()), None),
            f"{path}: expected a file of stamps next to it, got none",
            remedy=f"write {path.stem}.csv, a line for each image: its time in seconds"
            + (f"; if an Azure Kinect recorded it, {AZURE_KINECT}" if path.suffix.lower() == ".mkv" else ""),
        )
        self._av = import_extra(LIBRARY, EXTRA, "video files")
        self.files, self._stamps = (path, folder), _read_stamps(folder)
        self.channels = {0: Topic(name=f"/{path.stem}", type_name=IMAGE, encoding=VIDEO, schema=path.suffix)}

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the images. Raises InputError if images and stamps differ in number."""
        if names is not None and self.channels[0].name not in names:
            return
        num, losses = 0, Damage()
        for frame in self._frames(losses):
            if frame is not None and num < len(self._stamps):
                seconds, nanoseconds = divmod(int(self._stamps[num]), SECOND_NS)
                header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id="")
                yield RawMessage(
                    topic=self.channels[0],
                    log_time_ns=int(self._stamps[num]),
                    data=pack_image(header, frame.to_ndarray(format="rgb24")),
                    file=self.path.name,
                )
            num += 1
        for note in losses.notes:
            damage.add(note)
        refuse_if(
            num != len(self._stamps) and not losses.count,
            f"{self.path}: {num} images, but {len(self._stamps)} stamps in {self.files[1].name}",
            remedy="write a stamp for each image of the file",
        )

    def _frames(self, damage: Damage) -> Iterator[Any]:
        try:
            with self._av.open(str(self.path)) as container:
                refuse_if(
                    not container.streams.video,
                    f"{self.path}: a file without video",
                    remedy="give the colour camera's video",
                )
                for frame in container.decode(video=0):
                    if frame.is_corrupt:
                        damage.add(f"{self.path.name}: an image at {frame.time} s is damaged")
                    yield None if frame.is_corrupt else frame
        except (self._av.FFmpegError, OSError) as error:
            damage.add(f"{self.path.name}: cannot be decoded further: {error}")


def _read_stamps(path: Path) -> Stamps:
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows, column = [re.split(r"[,;\s]+", line) for line in lines], 0
    if rows and _number(rows[0][0]) is None:
        column = next((i for i, name in enumerate(rows[0]) if _TIME.search(name)), -1)
        lines, rows = lines[1:], rows[1:]
    elif rows and len(rows[0]) > 1:
        column = -1
    refuse_if(
        column < 0 or not rows,
        f"{path}: expected a stamp a line, or columns whose first line names one time or stamp",
        remedy="write the images' times alone, in seconds",
    )
    numbers = [_number(row[column]) if column < len(row) else None for row in rows]
    values = [value for value in numbers if value is not None]
    if len(values) < len(rows):
        line = lines[numbers.index(None)]
        raise InputError(f"{path}: expected a time, got {line[:80]!r}", remedy="correct the line")
    digits = len(str(abs(int(values[0]))))
    unit_ns = next(unit for most, unit in _UNITS_NS if digits <= most)
    return np.array([round(value * unit_ns) for value in values], dtype=np.int64)


def _number(text: str) -> Decimal | None:
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    return value if value.is_finite() and abs(value) < 1 << 61 else None

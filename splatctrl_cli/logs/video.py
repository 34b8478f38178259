"""Compressed video in a log, decoded as its messages pass by: each image takes the place of its message.

Read are H.264 and H.265 of foxglove.CompressedVideo (Annex B, an image a message; docs.foxglove.dev, CompressedVideo)
and of ffmpeg_image_transport's FFMPEGPacket. An image needs those before it, back to a key frame: what has no key
frame before it, or follows an image that is missing, is left out up to the next key frame, and counted. FFmpeg itself
would show such images, with wrong blocks in them; by what it says of a packet a missing one is told.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.libraries import is_installed, of_extra
from splatctrl_cli.logs.decoder import IMAGE, VIDEO, MessageDecoder, UndecodableMessageError, pack_image

LIBRARY, EXTRA = "av", "video"
CODECS = {"264": "h264", "265": "hevc", "hevc": "hevc"}  # by what a format's name holds
FORMATS = {  # the field that names the format, by the type of message
    "foxglove_msgs/msg/CompressedVideo": "format",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "encoding",
}
_GAP = "Frame num gap"  # FFmpeg says this of H.264 for its developers only
KEY_FRAME = "key frame"  # in every note on what was lost
OFTENER = "record a key frame every second, or cut the log at one"
_EARLY, _LATE = f"before its first {KEY_FRAME}", f"that follow missing or damaged ones, up to the next {KEY_FRAME},"


def is_video(topic: Topic) -> bool:
    """Whether a topic's messages are packets of video."""
    return topic.type_name in FORMATS


@dataclass(kw_only=True)
class _Stream:
    """One topic's decoder: how many packets it had, those that wait for their image (message without data, header) by
    number, the last key frame, packets since then at which something was missing, images lost before and after it.
    """

    context: Any
    num: int = 0
    waiting: dict[int, tuple[RawMessage, Any]] = field(default_factory=dict)
    key: int | None = None
    broken: list[int] = field(default_factory=list)
    num_early: int = 0
    num_late: int = 0


class VideoLog:
    """A log with the images of its video."""

    def __init__(self, log: RawLog) -> None:
        self.inner = log
        self.path, self.files, self.container = log.path, log.files, log.container

    def topics(self) -> tuple[Topic, ...]:
        """Of the log, those of video as they are decoded."""
        return tuple(map(_decoded_topic, self.inner.topics()))

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the log's messages, images of video as they come out of the decoder."""
        return self.decoded(self.inner.messages(damage, names), damage)

    def decoded(self, messages: Iterable[RawMessage], damage: Damage) -> Iterator[RawMessage]:
        """Some messages of the log, in its order."""
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
            yield from _pushed(stream, message, packet)
        for name, stream in streams.items():
            if stream is not None:
                yield from _images(stream, None)
                _count(name, stream, damage)


def with_video(log: RawLog) -> RawLog:
    """The log, with the images of its video where it has any and the library is installed."""
    topics = log.topics()  # none where there is no index
    has_video = any(map(is_video, topics)) or not topics
    return VideoLog(log) if has_video and is_installed(LIBRARY) else log


def _stream(name: str) -> _Stream | None:
    codec = next((codec for word, codec in CODECS.items() if word in name.lower()), None)
    if codec is None:
        return None
    context = of_extra(LIBRARY, EXTRA, "video topics").CodecContext.create(codec, "r")
    context.thread_count = 1
    return _Stream(context=context)


def _decoded_topic(topic: Topic) -> Topic:
    return replace(topic, type_name=IMAGE, encoding=VIDEO, schema=topic.schema or topic.type_name, definition="")


def _pushed(stream: _Stream, message: RawMessage, packet: Any) -> Iterator[RawMessage]:
    """The images that a packet lets out: its own, or earlier ones of a stream that reorders."""
    number, header = stream.num, packet.header
    stream.num += 1
    stream.waiting[number] = replace(message, data=b""), header
    yield from _images(stream, bytes(packet.data), number)


def _images(stream: _Stream, data: bytes | None, number: int = 0) -> Iterator[RawMessage]:
    """Whole images as messages, by the number of the packet that they came in; without data, the rest of them."""
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
        pixels = frame.to_ndarray(format="rgb24")
        yield replace(message, topic=_decoded_topic(message.topic), data=pack_image(header, pixels))


def _decode(context: Any, data: bytes | None, number: int) -> tuple[list[Any], bool]:
    """What comes out of the decoder, and whether it said that something was missing or damaged."""
    av = of_extra(LIBRARY, EXTRA, "video topics")
    packet = None if data is None else av.Packet(data)
    if packet is not None:
        packet.pts = number
    level = av.logging.get_level()
    av.logging.set_level(av.logging.DEBUG)
    av.logging.set_skip_repeated(False)
    try:
        with av.logging.Capture(local=True) as said:
            frames, is_broken = list(context.decode(packet)), False
    except av.FFmpegError:
        frames, is_broken = [], True
    finally:
        av.logging.set_level(level)
    return frames, is_broken or any(how <= av.logging.ERROR or _GAP in words for how, _, words in said)


def _lose(stream: _Stream, numbers: list[int]) -> None:
    for number in numbers:
        del stream.waiting[number]
    if stream.key is None:
        stream.num_early += len(numbers)
    else:
        stream.num_late += len(numbers)


def _count(topic: str, stream: _Stream, damage: Damage) -> None:
    """Tell `damage` what became no image."""
    _lose(stream, list(stream.waiting))
    for num, where in ((stream.num_early, _EARLY), (stream.num_late, _LATE)):
        if num:
            damage.add(f"{topic}: {num} images of video {where} left out: {OFTENER}", num)

"""One pass over a log for all that `check` asks: the survey's own, with every message watched on its way."""

import re
from collections.abc import Collection, Iterator

from splatctrl_cli.checks.check_images import ImageWatch
from splatctrl_cli.checks.check_times import TimesWatch
from splatctrl_cli.containers.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.logs.decoder import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    TRANSFORMS,
    MessageDecoder,
    UndecodableMessageError,
    header_stamp_ns,
    is_ros,
    stamp_ns,
)
from splatctrl_cli.logs.messages import color_of, depth_of, num_invalid, read_image
from splatctrl_cli.logs.options import SourceOptions

_HEADED = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu")
_FIRST_FIELD = re.compile(r"^(?:std_msgs/(?:msg/)?)?Header\s+\w+")


class LogWatch:
    """A log whose messages are looked at while somebody else reads them; images are decoded here, as far as needed.

    num_images: reading ends once a topic has had as many images. files: first and last log time by file.
    """

    def __init__(self, log: RawLog, options: SourceOptions, num_images: int | None = None) -> None:
        self._log, self._scale, self._num_images = log, options.depth_scale, num_images
        self._by_log_time = options.stamps == "log"
        self.path, self.files, self.container = log.path, log.files, log.container
        self.times: dict[str, TimesWatch] = {}
        self.transforms: dict[str, TimesWatch] = {}
        self.images: dict[str, ImageWatch] = {}
        self.changed_infos: dict[str, int] = {}
        self.spans: dict[str, tuple[int, int]] = {}
        self.is_whole = True
        self._infos: dict[str, tuple[object, ...]] = {}
        self._decoder = MessageDecoder()
        self._headed: dict[Topic, bool] = {}

    @property
    def first_ns(self) -> int | None:
        """The first log time or stamp."""
        return min((t.first_ns for t in self.times.values() if t.first_ns), default=None)

    def topics(self) -> tuple[Topic, ...]:
        """Of the log."""
        return self._log.topics()

    def messages(self, damage: Damage, names: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Those of the log, each watched."""
        for message in self._log.messages(damage, names):
            self._take(message)
            yield message
            images = self.images.get(message.topic.name)
            if images is not None and images.count == self._num_images:
                self.is_whole = False
                return

    def _take(self, message: RawMessage) -> None:
        topic, name, stamp = message.topic, message.topic.name, message.log_time_ns
        first, last = self.spans.get(message.file, (stamp, stamp))
        self.spans[message.file] = min(first, stamp), max(last, stamp)
        has_stamps = not self._by_log_time and self._is_headed(topic)
        if has_stamps:
            try:
                stamp = header_stamp_ns(message)
            except UndecodableMessageError:
                has_stamps = False
        times = self.times.get(name)
        if times is None:
            times = self.times[name] = TimesWatch(name, has_stamps=has_stamps)
        times.add(stamp, message.log_time_ns)
        if not is_ros(topic):
            return
        try:
            if topic.type_name in (IMAGE, COMPRESSED_IMAGE):
                self._image(message, stamp)
            elif topic.type_name == CAMERA_INFO and name not in self.changed_infos:
                self._info(message, stamp)
            elif topic.type_name in TRANSFORMS and not name.endswith("tf_static"):
                self._transforms(message)
        except UndecodableMessageError:
            return  # the survey counts it

    def _is_headed(self, topic: Topic) -> bool:
        """Whether messages begin with a std_msgs/Header."""
        if topic not in self._headed:
            fields = [line.split("#")[0].strip() for line in topic.definition.splitlines()]
            first = next((line for line in fields if line), "")
            is_headed = bool(_FIRST_FIELD.match(first)) if topic.definition else topic.type_name in _HEADED
            self._headed[topic] = is_ros(topic) and (is_headed or topic.type_name in _HEADED)
        return self._headed[topic]

    def _image(self, message: RawMessage, stamp: int) -> None:
        name = message.topic.name
        images = self.images.setdefault(name, ImageWatch(name, self._scale))
        is_wanted = images.is_wanted()
        try:
            image = read_image(self._decoder.decode(message), message.topic.type_name, lazily=True)
            if is_wanted and image.kind == "depth":
                images.add_depth(stamp, depth_of(image, self._scale), image.encoding, num_invalid(image.pixels))
            elif is_wanted and image.kind == "color":
                images.add_color(stamp, color_of(image), image.encoding)
            else:
                images.add_undecoded(image.encoding, image.width, image.height)
        except (UndecodableMessageError, ValueError) as reason:
            images.add_bad(stamp, str(reason))

    def _info(self, message: RawMessage, stamp: int) -> None:
        info = self._decoder.decode(message)
        fields = {name.lower(): getattr(info, name) for name in ("K", "k", "D", "d") if hasattr(info, name)}
        said = (info.width, info.height, tuple(fields["k"]), tuple(fields["d"]))
        if self._infos.setdefault(message.topic.name, said) != said:
            self.changed_infos[message.topic.name] = stamp

    def _transforms(self, message: RawMessage) -> None:
        for item in self._decoder.decode(message).transforms:
            child = item.child_frame_id.strip("/")
            edge = f"tf {item.header.frame_id.strip('/')} -> {child}"
            if child not in self.transforms:
                self.transforms[child] = TimesWatch(edge, has_stamps=True)
            stamp = message.log_time_ns if self._by_log_time else stamp_ns(item.header)
            self.transforms[child].add(stamp, message.log_time_ns)

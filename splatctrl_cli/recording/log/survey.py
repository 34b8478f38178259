"""A first pass over a log: topics, stamps, frames, calibrations, joints, first images and ``robot_description``."""

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import IMAGES_BACK_NS, IMAGES_FEWEST, IMAGES_GAP, IMAGES_STEADY
from splatctrl_cli.recording.container.mcap_file import ChunkIndex
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage, RawLog, RawMessage, Topic
from splatctrl_cli.recording.log.decoder import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    OPTION,
    TRANSFORM,
    TRANSFORMS,
    MessageDecoder,
    RealSense,
    UndecodableMessageError,
    UnreadFormError,
    header_stamp_ns,
    is_ros,
    stamp_ns,
)
from splatctrl_cli.recording.log.messages import ImageMessage, read_image
from splatctrl_cli.recording.log.registration import TfTree
from splatctrl_cli.recording.log.state_messages import STANDARD_TYPES, STATE_TYPES, JointLog, read_states
from splatctrl_cli.recording.log.video import VideoLog
from splatctrl_cli.records import Bool, Float64

Stamps = Sequence[int] | NDArray[np.int64]
_BLOCK = 1 << 14  # pairs that are Python's numbers at once


def pair_images(color_ns: Stamps, depth_ns: Stamps, tolerance_ns: int) -> NDArray[np.int64]:
    """Pair colour and depth by index (K, 2), at most `tolerance_ns` apart, closest pairs first.

    Each index is used once; of equally close pairs the earlier wins. Sorted by colour stamp.
    """
    color, depth = np.asarray(color_ns, dtype=np.int64), np.asarray(depth_ns, dtype=np.int64)
    order = np.argsort(depth, kind="stable")
    first = np.searchsorted(depth[order], color - tolerance_ns, side="left")
    count = np.searchsorted(depth[order], color + tolerance_ns, side="right") - first
    i = np.repeat(np.arange(len(color)), count)  # every pair that is close enough
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)]
    closest = np.lexsort((j, i, depth[j], color[i], np.abs(color[i] - depth[j])))
    partner = np.full(len(color), -1, dtype=np.int64)
    is_free = np.ones(len(depth), dtype=np.bool_)
    for start in range(0, len(closest), _BLOCK):
        block = closest[start : start + _BLOCK]
        for a, b in zip(i[block].tolist(), j[block].tolist(), strict=True):
            if is_free[b] and partner[a] < 0:
                is_free[b], partner[a] = False, b
    paired = np.flatnonzero(partner >= 0)
    paired = paired[np.argsort(color[paired], kind="stable")]
    return np.stack([paired, partner[paired]], axis=1)


@dataclass(kw_only=True)
class StampClock:
    """A detector of header clocks that go back; single stamps may err.

    num_back: stamps over `IMAGES_BACK_NS` behind an earlier one. back_ns: how far behind the first was, at log time
    back_log_ns.
    """

    num_back: int = 0
    back_ns: int = 0
    back_log_ns: int = 0
    _latest_ns: int | None = None
    _latest_log_ns: int = 0

    def see(self, stamp_ns: int, log_time_ns: int) -> None:
        if self._latest_ns is None or stamp_ns > self._latest_ns:
            self._latest_ns, self._latest_log_ns = stamp_ns, log_time_ns
        elif self._latest_ns - stamp_ns > IMAGES_BACK_NS and log_time_ns > self._latest_log_ns:
            if not self.num_back:
                self.back_ns, self.back_log_ns = self._latest_ns - stamp_ns, log_time_ns
            self.num_back += 1


def first_of_each(stamps_ns: Stamps) -> NDArray[np.int64]:
    """Numbers (K,) of images with a new stamp."""
    return np.sort(np.unique(stamps_ns, return_index=True)[1]).astype(np.int64)


def dropped(stamps_ns: Stamps) -> tuple[int, int, float]:
    """Number of gaps, images missing in them, and the period [ns].

    The period is the median interval. Gaps count if three of four intervals are within a quarter of the period.
    """
    intervals = np.diff(np.unique(stamps_ns)).astype(np.float64)
    if len(intervals) < IMAGES_FEWEST:
        return 0, 0, 0.0
    period = float(np.median(intervals))
    is_steady = np.abs(intervals - period) <= IMAGES_STEADY * period
    gaps = intervals[(intervals > IMAGES_GAP * period) & (is_steady.mean() >= 0.75)]
    return len(gaps), int((np.rint(gaps / period) - 1).sum()), period


LARGE = 1 << 30  # bytes from which on an MCAP is described by its index
_MOST_BYTES = 64 << 20  # of chunks that are unpacked


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A CameraInfo's contents.

    width, height [px]. K (3, 3): of the raw, distorted image. projection (3, 3): of the rectified image (left part of
    P). rotation (3, 3): from the raw axes to the rectified. projection and rotation are zero if unset. valid (H, W):
    False where the lens did not see a rectified pixel. Size, K and projection fit binned or cropped images, sensor_K
    (3, 3) the whole sensor. cut: binning and region in words. is_possible: the region is inside.
    """

    width: int
    height: int
    K: Float64
    projection: Float64
    rotation: Float64
    distortion_model: str
    distortion: Float64
    frame_id: str
    valid: Bool | None = None
    sensor_K: Float64 = field(default_factory=lambda: np.zeros((3, 3)))
    cut: str = ""
    is_possible: bool = True


@dataclass(kw_only=True)
class TopicSurvey:
    """A topic; stamps_ns and clock (images only) are header stamps or log times."""

    topic: Topic
    count: int = 0
    first_log_ns: int = 0
    last_log_ns: int = 0
    stamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    clock: StampClock = field(default_factory=StampClock)
    first_image: ImageMessage | None = None
    calibration: Calibration | None = None
    joints: JointLog = field(default_factory=JointLog)

    @property
    def image(self) -> ImageMessage:
        """The first image, of a topic that is known to have one."""
        assert self.first_image is not None
        return self.first_image


@dataclass(kw_only=True)
class Survey:
    """A log without images; by_log_time: stamps are log times."""

    by_log_time: bool = False
    topics: dict[str, TopicSurvey] = field(default_factory=dict)
    tf: TfTree = field(default_factory=TfTree)
    realsense: RealSense = field(default_factory=RealSense)
    damage: Damage = field(default_factory=Damage)

    @property
    def num_messages(self) -> int:
        return sum(topic.count for topic in self.topics.values())

    def select_types(self, *types: str) -> list[TopicSurvey]:
        """Non-empty topics of these types, sorted by name."""
        topics = [t for t in self.topics.values() if t.topic.type_name in types and t.count and is_ros(t.topic)]
        return sorted(topics, key=lambda t: t.topic.name)


def survey(log: RawLog, *, by_log_time: bool = False) -> Survey:
    """Read `log` once; undecodable messages are damage.

    by_log_time: stamp images, transforms and joint states by log time.
    """
    result = Survey(by_log_time=by_log_time)
    decoder = MessageDecoder()
    for topic in log.topics():
        result.topics.setdefault(topic.name, TopicSurvey(topic=topic))
    for message in log.messages(result.damage):
        add_message(result, decoder, message)
    return result


def add_message(result: Survey, decoder: MessageDecoder, message: RawMessage) -> None:
    entry = result.topics.setdefault(message.topic.name, TopicSurvey(topic=message.topic))
    if entry.count == 0:
        entry.topic = message.topic
        entry.first_log_ns = entry.last_log_ns = message.log_time_ns
    entry.count += 1
    entry.first_log_ns = min(entry.first_log_ns, message.log_time_ns)
    entry.last_log_ns = max(entry.last_log_ns, message.log_time_ns)
    if is_ros(message.topic):
        try:
            _take(result, entry, decoder, message)
        except UnreadFormError as error:
            name = message.topic.name
            result.damage.remark(str(error) if str(error).startswith(name) else f"{name}: {error}")
        except (UndecodableMessageError, ValueError) as error:
            result.damage.add(str(error))
        except OverflowError:
            result.damage.add(f"{message.topic.name}: a time beyond 2^63 ns")
        except AttributeError as error:  # a definition of a known name with other fields
            result.damage.remark(f"{message.topic.name}: a {message.topic.type_name} of another definition: {error}")


def _take(result: Survey, entry: TopicSurvey, decoder: MessageDecoder, message: RawMessage) -> None:
    kind = message.topic.type_name
    if kind in {IMAGE, COMPRESSED_IMAGE}:
        entry.stamps_ns.append(-1)  # every image has its place, also one that does not decode
        entry.stamps_ns[-1] = message.log_time_ns if result.by_log_time else header_stamp_ns(message)
        entry.clock.see(entry.stamps_ns[-1], message.log_time_ns)
        result.realsense.add_image(message)
        if entry.first_image is None:
            entry.first_image = read_image(decoder.decode(message), kind)
            if entry.first_image.remark:
                result.damage.remark(f"{message.topic.name}: {entry.first_image.remark}")
    elif kind == CAMERA_INFO and entry.calibration is None:
        entry.calibration = _calibration(decoder.decode(message))
        if entry.calibration is not None and entry.calibration.cut and entry.calibration.is_possible:
            result.damage.remark(f"{message.topic.name}: says {entry.calibration.cut}: K is moved and scaled to that")
    elif kind in STATE_TYPES and (message.topic.definition or kind in STANDARD_TYPES):
        states = read_states(decoder.decode(message), kind, message.log_time_ns)
        if result.by_log_time:
            states = [replace(state, stamp_ns=state.log_time_ns) for state in states]
        entry.joints.extend(states)
    elif kind in {TRANSFORM, OPTION} and message.topic.name.startswith("/device_"):
        result.realsense.add(message.topic.name, decoder.decode(message))
    elif kind in TRANSFORMS:
        is_static = message.topic.name.endswith("tf_static")
        holds = message.topic.schema != ""  # Foxglove has no static transforms: one that comes once holds always
        for item in decoder.decode(message).transforms:
            t, r = item.transform.translation, item.transform.rotation
            result.tf.add(
                item.header.frame_id,
                item.child_frame_id,
                message.log_time_ns if result.by_log_time else stamp_ns(item.header),
                np.array([t.x, t.y, t.z], dtype=np.float64),
                np.array([r.x, r.y, r.z, r.w], dtype=np.float64),
                static=is_static,
                holds=holds,
            )


def _calibration(message: Any) -> Calibration | None:
    fields = {name.lower(): value for name, value in vars(message).items()}
    K = np.asarray(fields["k"], dtype=np.float64).reshape(3, 3)
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        return None  # an uncalibrated driver publishes zeros
    whole = Calibration(
        width=int(message.width),
        height=int(message.height),
        K=K,
        projection=np.asarray(fields["p"], dtype=np.float64).reshape(3, 4)[:, :3],
        rotation=np.asarray(fields["r"], dtype=np.float64).reshape(3, 3),
        distortion_model=str(message.distortion_model),
        distortion=np.asarray(fields["d"], dtype=np.float64),
        frame_id=message.header.frame_id.strip("/"),
        sensor_K=K,
    )
    # Images that are binned or cut out of the whole sensor's are as image_geometry takes them: moved by the region's
    # corner, then divided by the binning.
    across, down = (max(1, int(getattr(message, name, 0))) for name in ("binning_x", "binning_y"))
    roi, size = getattr(message, "roi", None), (whole.width, whole.height)
    x, y, width, height = (int(getattr(roi, name, 0)) for name in ("x_offset", "y_offset", "width", "height"))
    is_whole = not any((x, y, width, height)) or (x, y, width, height) == (0, 0, *size)
    if is_whole and across == down == 1:
        return whole
    width, height = size if is_whole else (width, height)
    region = "" if is_whole else f"region of {width}x{height} at ({x}, {y}) of {size[0]}x{size[1]}"
    binning = f"binning {across}x{down} of {size[0]}x{size[1]}" if across * down > 1 else ""
    A = np.array([[1 / across, 0, -x / across], [0, 1 / down, -y / down], [0, 0, 1]])
    return replace(
        whole,
        width=width // across,
        height=height // down,
        K=A @ whole.K,
        projection=A @ whole.projection,
        cut=", ".join(filter(None, (region, binning))),
        is_possible=width > 0 and height > 0 and x + width <= size[0] and y + height <= size[1],
    )


def survey_to_describe(log: RawLog) -> tuple[Survey, tuple[str, ...]]:
    """Survey a log; a large MCAP by its index, noted."""
    size = sum(file.stat().st_size for file in log.files)
    inner, video = (log.inner, log) if isinstance(log, VideoLog) else (log, None)
    if size < LARGE or not isinstance(inner, McapLog):
        return survey(log), ()
    counts, span_ns, chunks, notes = inner.index()
    return _sample(inner, counts, span_ns, _first_chunks(counts, chunks), video), (
        *notes,
        f"{size} bytes: described by index and first messages; neither checksums nor the rest were read",
    )


def _sample(
    log: McapLog,
    counts: Mapping[int, int],
    span_ns: tuple[int, int],
    chunks: Sequence[ChunkIndex],
    video: VideoLog | None,
) -> Survey:
    sample, decoder = Survey(), MessageDecoder()
    messages = log.messages_of(chunks, sample.damage) if chunks else islice(log.messages(Damage()), 2000)
    messages = messages if video is None else video.decoded(messages, Damage())  # others lie between these chunks
    for message in messages:
        add_message(sample, decoder, message)
    for topic in log.topics():
        sample.topics.setdefault(topic.name, TopicSurvey(topic=topic))
    for entry in sample.topics.values():
        entry.count = 0
    for channel, count in counts.items():
        counted = log.channels.get(channel)
        if counted is not None:
            entry = sample.topics[counted.name]
            entry.count += count
            entry.first_log_ns = entry.first_log_ns or span_ns[0]
            entry.last_log_ns = span_ns[1]
    return sample


def _first_chunks(counts: Mapping[int, int], chunks: Sequence[ChunkIndex]) -> list[ChunkIndex]:
    by_offset = {chunk.chunk_start_offset: chunk for chunk in chunks[:4]}
    for channel in sorted(counts):
        first = next((c for c in chunks if channel in c.message_index_offsets), None)
        if first is not None:
            by_offset[first.chunk_start_offset] = first
    chosen: list[ChunkIndex] = []
    size = 0
    for _, chunk in sorted(by_offset.items())[:24]:
        size += max(chunk.uncompressed_size, chunk.compressed_size)
        if size <= _MOST_BYTES or not chosen:
            chosen.append(chunk)
    return chosen


NAME, EVENTS = "robot_description", "/parameter_events"
STRING, EVENT = "std_msgs/msg/String", "rcl_interfaces/msg/ParameterEvent"
_TEXT = 4  # a parameter's type that is text (rcl_interfaces/ParameterType)


def robot_descriptions(log: RawLog) -> list[tuple[str, str]]:
    """Pairs (topic or node, text) of a log's URDFs, each once, from first messages."""
    topics = log.topics()
    own = {t.name for t in topics if t.type_name == STRING and t.name.rpartition("/")[2] == NAME}
    of_events = {t.name for t in topics if t.type_name == EVENT} if topics else {f"/{NAME}", EVENTS}  # no index
    names = own or of_events
    by_text: dict[str, str] = {}
    decoder = MessageDecoder()
    for message in log.messages(Damage(), names) if names else ():
        try:
            content = decoder.decode(message)
        except UndecodableMessageError:
            continue  # the survey counts it
        if message.topic.type_name == STRING:
            by_text.setdefault(message.topic.name, str(content.data))
        elif message.topic.type_name == EVENT:
            set_now = (*content.new_parameters, *content.changed_parameters)
            texts = [str(p.value.string_value) for p in set_now if p.name == NAME and p.value.type == _TEXT]
            by_text |= {str(content.node): text for text in texts}
        if own and own <= by_text.keys():
            break
    where = {text: name for name, text in reversed(by_text.items()) if text.strip()}
    return [(name, text) for text, name in reversed(where.items())]

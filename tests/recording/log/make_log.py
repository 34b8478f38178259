"""Logs written message by message, small ones with a known content (a fixed or moving camera over a flat wall,
joints, tf), and good ones broken in exactly one way.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import RecordSource, RgbdFrame

STORE = get_typestore(Stores.ROS2_HUMBLE)
SCHEMAS = {"cdr": "ros2msg", "ros1": "ros1msg", "protobuf": "protobuf", "json": "jsonschema"}  # by encoding


@lru_cache
def _definition(store: Any, kind: str, version: int) -> str:
    return str(store.generate_msgdef(kind, ros_version=version)[0])


def encoded(log_ns: int, topic: str, content: Any, store: Any = STORE, *, ros: int = 2) -> RawMessage:
    """A message of ROS 1 or 2 as a log has it."""
    kind = content.__msgtype__
    encoding, write = ("cdr", store.serialize_cdr) if ros == 2 else ("ros1", store.serialize_ros1)
    channel = Topic(name=topic, type_name=kind, encoding=encoding, definition=_definition(store, kind, ros))
    return RawMessage(topic=channel, log_time_ns=log_ns, data=bytes(write(content, kind)))


def write_raw(path: Path, messages: Iterable[RawMessage], **options: Any) -> Path:
    """An MCAP of the messages, in their order; options are the writer's."""
    schemas: dict[tuple[str, str], int] = {}
    channels: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = McapWriter(stream, **{"compression": CompressionType.ZSTD, **options})
        writer.start(profile="ros2", library="tests")
        for message in messages:
            topic, time = message.topic, message.log_time_ns
            if topic.name not in channels:
                name = topic.schema or topic.type_name
                name = name.replace("/msg/", "/") if topic.encoding == "ros1" else name
                key = name, topic.definition
                if key not in schemas:
                    definition = topic.definition.encode("latin-1" if topic.encoding == "protobuf" else "utf-8")
                    schemas[key] = writer.register_schema(name, SCHEMAS.get(topic.encoding, ""), definition)
                channels[topic.name] = writer.register_channel(topic.name, topic.encoding, schemas[key])
            writer.add_message(channels[topic.name], time, message.data, time)
        writer.finish()
    return path


def write_bag(
    path: Path,
    messages: Iterable[RawMessage],
    store: Any = STORE,
    plugin: StoragePlugin | None = None,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A bag of the messages by rosbags: of ROS 2 in a folder, kept by `plugin`, or without one a file of ROS 1."""
    writer = Bag1Writer(path) if plugin is None else Bag2Writer(path, version=9, storage_plugin=plugin)
    if isinstance(writer, Bag2Writer) and mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for message in messages:
            name, kind = message.topic.name, message.topic.type_name
            if name not in connections:
                connections[name] = writer.add_connection(name, kind, typestore=store)
            writer.write(connections[name], message.log_time_ns, message.data)
    return path


def frames_of(source: Path | RecordSource, options: SourceOptions | None = None) -> list[RgbdFrame]:
    """The frames of a recording that is open, or at a path."""
    opened = open_source(source, options) if isinstance(source, Path) else source
    return [record for record in opened.records() if isinstance(record, RgbdFrame)]


def messages_of(log: Path) -> Iterator[RawMessage]:
    """All messages of a log that is whole."""
    damage = Damage()
    yield from open_raw_log(log).messages(damage)
    assert not damage.count


def rewritten(log: Path, path: Path, change: Callable[[RawMessage], RawMessage]) -> Path:
    """The log with every message changed."""
    return write_raw(path, map(change, messages_of(log)))


T = STORE.types
WIDTH, HEIGHT = 32, 24
START_NS = 1_700_000_000_000_000_000
FRAME_NS = 100_000_000


@dataclass(kw_only=True)
class LogRecipe:
    """What a log holds; the defaults are a good log of one camera on a rail along world x."""

    cameras: tuple[str, ...] = ("cam0",)
    num_frames: int = 5
    has_depth: bool = True
    has_info: bool = True
    has_tf: bool = True
    has_joints: bool = True
    depth_encoding: str = "16UC1"
    depth_m: float = 1.25
    depth_counts: int | None = None
    color_format: str = "jpeg"
    depth_delay_ns: int = 3_000_000
    depth_frame: str | None = None
    depth_size: tuple[int, int] = (WIDTH, HEIGHT)
    tf_last: bool = False
    tf_frames: int | None = None
    tf_delay_ns: int = 0
    is_bigendian: bool = False
    step_padding: int = 0
    distortion: tuple[float, ...] = (0.0,) * 5
    with_velocity: bool = True
    color_name: str = "image_raw"
    projection_focal: float = 0.0
    chunk_size: int = 4096
    mask_every: int = 0  # frames; 0: no masks
    mask_encoding: str = "mono8"


def camera_x(index: int) -> float:
    """World x [m] of the moving camera at frame `index`."""
    return 0.1 * index


def make_log(path: Path, recipe: LogRecipe | None = None) -> Path:
    """Write the log and return its path."""
    return _LogWriter(path, recipe or LogRecipe()).write()


def color_pixels(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """The RGB image of a frame: red grows with the frame, green with the column."""
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[..., 0] = (40 + 10 * index) % 256
    image[..., 1] = np.linspace(20, 200, WIDTH, dtype=np.uint8)
    image[..., 2] = 90
    return image


def mask_pixels(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """The mask of a frame: a person in rows 5 to 15, from the column of the frame's number on."""
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[5:16, index:] = 200
    return mask


class _LogWriter:
    def __init__(self, path: Path, recipe: LogRecipe) -> None:
        self.path, self.recipe = path, recipe

    def write(self) -> Path:
        recipe = self.recipe
        tf = list(self._tf()) if recipe.has_tf else []
        body = []
        for index in range(recipe.num_frames):
            body.extend(self._frame(index))
        ordered = [*body, *tf] if recipe.tf_last else [*tf, *body]
        messages = (encoded(time, topic, content) for time, topic, _, content in ordered)
        return write_raw(self.path, messages, chunk_size=recipe.chunk_size)

    def _tf(self) -> Any:
        recipe = self.recipe
        static = [self._transform(START_NS, f"{c}_link", f"{c}_optical", (0.0, 0.0, 0.5)) for c in recipe.cameras]
        if recipe.depth_frame is not None:
            static.append(self._transform(START_NS, f"{recipe.cameras[0]}_optical", recipe.depth_frame, (0.05, 0, 0)))
        yield START_NS, "/tf_static", "tf2_msgs/msg/TFMessage", T["tf2_msgs/msg/TFMessage"](transforms=static)
        for index in range(recipe.tf_frames if recipe.tf_frames is not None else recipe.num_frames):
            stamp = START_NS + index * FRAME_NS + recipe.tf_delay_ns
            moving = [
                self._transform(stamp, "world", f"{c}_link", (camera_x(index), 0.0, 0.0)) for c in recipe.cameras
            ]
            yield stamp, "/tf", "tf2_msgs/msg/TFMessage", T["tf2_msgs/msg/TFMessage"](transforms=moving)

    def _frame(self, index: int) -> Any:
        recipe = self.recipe
        stamp = START_NS + index * FRAME_NS
        for camera in recipe.cameras:
            optical = f"{camera}_optical"
            yield stamp, *self._color(f"/{camera}/color/{recipe.color_name}", stamp, optical, index)
            if recipe.has_info:
                yield stamp, f"/{camera}/color/camera_info", *self._info(stamp, optical, (WIDTH, HEIGHT))
            if recipe.has_depth:
                frame = recipe.depth_frame or optical
                late = stamp + recipe.depth_delay_ns
                yield late, f"/{camera}/depth/image_raw", *self._depth(late, frame)
                if recipe.depth_frame is not None:
                    yield stamp, f"/{camera}/depth/camera_info", *self._info(stamp, frame, recipe.depth_size)
            if recipe.mask_every and index % recipe.mask_every == 0:
                mask = self._image(late, optical, recipe.mask_encoding, mask_pixels(index))
                yield late, f"/{camera}/people/mask", "sensor_msgs/msg/Image", mask
        if recipe.has_joints:
            yield stamp, "/joint_states", *self._joints(stamp, index)

    def _color(self, topic: str, stamp: int, frame: str, index: int) -> tuple[str, str, Any]:
        pixels, form = color_pixels(index), self.recipe.color_format
        if form in {"jpeg", "png"}:
            data = cv2.imencode(f".{form}", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1]
            kind = "sensor_msgs/msg/CompressedImage"
            return f"{topic}/compressed", kind, T[kind](header=header(stamp, frame), format=form, data=data.ravel())
        encoded = {
            "rgb8": pixels,
            "bgr8": pixels[..., ::-1],
            "rgba8": np.dstack([pixels, np.full((HEIGHT, WIDTH), 255, np.uint8)]),
            "bgra8": np.dstack([pixels[..., ::-1], np.full((HEIGHT, WIDTH), 255, np.uint8)]),
            "mono8": pixels[..., 1],
        }[form]
        return topic, "sensor_msgs/msg/Image", self._image(stamp, frame, form, encoded)

    def _depth(self, stamp: int, frame: str) -> tuple[str, Any]:
        recipe = self.recipe
        width, height = recipe.depth_size
        if recipe.depth_encoding == "32FC1":
            pixels = np.full((height, width), recipe.depth_m, dtype=np.float32)
            pixels[0, 0] = np.nan
        else:
            counts = round(recipe.depth_m * 1000) if recipe.depth_counts is None else recipe.depth_counts
            pixels = np.full((height, width), counts, dtype=np.uint16)
            pixels[0, 0] = 0
        pixels[0, 1 + (stamp - START_NS) // FRAME_NS % 20] = 0  # by noise no image equals the one before
        return "sensor_msgs/msg/Image", self._image(stamp, frame, recipe.depth_encoding, pixels)

    def _image(self, stamp: int, frame: str, encoding: str, pixels: np.ndarray[Any, Any]) -> Any:
        big = self.recipe.is_bigendian
        swapped = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        rows = np.frombuffer(swapped.tobytes(), dtype=np.uint8).reshape(pixels.shape[0], -1)
        padded = np.pad(rows, ((0, 0), (0, self.recipe.step_padding)), constant_values=77)
        return T["sensor_msgs/msg/Image"](
            header=header(stamp, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(big),
            step=padded.shape[1],
            data=padded.ravel(),
        )

    def _info(self, stamp: int, frame: str, size: tuple[int, int]) -> tuple[str, Any]:
        width, height = size
        f = 30.0 * width / WIDTH
        K = np.array([f, 0, (width - 1) / 2, 0, f, (height - 1) / 2, 0, 0, 1])
        roi = T["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return "sensor_msgs/msg/CameraInfo", T["sensor_msgs/msg/CameraInfo"](
            header=header(stamp, frame),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.array(self.recipe.distortion),
            k=K,
            r=np.eye(3).ravel(),
            p=np.array([self.recipe.projection_focal, 0, 16, 0, 0, self.recipe.projection_focal, 12, 0, 0, 0, 1, 0]),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def _joints(self, stamp: int, index: int) -> tuple[str, Any]:
        velocity = np.array([1.0, -1.0]) if self.recipe.with_velocity else np.zeros(0)
        return "sensor_msgs/msg/JointState", T["sensor_msgs/msg/JointState"](
            header=header(stamp, ""),
            name=["joint_a", "joint_b"],
            position=np.array([0.1 * index, -0.1 * index]),
            velocity=velocity,
            effort=np.zeros(0),
        )

    @staticmethod
    def _transform(stamp: int, parent: str, child: str, position: tuple[float, ...]) -> Any:
        x, y, z = position
        return T["geometry_msgs/msg/TransformStamped"](
            header=header(stamp, parent),
            child_frame_id=child,
            transform=T["geometry_msgs/msg/Transform"](
                translation=T["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z)),
                rotation=T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            ),
        )


def header(stamp: int, frame: str) -> Any:
    """A std_msgs/Header."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    time = T["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return T["std_msgs/msg/Header"](stamp=time, frame_id=frame)


Message = tuple[int, str, str, Any]  # log time [ns], topic, type, message
Change = Callable[[int, str, str, Any], Iterable[Message]]


def broken_log(path: Path, change: Change, recipe: LogRecipe | None = None) -> Path:
    """The log of `recipe` with every message replaced by what `change` makes of it."""
    good = make_log(path.with_suffix(".good.mcap"), recipe or LogRecipe(num_frames=30))
    changed = (
        encoded(time, topic, content)
        for message in messages_of(good)
        for time, topic, _, content in change(message.log_time_ns, message.topic.name, *_decoded(message))
    )
    return write_raw(path, changed)


def _decoded(message: RawMessage) -> tuple[str, Any]:
    """Type and content, whose arrays can be written."""
    kind = message.topic.type_name
    return kind, STORE.deserialize_cdr(bytearray(message.data), kind)


def stamp_of(message: Any) -> int:
    """Header stamp [ns]."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def set_stamp(message: Any, stamp_ns: int) -> None:
    """Give a message another header stamp."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)

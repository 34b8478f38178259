"""Logs written message by message, small ones with a known content (a fixed or moving camera over a flat wall,
joints, tf), and good ones broken in exactly one way.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, JOINT_STATE
from splatctrl_cli.recording.source import SourceOptions, open_source
from splatctrl_cli.records import RecordSource, RgbdFrame

STORE = get_typestore(Stores.ROS2_HUMBLE)
SCHEMAS = {"cdr": "ros2msg", "ros1": "ros1msg", "protobuf": "protobuf", "json": "jsonschema"}  # by encoding


def built(kind: str, store: Any = STORE, **given: Any) -> Any:
    """A message of a type: dicts are messages within it, and what is not given is zero. Case is that of the type."""
    folded = {name.lower(): value for name, value in given.items()}
    fields = store.fielddefs[kind][1]
    return store.types[kind](**{name: _field(store, folded.get(name.lower()), *form) for name, form in fields})


def _field(store: Any, value: Any, node: Nodetype, detail: Any) -> Any:
    if node == Nodetype.NAME:
        return built(detail, store, **(value or {})) if value is None or isinstance(value, dict) else value
    if node == Nodetype.BASE:
        zero = "" if detail[0] == "string" else np.dtype(detail[0]).type().item()
        return zero if value is None else value
    (of, of_detail), size = detail
    if of == Nodetype.NAME or of_detail[0] == "string":
        return [_field(store, item, of, of_detail) for item in (() if value is None else value)]
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    return np.array(np.zeros(size) if value is None else value, of_detail[0]).ravel()


def header(stamp: int, frame: str = "", store: Any = STORE) -> Any:
    """A std_msgs/Header of either ROS."""
    time = dict(zip(("sec", "nanosec"), divmod(stamp, 1_000_000_000), strict=True))
    return built("std_msgs/msg/Header", store, stamp=time, frame_id=frame)


def image(
    stamp: int,
    frame: str,
    encoding: str,
    pixels: np.ndarray[Any, Any],
    *,
    big: bool = False,
    padding: int = 0,
    store: Any = STORE,
) -> Any:
    """A sensor_msgs/Image: pixels in either byte order, so many bytes behind each row."""
    swapped = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(swapped.tobytes(), dtype=np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": padded.shape[1]}
    form = {"header": header(stamp, frame, store), "encoding": encoding, "is_bigendian": int(big)}
    return built(IMAGE, store, **form, **size, data=padded)


def camera_info(
    stamp: int, frame: str, size: tuple[int, int], lens: Sequence[float], *, store: Any = STORE, **said: Any
) -> Any:
    """A sensor_msgs/CameraInfo of images of this width and height, of a lens (fx, fy, cx, cy)."""
    fx, fy, cx, cy = lens
    known = {"distortion_model": "plumb_bob", "k": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "r": np.eye(3)}
    stamped = {"header": header(stamp, frame, store), "width": size[0], "height": size[1]}
    return built(CAMERA_INFO, store, **stamped, **(known | said))


def transform(
    stamp: int,
    parent: str,
    child: str,
    position: Sequence[float] = (0, 0, 0),
    quat: Sequence[float] = (0, 0, 0, 1),
    store: Any = STORE,
) -> Any:
    """A geometry_msgs/TransformStamped."""
    moved = {"translation": by_axis(position), "rotation": by_axis(quat)}
    head = header(stamp, parent, store)
    return built("geometry_msgs/msg/TransformStamped", store, header=head, child_frame_id=child, transform=moved)


def by_axis(values: Sequence[float]) -> dict[str, float]:
    """The fields x, y, z and, of a quaternion, w."""
    return {axis: float(value) for axis, value in zip("xyzw", values, strict=False)}


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
    mode: CompressionMode | Bag1Writer.CompressionFormat = CompressionMode.NONE,
) -> Path:
    """A bag of the messages by rosbags: of ROS 2 in a folder, kept by `plugin`, or without one a file of ROS 1."""
    writer = Bag1Writer(path) if plugin is None else Bag2Writer(path, version=9, storage_plugin=plugin)
    if mode != CompressionMode.NONE:
        writer.set_compression(*((mode, CompressionFormat.ZSTD) if isinstance(mode, CompressionMode) else (mode,)))
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
    distortion: tuple[float, ...] = (0.0,) * 5
    color_name: str = "image_raw"
    projection_focal: float = 0.0
    chunk_size: int = 4096
    mask_every: int = 0  # frames; 0: no masks


def camera_x(index: int) -> float:
    """World x [m] of the moving camera at frame `index`."""
    return 0.1 * index


def make_log(path: Path, recipe: LogRecipe | None = None) -> Path:
    """Write the log and return its path."""
    recipe = recipe or LogRecipe()
    tf = list(_transforms(recipe)) if recipe.has_tf else []
    body = [message for index in range(recipe.num_frames) for message in _frame(recipe, index)]
    messages = (encoded(*message) for message in ([*body, *tf] if recipe.tf_last else [*tf, *body]))
    return write_raw(path, messages, chunk_size=recipe.chunk_size)


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


Content = tuple[int, str, Any]  # log time [ns], topic, message


def _transforms(recipe: LogRecipe) -> Iterator[Content]:
    static = [transform(START_NS, f"{name}_link", f"{name}_optical", (0, 0, 0.5)) for name in recipe.cameras]
    if recipe.depth_frame is not None:
        static.append(transform(START_NS, f"{recipe.cameras[0]}_optical", recipe.depth_frame, (0.05, 0, 0)))
    yield START_NS, "/tf_static", built("tf2_msgs/msg/TFMessage", transforms=static)
    for index in range(recipe.num_frames if recipe.tf_frames is None else recipe.tf_frames):
        stamp = START_NS + index * FRAME_NS + recipe.tf_delay_ns
        moving = [transform(stamp, "world", f"{name}_link", (camera_x(index), 0, 0)) for name in recipe.cameras]
        yield stamp, "/tf", built("tf2_msgs/msg/TFMessage", transforms=moving)


def _frame(recipe: LogRecipe, index: int) -> Iterator[Content]:
    stamp = START_NS + index * FRAME_NS
    late = stamp + recipe.depth_delay_ns
    for camera in recipe.cameras:
        optical = f"{camera}_optical"
        frame = recipe.depth_frame or optical
        yield stamp, *_color(recipe, f"/{camera}/color/{recipe.color_name}", stamp, optical, index)
        if recipe.has_info:
            yield stamp, f"/{camera}/color/camera_info", _info(recipe, stamp, optical, (WIDTH, HEIGHT))
        if recipe.has_depth:
            pixels = _depth(recipe, index)
            yield late, f"/{camera}/depth/image_raw", image(late, frame, recipe.depth_encoding, pixels)
        if recipe.has_depth and recipe.depth_frame is not None:
            yield stamp, f"/{camera}/depth/camera_info", _info(recipe, stamp, frame, recipe.depth_size)
        if recipe.mask_every and index % recipe.mask_every == 0:
            yield late, f"/{camera}/people/mask", image(late, optical, "mono8", mask_pixels(index))
    if recipe.has_joints:
        moved = {"name": ["joint_a", "joint_b"], "position": [0.1 * index, -0.1 * index], "velocity": [1.0, -1.0]}
        yield stamp, "/joint_states", built(JOINT_STATE, header=header(stamp), **moved)


def _color(recipe: LogRecipe, topic: str, stamp: int, frame: str, index: int) -> tuple[str, Any]:
    pixels, form = color_pixels(index), recipe.color_format
    if form in {"jpeg", "png"}:
        data = cv2.imencode(f".{form}", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1]
        return f"{topic}/compressed", built(COMPRESSED_IMAGE, header=header(stamp, frame), format=form, data=data)
    turned = pixels[..., ::-1] if form.startswith("bgr") else pixels
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    forms = {"rgba8": np.dstack([turned, alpha]), "bgra8": np.dstack([turned, alpha]), "mono8": pixels[..., 1]}
    return topic, image(stamp, frame, form, forms.get(form, turned))


def _depth(recipe: LogRecipe, index: int) -> np.ndarray[Any, Any]:
    size = recipe.depth_size[::-1]
    if recipe.depth_encoding == "32FC1":
        pixels = np.full(size, recipe.depth_m, np.float32)
        pixels[0, 0] = np.nan
    else:
        counts = round(recipe.depth_m * 1000) if recipe.depth_counts is None else recipe.depth_counts
        pixels = np.full(size, counts, np.uint16)
        pixels[0, 0] = 0
    pixels[0, 1 + (index + recipe.depth_delay_ns // FRAME_NS) % 20] = 0  # by noise no image equals the one before
    return pixels


def _info(recipe: LogRecipe, stamp: int, frame: str, size: tuple[int, int]) -> Any:
    f, p = 30.0 * size[0] / WIDTH, recipe.projection_focal
    lens = (f, f, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return camera_info(stamp, frame, size, lens, d=recipe.distortion, p=[p, 0, 16, 0, 0, p, 12, 0, 0, 0, 1, 0])


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

"""Writers of MCAP logs: ROS 2's standard messages, and Foxglove's schemas.

ROS 2 (CDR, zstd chunks, CRCs on). Topics: /CAM/color/image_raw/compressed (JPEG), /CAM/color/camera_info,
/CAM/depth/image_raw (16UC1 millimetres, REP 118, 0 = none, registered to colour), /CAM/people/mask (mono8, 255 = a
person), /joint_states, /tf, /tf_static. The bytes contain no wall-clock time.

Foxglove: protobuf (docs.foxglove.dev, "Schemas"), with plots in JSON; needs foxglove-schemas-protobuf and
mcap-protobuf-support.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from splatctrl_cli.errors import UsageError, refuse_faults
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.records import MILLIMETRES, Float64, JointState, RgbdFrame

FOREVER = "    sec: 9223372036\n    nsec: 854775807\n"
LATCHED = (  # rosbag2's form of reliable, transient local, keep the last one
    f"- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n{FOREVER}  lifespan:\n{FOREVER}"
    f"  liveliness: 1\n  liveliness_lease_duration:\n{FOREVER}  avoid_ros_namespace_conventions: false"
)

Transform = tuple[str, str, Float64]  # parent frame, child frame, T_parent_child (4, 4)


@contextmanager
def mcap_log(path: Path) -> Iterator["McapLog"]:
    """Open a log, complete and closed after the block."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4 << 20, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="splatctrl")
        yield McapLog(writer)
        writer.finish()


class McapLog:
    """Records for an open MCAP, in time order."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()  # messages by topic

    def add_joint_state(self, state: JointState, joint_names: Sequence[str]) -> None:
        """Add a /joint_states message."""
        message = self._new(
            "sensor_msgs/msg/JointState",
            header=self._header(state.stamp_ns, ""),
            name=list(joint_names),
            position=np.asarray(state.position, dtype=np.float64),
            velocity=np.asarray(state.velocity, dtype=np.float64),
            effort=np.zeros(0),
        )
        self._add("/joint_states", message, state.stamp_ns)

    def add_transforms(self, stamp_ns: int, transforms: Sequence[Transform], *, is_static: bool) -> None:
        stamped = [
            self._new(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(stamp_ns, parent),
                child_frame_id=child,
                transform=self._transform(T),
            )
            for parent, child, T in transforms
        ]
        self._add(
            "/tf_static" if is_static else "/tf", self._new("tf2_msgs/msg/TFMessage", transforms=stamped), stamp_ns
        )

    def add_frame(self, frame: RgbdFrame) -> None:
        """Add JPEG colour, CameraInfo, depth and any mask, in one optical frame."""
        header = self._header(frame.stamp_ns, f"{frame.camera}_optical_frame")
        jpeg = cv2.imencode(".jpg", frame.color[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
        color = self._new("sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=jpeg.reshape(-1))
        millimetres = np.rint(frame.depth.astype(np.float64) * MILLIMETRES)
        millimetres = np.where(millimetres < np.iinfo(np.uint16).max, millimetres, 0).astype("<u2")  # else no return
        k = frame.intrinsics
        info = self._new(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=k.height,
            width=k.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=np.array([k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1], dtype=np.float64),
            r=np.eye(3).reshape(-1),
            p=np.array([k.fx, 0, k.cx, 0, 0, k.fy, k.cy, 0, 0, 0, 1, 0], dtype=np.float64),
            binning_x=0,
            binning_y=0,
            roi=self._new(
                "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )
        self._add(f"/{frame.camera}/color/camera_info", info, frame.stamp_ns)
        self._add(f"/{frame.camera}/color/image_raw/compressed", color, frame.stamp_ns)
        self._add(f"/{frame.camera}/depth/image_raw", self._image(header, "16UC1", millimetres), frame.stamp_ns)
        if frame.human is not None:
            self._add(
                f"/{frame.camera}/people/mask",
                self._image(header, "mono8", np.where(frame.human > 0, np.uint8(255), np.uint8(0))),
                frame.stamp_ns,
            )

    def _image(self, header: Any, encoding: str, pixels: NDArray[np.unsignedinteger]) -> Any:
        return self._new(
            "sensor_msgs/msg/Image",
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.itemsize * pixels.shape[1],
            data=pixels.reshape(-1).view(np.uint8),
        )

    def _transform(self, T: Float64) -> Any:
        x, y, z, w = (float(value) for value in quat_from_rotation(T[:3, :3]))
        px, py, pz = (float(value) for value in T[:3, 3])
        return self._new(
            "geometry_msgs/msg/Transform",
            translation=self._new("geometry_msgs/msg/Vector3", x=px, y=py, z=pz),
            rotation=self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        return self._new(
            "std_msgs/msg/Header",
            stamp=self._new("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9),
            frame_id=frame_id,
        )

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _add(self, topic: str, message: Any, stamp_ns: int) -> None:
        kind = message.__msgtype__
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(
                kind, "ros2msg", self._store.generate_msgdef(kind, ros_version=2)[0].encode()
            )
        if topic not in self._channels:
            qos = {"offered_qos_profiles": LATCHED} if topic == "/tf_static" else {}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], qos)
        self._counts[topic] += 1
        self._writer.add_message(
            self._channels[topic],
            log_time=stamp_ns,
            data=bytes(self._store.serialize_cdr(message, kind)),
            publish_time=stamp_ns,
            sequence=self._counts[topic] - 1,
        )


WORLD = "world"
SCHEMAS = "foxglove_schemas_protobuf"
KINDS = {"u1": "UINT8", "f4": "FLOAT32"}  # of packed values, by NumPy's name
LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
REMEDY = "pip install 'splatctrl-cli[mcap]'"


@contextmanager
def foxglove_log(path: Path) -> Iterator["FoxgloveLog"]:
    """Open a log, complete and closed after the block. Raises UsageError without libraries."""
    with refuse_faults(
        "an MCAP of Foxglove's schemas needs their libraries", ImportError, remedy=REMEDY, error=UsageError
    ):
        register = import_module("mcap_protobuf.schema").register_schema
        import_module(f"{SCHEMAS}.PointCloud_pb2")
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(library="splatctrl")
        yield FoxgloveLog(writer, register)
        writer.finish()


class FoxgloveLog:
    """Messages for an open MCAP, in time order, in `WORLD`."""

    def __init__(self, writer: Writer, register: Any) -> None:
        self._writer = writer
        self._register = register
        self._channels: dict[str, int] = {}
        self.counts: Counter[str] = Counter()  # messages by topic

    def add_cloud(self, topic: str, stamp_ns: int, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add a PointCloud of float32 or uint8 columns (N,), with x, y, z [m]."""
        kind = np.dtype([(name, column.dtype) for name, column in columns.items()])
        packed = np.zeros(len(columns["x"]), kind)
        for name, column in columns.items():
            packed[name] = column
        message = _new("PointCloud", frame_id=WORLD, point_stride=kind.itemsize, data=packed.tobytes())
        message.pose.orientation.w = 1.0
        message.fields.extend(_fields(kind))
        self._add(topic, stamp_ns, message)

    def add_voxels(
        self, topic: str, stamp_ns: int, name: str, values: NDArray[Any], origin: Float64, voxel: float
    ) -> None:
        """Add voxels (X, Y, Z), uint8 or float32; `origin` (3,) [m]: centre of the first."""
        columns, rows, _ = values.shape
        size = values.dtype.itemsize
        message = _new(
            "VoxelGrid",
            frame_id=WORLD,
            row_count=rows,
            column_count=columns,
            cell_stride=size,
            row_stride=size * columns,
            slice_stride=size * columns * rows,
            data=np.ascontiguousarray(values.T).tobytes(),
        )
        for axis, value in zip("xyz", np.asarray(origin) - 0.5 * voxel, strict=True):
            setattr(message.pose.position, axis, float(value))
            setattr(message.cell_size, axis, voxel)
        message.pose.orientation.w = 1.0
        message.fields.extend(_fields(np.dtype([(name, values.dtype)])))
        self._add(topic, stamp_ns, message)

    def add_transforms(self, topic: str, stamp_ns: int, poses: Mapping[str, Float64]) -> None:
        """Add T_world_frame (4, 4) by frame."""
        message = _new("FrameTransforms")
        for frame, T in poses.items():
            each = message.transforms.add(parent_frame_id=WORLD, child_frame_id=frame)
            each.timestamp.FromNanoseconds(stamp_ns)
            each.translation.x, each.translation.y, each.translation.z = T[:3, 3].tolist()
            for axis, value in zip("xyzw", quat_from_rotation(T[:3, :3]), strict=True):
                setattr(each.rotation, axis, float(value))
        self._add(topic, stamp_ns, message)

    def add_mesh(
        self, topic: str, stamp_ns: int, frame: str, vertices: NDArray[np.floating], faces: NDArray[np.integer]
    ) -> None:
        """Add a SceneUpdate: vertices (V, 3) [m], faces (F, 3), in a frame."""
        message = _new("SceneUpdate")
        entity = message.entities.add(id=frame, frame_id=frame, frame_locked=True)
        entity.timestamp.FromNanoseconds(stamp_ns)
        triangles = entity.triangles.add()
        triangles.pose.orientation.w = 1.0
        for x, y, z in vertices.tolist():
            triangles.points.add(x=x, y=y, z=z)
        triangles.indices.extend(faces.ravel().tolist())
        triangles.color.r, triangles.color.g, triangles.color.b, triangles.color.a = 0.66, 0.71, 0.75, 1.0
        self._add(topic, stamp_ns, message)

    def add_line(self, topic: str, stamp_ns: int, level: str, text: str) -> None:
        self._add(topic, stamp_ns, _new("Log", level=LEVELS.index(level), message=text, name="splatctrl"))

    def add_numbers(self, topic: str, stamp_ns: int, values: Mapping[str, float | None]) -> None:
        if topic not in self._channels:
            schema = {"type": "object", "properties": {name: {"type": ["number", "null"]} for name in values}}
            self._channels[topic] = self._writer.register_channel(
                topic,
                "json",
                self._writer.register_schema(f"splatctrl{topic}", "jsonschema", json.dumps(schema).encode()),
            )
        self._write(topic, stamp_ns, json.dumps(dict(values), allow_nan=False).encode())

    def _add(self, topic: str, stamp_ns: int, message: Any) -> None:
        if hasattr(message, "timestamp"):
            message.timestamp.FromNanoseconds(stamp_ns)
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic, "protobuf", self._register(self._writer, type(message))
            )
        self._write(topic, stamp_ns, message.SerializeToString(deterministic=True))

    def _write(self, topic: str, stamp_ns: int, data: bytes) -> None:
        self.counts[topic] += 1
        self._writer.add_message(
            self._channels[topic],
            log_time=stamp_ns,
            publish_time=stamp_ns,
            sequence=self.counts[topic] - 1,
            data=data,
        )


def _new(schema: str, **values: Any) -> Any:
    return getattr(import_module(f"{SCHEMAS}.{schema}_pb2"), schema)(**values)


def _fields(kind: np.dtype[Any]) -> Sequence[Any]:
    field = import_module(f"{SCHEMAS}.PackedElementField_pb2").PackedElementField
    assert kind.names is not None and kind.fields is not None
    return [
        field(
            name=name, offset=kind.fields[name][1], type=field.NumericType.Value(KINDS[kind.fields[name][0].str[1:]])
        )
        for name in kind.names
    ]

"""A writer of logs in Foxglove's protobuf schemas (docs.foxglove.dev, "Schemas"), with plots in JSON.

Needs foxglove-schemas-protobuf and mcap-protobuf-support, a separate extra.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.records import Float64

WORLD = "world"
SCHEMAS = "foxglove_schemas_protobuf"
KINDS = {"u1": "UINT8", "f4": "FLOAT32"}  # of packed values, by NumPy's name
LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
REMEDY = "pip install 'splatctrl-cli[mcap]'"


@contextmanager
def foxglove_log(path: Path) -> Iterator["FoxgloveLog"]:
    """Open a log, complete and closed after the block. Raises UsageError without libraries."""
    try:
        register = import_module("mcap_protobuf.schema").register_schema
        import_module(f"{SCHEMAS}.PointCloud_pb2")
    except ImportError as error:
        raise UsageError(f"an MCAP of Foxglove's schemas needs their libraries: {error}", remedy=REMEDY) from None
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
        self.counts: dict[str, int] = {}  # messages by topic

    def add_cloud(self, topic: str, stamp_ns: int, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add a PointCloud of columns (N,) by name, float32 or uint8, among them x, y, z [m]."""
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
        """Add (X, Y, Z), uint8 or float32; voxel (0, 0, 0) is centred at `origin` (3,) [m]."""
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
            for axis, value in zip("xyz", T[:3, 3], strict=True):
                setattr(each.translation, axis, float(value))
            for axis, value in zip("xyzw", quat_from_rotation(T[:3, :3]), strict=True):
                setattr(each.rotation, axis, float(value))
        self._add(topic, stamp_ns, message)

    def add_mesh(
        self, topic: str, stamp_ns: int, frame: str, vertices: NDArray[np.floating], faces: NDArray[np.integer]
    ) -> None:
        """Add a SceneUpdate: vertices (V, 3) [m] and faces (F, 3) that move with a frame."""
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
        """Add a Log of one of `LEVELS`."""
        self._add(topic, stamp_ns, _new("Log", level=LEVELS.index(level), message=text, name="splatctrl"))

    def add_numbers(self, topic: str, stamp_ns: int, values: Mapping[str, float | None]) -> None:
        """Add numbers as a JSON object."""
        if topic not in self._channels:
            schema = {"type": "object", "properties": {name: {"type": ["number", "null"]} for name in values}}
            made = self._writer.register_schema(f"splatctrl{topic}", "jsonschema", json.dumps(schema).encode())
            self._channels[topic] = self._writer.register_channel(topic, "json", made)
        self._write(topic, stamp_ns, json.dumps(dict(values), allow_nan=False).encode())

    def _add(self, topic: str, stamp_ns: int, message: Any) -> None:
        if hasattr(message, "timestamp"):
            message.timestamp.FromNanoseconds(stamp_ns)
        if topic not in self._channels:
            schema = self._register(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema)
        self._write(topic, stamp_ns, message.SerializeToString(deterministic=True))

    def _write(self, topic: str, stamp_ns: int, data: bytes) -> None:
        sequence = self.counts.get(topic, 0)
        self.counts[topic] = sequence + 1
        self._writer.add_message(
            self._channels[topic], log_time=stamp_ns, publish_time=stamp_ns, sequence=sequence, data=data
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

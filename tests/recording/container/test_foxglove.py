"""Foxglove's schemas in MCAP: protobuf by the descriptors of the log, and JSON, against the same log in ROS 2."""

import base64
import json
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatctrl_cli.recording.container.foxglove import DEFINITIONS, read_protobuf
from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log.decoder import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, JOINT_STATE, MessageDecoder
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.records import JointState
from tests.recording.container.test_log_formats import assert_same
from tests.recording.log.make_log import LogRecipe, built, frames_of, make_log, messages_of, rewritten, write_bag
from tests.recording.log.make_log import encoded as ros_message

TIME = "timestamp .google.protobuf.Timestamp"

TYPES = {  # fields of each type, numbered as Foxglove numbers them: name and type, [] where it repeats
    "foxglove.Vector3": {1: "x double", 2: "y double", 3: "z double"},
    "foxglove.Quaternion": {1: "x double", 2: "y double", 3: "z double", 4: "w double"},
    "foxglove.CompressedImage": {1: TIME, 4: "frame_id string", 2: "data bytes", 3: "format string"},
    "foxglove.RawImage": {
        **{1: TIME, 7: "frame_id string", 2: "width fixed32", 3: "height fixed32"},
        **{4: "encoding string", 5: "step fixed32", 6: "data bytes"},
    },
    "foxglove.CameraCalibration": {
        **{1: TIME, 9: "frame_id string", 2: "width fixed32", 3: "height fixed32"},
        **{4: "distortion_model string", 5: "D double[]", 6: "K double[]", 7: "R double[]", 8: "P double[]"},
    },
    "foxglove.FrameTransform": {
        **{1: TIME, 2: "parent_frame_id string", 3: "child_frame_id string"},
        **{4: "translation .foxglove.Vector3", 5: "rotation .foxglove.Quaternion"},
    },
    "foxglove.FrameTransforms": {1: "transforms .foxglove.FrameTransform[]"},
    "foxglove.JointState": {1: "name string", 2: "position double"},
    "foxglove.JointStates": {1: TIME, 2: "joints .foxglove.JointState[]"},
}


def descriptor_set() -> bytes:
    """The types, before the file that they import."""
    file = FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append(Timestamp.DESCRIPTOR.file.name)
    for name, fields in TYPES.items():
        message = file.message_type.add(name=name.removeprefix("foxglove."))
        for number, text in fields.items():
            field, kind = text.removesuffix("[]").split()
            kind_name = "MESSAGE" if kind.startswith(".") else kind.upper()
            message.field.add(
                name=field,
                number=number,
                label=3 if text.endswith("[]") else 1,
                type=FieldDescriptorProto.Type.Value(f"TYPE_{kind_name}"),
                type_name=kind if kind.startswith(".") else None,
            )
    files = FileDescriptorSet(file=[file, FileDescriptorProto.FromString(Timestamp.DESCRIPTOR.file.serialized_pb)])
    return files.SerializeToString()


def encoded(type_name: str, message: dict[str, Any]) -> bytes:
    """A message in the wire format."""
    return bytes(type(read_protobuf(descriptor_set(), type_name, b""))(**message).SerializeToString())


def foxglove_of(kind: str, message: Any) -> tuple[str, dict[str, Any]]:
    """Schema and fields of a decoded ROS message."""

    def times(header: Any) -> dict[str, Any]:
        return {"timestamp": {"seconds": header.stamp.sec, "nanos": header.stamp.nanosec}}

    if kind == JOINT_STATE:
        joints = [{"name": n, "position": float(p)} for n, p in zip(message.name, message.position, strict=True)]
        return "foxglove.JointStates", {**times(message.header), "joints": joints}
    if kind not in {COMPRESSED_IMAGE, IMAGE, CAMERA_INFO}:
        return "foxglove.FrameTransforms", {
            "transforms": [
                {
                    **times(item.header),
                    "parent_frame_id": item.header.frame_id,
                    "child_frame_id": item.child_frame_id,
                    "translation": {key: getattr(item.transform.translation, key) for key in "xyz"},
                    "rotation": {key: getattr(item.transform.rotation, key) for key in "xyzw"},
                }
                for item in message.transforms
            ]
        }
    fields = {**times(message.header), "frame_id": message.header.frame_id}
    if kind == COMPRESSED_IMAGE:
        return "foxglove.CompressedImage", {**fields, "data": bytes(message.data), "format": message.format}
    fields |= {"width": message.width, "height": message.height}
    if kind == CAMERA_INFO:
        matrices = {name: list(getattr(message, name.lower())) for name in "DKRP"}
        return "foxglove.CameraCalibration", {**fields, "distortion_model": message.distortion_model, **matrices}
    data = {"encoding": message.encoding, "step": message.step, "data": bytes(message.data)}
    return "foxglove.RawImage", {**fields, **data}


def convert(
    log: Path, path: Path, encoding: str, spoil: Callable[[str, bytes], bytes] = lambda name, data: data
) -> Path:
    """The images, calibrations and transforms of a ROS 2 log in Foxglove's schemas."""
    definition = descriptor_set().decode("latin-1") if encoding == "protobuf" else "{}"
    decoder = MessageDecoder()

    def converted(message: RawMessage) -> RawMessage:
        name, fields = foxglove_of(message.topic.type_name, decoder.decode(message))
        topic = Topic(name=message.topic.name, type_name=name, encoding=encoding, definition=definition)
        text = json.dumps(told(fields, ("sec", "nsec"), lambda data: base64.b64encode(data).decode())).encode()
        return replace(
            message, topic=topic, data=spoil(name, encoded(name, fields) if encoding == "protobuf" else text)
        )

    return rewritten(log, path, converted)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
@pytest.mark.parametrize("recipe", [LogRecipe(has_joints=False), LogRecipe(has_joints=False, color_format="bgra8")])
def test_foxglove_schemas_give_the_records_of_the_same_ros_log(
    tmp_path: Path, encoding: str, recipe: LogRecipe
) -> None:
    log = make_log(tmp_path / "log.mcap", recipe)
    source = open_source(convert(log, tmp_path / "foxglove.mcap", encoding))
    assert_same(list(open_source(log).records()), list(source.records()))
    rows = [row[:3] for row in describe(tmp_path / "foxglove.mcap").grids[0].rows]
    assert source.loss.damaged == 0 and ["/cam0/depth/image_raw", "foxglove.RawImage", encoding] in rows


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_joint_states_of_foxglove_give_positions_and_their_differences(tmp_path: Path, encoding: str) -> None:
    log = make_log(tmp_path / "log.mcap")
    source = open_source(convert(log, tmp_path / "foxglove.mcap", encoding))
    before, after = (
        [(r.stamp_ns, r.position.tolist()) for r in each.records() if isinstance(r, JointState)]
        for each in (open_source(log), source)
    )
    assert (after, source.loss.differentiated_velocities) == (before, len(before)) and after


def in_ros_types(log: Path, folder: Path, kind: str, has_definitions: bool = True) -> Path:
    """The images, calibrations and transforms of a log as foxglove_msgs in a ROS 2 .db3 or a ROS 1 .bag."""
    ros = 2 if kind == "db3" else 1
    store = get_typestore(Stores.ROS2_HUMBLE if ros == 2 else Stores.ROS1_NOETIC)
    for name, definition in DEFINITIONS.items():
        capital = re.sub(r" ([dkrp])\n", lambda m: f" {m[1].upper()}\n", definition)
        of_ros1 = capital.replace("builtin_interfaces/Time", "time")
        store.register(get_types_from_msg(definition if ros == 2 else of_ros1, name))
    path, decoder, messages = folder / ("bag" if ros == 2 else "log.bag"), MessageDecoder(), []
    for message in messages_of(log):
        name, fields = foxglove_of(message.topic.type_name, decoder.decode(message))
        fields = told(fields, ("sec", "nanosec"), bytes)
        content = built(name.replace("foxglove.", "foxglove_msgs/msg/"), store, **fields)
        messages.append(ros_message(message.log_time_ns, message.topic.name, content, store, ros=ros))
    write_bag(path, messages, store, StoragePlugin.SQLITE3 if ros == 2 else None)
    if not has_definitions:
        with closing(sqlite3.connect(path / "bag.db3")) as database, database:
            database.execute("DROP TABLE IF EXISTS message_definitions")
    return path


@pytest.mark.parametrize(("kind", "has_definitions"), [("db3", True), ("db3", False), ("bag", True)])
def test_foxglove_msgs_in_a_bag_give_the_records_of_the_same_ros_log(
    tmp_path: Path, kind: str, has_definitions: bool
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_joints=False))
    bag = in_ros_types(log, tmp_path, kind, has_definitions)
    source = open_source(bag)
    assert_same(list(open_source(log).records()), list(source.records()))
    rows = {str(row[0]): row[1] for row in describe(bag).grids[0].rows}
    assert (source.loss.damaged, rows["/cam0/depth/image_raw"]) == (0, "foxglove_msgs/msg/RawImage")


def test_a_transform_that_comes_once_holds_always(tmp_path: Path) -> None:
    """Foxglove has no static transforms; of two samples or more the times count, as in tf."""
    log = make_log(tmp_path / "log.mcap", LogRecipe(has_joints=False, tf_frames=1))
    assert len(list(open_source(log).records())) == 1
    frames = frames_of(convert(log, tmp_path / "foxglove.mcap", "protobuf"))
    assert [frame.T_world_camera[0, 3] for frame in frames] == [0.0] * 5


def test_a_message_that_does_not_decode_is_counted(tmp_path: Path) -> None:
    log, images = make_log(tmp_path / "log.mcap", LogRecipe(has_joints=False)), count()

    def spoil(name: str, data: bytes) -> bytes:
        return data[:-3] if name == "foxglove.CompressedImage" and next(images) == 2 else data

    source = open_source(convert(log, tmp_path / "broken.mcap", "protobuf", spoil))
    assert (len(list(source.records())), source.loss.damaged) == (4, 1)
    assert "foxglove.CompressedImage that does not decode: protobuf: Error parsing message" in source.loss.notes[0]


@pytest.mark.parametrize("data", [b"\x0a\xff", b"\xff" * 11, b"\x0b", b"\x0a\x05abc", struct.pack("<B", 9) + b"1234"])
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="protobuf: Error parsing message"):
        read_protobuf(descriptor_set(), "foxglove.Vector3", data)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda files: files.file.pop(1), "Couldn't build proto file"),  # without its import
        (lambda files: files.file.add(name="foxglove.proto", package="other"), "foxglove.proto already added"),
    ],
)
def test_a_schema_that_is_not_usable_is_refused(change: Callable[[FileDescriptorSet], object], words: str) -> None:
    files = FileDescriptorSet.FromString(descriptor_set())
    change(files)
    with pytest.raises(ValueError, match=f"protobuf: .*{words}"):
        read_protobuf(files.SerializeToString(), "foxglove.RawImage", b"")


def test_fields_that_were_not_written_have_their_defaults_and_unknown_ones_are_passed_over() -> None:
    message = read_protobuf(descriptor_set(), "foxglove.FrameTransform", b"\x1a\x03cam" + b"\x9a\x06\x03new")
    assert (message.child_frame_id, message.parent_frame_id, message.timestamp.seconds) == ("cam", "", 0)
    with pytest.raises(ValueError, match=r"does not define foxglove\.Nothing"):
        read_protobuf(descriptor_set(), "foxglove.Nothing", b"")


def test_the_descriptors_of_a_real_log_are_read(real_data: Path) -> None:
    with (real_data / "rosbag2_mcap_sensor_msgs/simple-protobuf.mcap").open("rb") as stream:
        found = [(c, s, m) for s, c, m in make_reader(stream).iter_messages() if s is not None]
    schema, message = next((s, m) for channel, s, m in found if channel.message_encoding == "protobuf")
    sent = read_protobuf(schema.data, schema.name, message.data)
    assert (sent.timestamp.seconds, sent.timestamp.nanos, sent.frame_id) == (39, 427100000, "device")
    assert (sent.pose.orientation.w, sent.pose.position.x) == (1.0, 0.0)


def told(value: Any, names: tuple[str, str], pack: Callable[[bytes], object]) -> Any:
    """A value with these names of the parts of a time, and bytes as `pack` writes them."""
    if isinstance(value, bytes):
        return pack(value)
    if isinstance(value, dict) and "nanos" in value:
        return dict(zip(names, (value["seconds"], value["nanos"]), strict=True))
    if isinstance(value, dict):
        return {key: told(item, names, pack) for key, item in value.items()}
    return [told(item, names, pack) for item in value] if isinstance(value, list) else value

"""Small logs of a robot's motion, made in code, in the types that robots publish."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
POINT = "trajectory_msgs/JointTrajectoryPoint"
OLD_CONTROLLER = f"std_msgs/Header header\nstring[] joint_names\n{POINT} desired\n{POINT} actual\n{POINT} error\n"
NEW_CONTROLLER = (
    f"std_msgs/Header header\nstring[] joint_names\n{POINT} reference\n{POINT} feedback\n{POINT} error\n"
    f"{POINT} output\n{POINT} desired\n{POINT} actual\n"
)
FRANKA_STATE = (
    "std_msgs/Header header\nfloat64[7] q\nfloat64[7] q_d\nfloat64[7] dq\nfloat64[7] dq_d\nfloat64[16] O_T_EE\n"
    "float64[16] O_T_EE_d\nfloat64 time\n"
)
FRANKA_ROBOT_STATE = (
    "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\n"
    "sensor_msgs/JointState desired_joint_state\ngeometry_msgs/PoseStamped o_t_ee\nfloat64 time\n"
)


@dataclass(frozen=True, kw_only=True)
class Message:
    """A message of a log: when it was logged, its topic, type and content."""

    log_ns: int
    topic: str
    type_name: str
    content: Any


def store_with(**definitions: str) -> Any:
    """The ROS 2 type store and types by name (package__Type) and definition."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name.replace("__", "/msg/")))
    return store


def header(store: Any, stamp_ns: int, frame: str = "") -> Any:
    """A std_msgs/Header of either ROS."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    kind, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    stamp = time(sec=seconds, nanosec=nanoseconds)
    return (
        kind(seq=0, stamp=stamp, frame_id=frame)
        if "seq" in kind.__dataclass_fields__
        else kind(stamp=stamp, frame_id=frame)
    )


def joint_state(
    stamp_ns: int,
    names: Sequence[str],
    position: Sequence[float],
    velocity: Sequence[float] = (),
    *,
    store: Any = STORE,
) -> Any:
    """A sensor_msgs/JointState."""
    return store.types["sensor_msgs/msg/JointState"](
        header=header(store, stamp_ns),
        name=list(names),
        position=np.array(position, dtype=np.float64),
        velocity=np.array(velocity, dtype=np.float64),
        effort=np.zeros(0),
    )


def states_of(
    q: Any,
    names: Sequence[str],
    *,
    topic: str = "/joint_states",
    stamps: Sequence[int] | None = None,
    velocity: Any = None,
    log_delay_ns: int = 0,
) -> list[Message]:
    """JointState messages of positions (T, J), every 10 ms."""
    times = [START_NS + i * STEP_NS for i in range(len(q))] if stamps is None else list(stamps)
    return [
        Message(
            log_ns=stamp + log_delay_ns,
            topic=topic,
            type_name="sensor_msgs/msg/JointState",
            content=joint_state(stamp, names, q[i], () if velocity is None else velocity[i]),
        )
        for i, stamp in enumerate(times)
    ]


def write_mcap(path: Path, messages: Sequence[Message], store: Any = STORE) -> Path:
    """An MCAP log of the messages, in their order."""
    channels: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="tests")
        for message in messages:
            if message.topic not in channels:
                text, _ = store.generate_msgdef(message.type_name, ros_version=2)
                schema = writer.register_schema(name=message.type_name, encoding="ros2msg", data=text.encode())
                channels[message.topic] = writer.register_channel(
                    topic=message.topic, message_encoding="cdr", schema_id=schema
                )
            writer.add_message(
                channels[message.topic],
                log_time=message.log_ns,
                publish_time=message.log_ns,
                data=bytes(store.serialize_cdr(message.content, message.type_name)),
            )
        writer.finish()
    return path


def write_bag2(path: Path, messages: Sequence[Message], store: Any = STORE) -> Path:
    """A ROS 2 bag folder (sqlite3)."""
    with Bag2Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        kinds = {message.topic: message.type_name for message in messages}
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for message in messages:
            data = store.serialize_cdr(message.content, message.type_name)
            writer.write(connections[message.topic], message.log_ns, data)
    return path


def write_bag1(path: Path, messages: Sequence[Message], store: Any) -> Path:
    """A ROS 1 bag."""
    with Bag1Writer(path) as writer:
        kinds = {message.topic: message.type_name for message in messages}
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for message in messages:
            data = store.serialize_ros1(message.content, message.type_name)
            writer.write(connections[message.topic], message.log_ns, data)
    return path

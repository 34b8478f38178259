"""Small logs of a robot's motion, made in code, in the types that robots publish."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatctrl_cli.recording.log.decoder import JOINT_STATE
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import JointState, RecordSource
from tests.recording.log.make_log import START_NS, STORE, built, encoded, write_bag, write_raw
from tests.recording.log.make_log import header as stamped_header
from tests.refused import expect_refusal

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
    return stamped_header(stamp_ns, frame, store)


def joint_state(
    stamp_ns: int,
    names: Sequence[str],
    position: Sequence[float],
    velocity: Sequence[float] = (),
    *,
    store: Any = STORE,
) -> Any:
    """A sensor_msgs/JointState."""
    head = header(store, stamp_ns)
    return built(JOINT_STATE, store, header=head, name=names, position=position, velocity=velocity)


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
            type_name=JOINT_STATE,
            content=joint_state(stamp, names, q[i], () if velocity is None else velocity[i]),
        )
        for i, stamp in enumerate(times)
    ]


def write_mcap(path: Path, messages: Sequence[Message], store: Any = STORE) -> Path:
    """An MCAP log of the messages, in their order."""
    return write_raw(path, [encoded(m.log_ns, m.topic, m.content, store) for m in messages])


def write_bag2(path: Path, messages: Sequence[Message], store: Any = STORE) -> Path:
    """A ROS 2 bag folder (sqlite3)."""
    written = [encoded(m.log_ns, m.topic, m.content, store) for m in messages]
    return write_bag(path, written, store, StoragePlugin.SQLITE3)


def write_bag1(path: Path, messages: Sequence[Message], store: Any) -> Path:
    """A ROS 1 bag."""
    return write_bag(path, [encoded(m.log_ns, m.topic, m.content, store, ros=1) for m in messages], store)


AB = ("a", "b")


def opened(path: Path, joints: tuple[str, ...] = AB, **options: Any) -> RecordSource:
    """The joint states at a path."""
    return open_states(path, SourceOptions(**options), joints)


def states(source: Path | RecordSource) -> list[JointState]:
    """In the order of the source's joint names."""
    records = (opened(source) if isinstance(source, Path) else source).records()
    return [record for record in records if isinstance(record, JointState)]


def refusal(path: Path, joints: tuple[str, ...] = AB, **options: Any) -> str:
    """Why there are none."""
    return expect_refusal("", opened, path, joints, has_remedy=True, **options)

"""Joint states of robots' messages, in columns by joint names."""

from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatctrl_cli.errors import refuse_if, require
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.recording.log.decoder import JOINT_STATE, UndecodableMessageError, stamp_ns
from splatctrl_cli.recording.log.state_columns import ColumnWriter
from splatctrl_cli.records import Float64, Stamps

FRANKA_STATES = ("franka_msgs/msg/FrankaRobotState", "franka_msgs/msg/FrankaState")
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
STATE_TYPES = (JOINT_STATE, *FRANKA_STATES, CONTROLLER_STATE, TRAJECTORY)
STANDARD_TYPES = (JOINT_STATE, TRAJECTORY)  # known without a definition in the log
NAMELESS = tuple(f"joint{number}" for number in range(1, 8))  # what a Franka's q[0..6] are called
_MAX_SKEW = 1e-2  # largest entry of R^T R - I of a pose that a robot logs


_NONE: Float64 = np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class RawJoints:
    """A joint state as recorded, in the order of its names.

    position (J,); velocity, commanded_velocity (J,) or empty. T_base_ee (4, 4): the controller's end-effector pose.
    note: what is not used, and why.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: Float64
    velocity: Float64
    log_time_ns: int = 0
    commanded_velocity: Float64 = field(default_factory=lambda: _NONE)
    T_base_ee: Float64 | None = None
    note: str = ""


_Read = tuple[str, Any, Any, Any, Any, Float64 | None]
"""Kind of message, joint names, positions, velocities, commanded velocities, T_base_ee."""


def read_states(message: Any, type_name: str, log_time_ns: int) -> list[RawJoints]:
    """Joint states of a `STATE_TYPES` message; log time [ns]. Raises UndecodableMessageError."""
    if type_name == TRAJECTORY:
        return _trajectory(message, log_time_ns)
    read = _franka if type_name in FRANKA_STATES else _controller if type_name == CONTROLLER_STATE else _joint_state
    what, joints, *columns, T_base_ee = read(message)
    names = tuple(str(name) for name in joints)
    position, velocity, commanded = (np.asarray(values, dtype=np.float64) for values in columns)
    refuse_if(
        len(position) != len(names),
        f"{what} with {len(names)} names and {len(position)} positions",
        error=UndecodableMessageError,
    )
    is_odd = len(velocity) not in {0, len(names)}
    return [
        RawJoints(
            stamp_ns=stamp_ns(message.header),
            names=names,
            position=position,
            velocity=velocity if len(velocity) == len(names) else _NONE,
            log_time_ns=log_time_ns,
            commanded_velocity=commanded if len(commanded) == len(names) else _NONE,
            T_base_ee=T_base_ee,
            note=f"{len(names)} names with {len(velocity)} velocities, which are not used" if is_odd else "",
        )
    ]


def _joint_state(message: Any) -> _Read:
    return "a JointState", message.name, message.position, message.velocity, _NONE, None


def rigid_or_none(T: Float64) -> Float64 | None:
    """The pose T (4, 4), None unless it is rigid; an unfilled field is zeros."""
    R = T[:3, :3]
    is_rigid = np.isfinite(T).all() and np.abs(R.T @ R - np.eye(3)).max() < _MAX_SKEW and np.linalg.det(R) > 0
    return T if is_rigid else None


def pose_of_columns(values: Float64) -> Float64 | None:
    """T (4, 4) of 16 numbers by columns, as in libfranka (franka/robot_state.h)."""
    return rigid_or_none(values.reshape(4, 4).T)


def pose_of_quat(position: Float64, quat_xyzw: Float64) -> Float64 | None:
    """T (4, 4) of a position [m], None if the quaternion is not unit."""
    if not (np.isfinite(position).all() and abs(float(np.linalg.norm(quat_xyzw)) - 1.0) < _MAX_SKEW):
        return None
    return transform_from(position, quat_xyzw)


def _franka(message: Any) -> _Read:
    fields = {name.lower(): getattr(message, name) for name in message.__dataclass_fields__}
    if "measured_joint_state" in fields:
        measured, desired, pose = fields["measured_joint_state"], fields["desired_joint_state"], fields["o_t_ee"].pose
        p, r = pose.position, pose.orientation
        names, position, velocity, commanded = measured.name, measured.position, measured.velocity, desired.velocity
        T = pose_of_quat(np.array([p.x, p.y, p.z]), np.array([r.x, r.y, r.z, r.w]))
    else:
        names, (position, velocity, commanded) = (), (fields[name] for name in ("q", "dq", "dq_d"))
        T = pose_of_columns(np.asarray(fields["o_t_ee"], dtype=np.float64))
    names = NAMELESS if not names and len(position) == len(NAMELESS) else names
    return "a Franka state", names, position, velocity, commanded, T


def _controller(message: Any) -> _Read:
    names = message.joint_names

    def filled(*fields: str) -> Any:
        fields_present = (getattr(message, name) for name in fields if name in message.__dataclass_fields__)
        return next((point for point in fields_present if len(point.positions) == len(names)), None)

    what = f"a controller state of {len(names)} joints without positions"
    actual = require(filled("feedback", "actual"), what, error=UndecodableMessageError)
    commanded = getattr(filled("reference", "desired"), "velocities", _NONE)
    return "a controller state", names, actual.positions, actual.velocities, commanded, None


def _trajectory(message: Any, log_time_ns: int) -> list[RawJoints]:
    names = tuple(str(name) for name in message.joint_names)
    start_ns = stamp_ns(message.header) or log_time_ns
    states = []
    for point in message.points:
        since = point.time_from_start
        position, velocity = (np.asarray(v, dtype=np.float64) for v in (point.positions, point.velocities))
        refuse_if(
            len(position) != len(names),
            f"a trajectory of {len(names)} joints with {len(position)} positions",
            error=UndecodableMessageError,
        )
        after_ns = int(since.sec) * 1_000_000_000 + int(since.nanosec)
        states.append(
            RawJoints(
                stamp_ns=start_ns + after_ns,
                names=names,
                position=position,
                velocity=velocity if len(velocity) == len(names) else _NONE,
                log_time_ns=log_time_ns + after_ns,
                commanded_velocity=velocity if len(velocity) == len(names) else _NONE,
            )
        )
    return states


COLUMNS = ("position", "velocity", "commanded_velocity", "T_base_ee")
_NO_STAMPS = np.zeros(0, dtype=np.int64)


class JointStream(ColumnWriter):
    """States with equal joints, in the first one's order."""

    def __init__(
        self,
        names: tuple[str, ...],
        stamp_ns: Stamps = _NO_STAMPS,
        log_time_ns: Stamps = _NO_STAMPS,
        columns: Mapping[str, Iterable[Float64]] | None = None,
    ) -> None:
        """Start with known states, as columns in blocks. Raises ValueError for unequal lengths."""
        self.names = names
        self._stamps, self._log_times = array("q", stamp_ns.tolist()), array("q", log_time_ns.tolist())
        self._orders: dict[tuple[str, ...], list[int]] = {names: list(range(len(names)))}
        super().__init__({name: (4, 4) if name == "T_base_ee" else (len(names),) for name in COLUMNS}, columns or {})
        refuse_if(
            columns and (len(self) != len(self._stamps) or "position" not in columns),
            f"no positions, or columns of other lengths than {len(self._stamps)}",
            error=ValueError,
        )

    @property
    def stamp_ns(self) -> Stamps:
        return np.array(self._stamps, dtype=np.int64)

    @property
    def log_time_ns(self) -> Stamps:
        return np.array(self._log_times, dtype=np.int64)

    def add_state(self, state: RawJoints) -> None:
        """Add a state. Raises OverflowError for a time beyond 64 bits."""
        times = array("q", (state.stamp_ns, state.log_time_ns))  # both, before either is kept
        self._stamps.append(times[0])
        self._log_times.append(times[1])
        self.add({name: self._row(state, name) for name in COLUMNS})

    def _row(self, state: RawJoints, name: str) -> Float64 | None:
        value: Float64 | None = getattr(state, name)
        if value is None or name == "T_base_ee" or not len(value):
            return value if value is not None and len(value) else None
        if state.names not in self._orders:
            self._orders[state.names] = [state.names.index(joint) for joint in self.names]
        return value[self._orders[state.names]]


class JointLog:
    """`num` joint states of a topic, in streams by their joints.

    first_names: the first state's joints, or None. notes: counts by text.
    """

    def __init__(self, streams: Sequence[JointStream] = (), num: int = 0) -> None:
        self.first_names = streams[0].names if streams else None
        self.notes: Counter[str] = Counter()
        self.num = num
        self.streams = {frozenset(stream.names): stream for stream in streams}

    def extend(self, states: Iterable[RawJoints]) -> None:
        """Add states. Raises OverflowError for a time beyond 64 bits."""
        for state in states:
            self.notes.update(filter(None, [state.note]))
            if state.names:  # without names, nothing says which joints these are
                stream = self.streams.get(frozenset(state.names)) or JointStream(state.names)
                stream.add_state(state)
                self.streams[frozenset(state.names)] = stream
            self.first_names = state.names if self.first_names is None else self.first_names
            self.num += 1

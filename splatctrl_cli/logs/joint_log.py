"""The joint states of one topic as they are read: columns by which joints a message names."""

from array import array
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from splatctrl_cli.files.spilled_rows import Rows
from splatctrl_cli.logs.state_columns import ColumnWriter
from splatctrl_cli.logs.state_messages import RawJoints
from splatctrl_cli.records import Float64, Stamps

COLUMNS = ("position", "velocity", "commanded_velocity", "T_base_ee")


class JointStream:
    """States that name the same joints; `names` in the order of the first, which is that of the columns."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self._stamps, self._log_times = array("q"), array("q")
        self._orders: dict[tuple[str, ...], list[int]] = {names: list(range(len(names)))}
        self._columns = ColumnWriter({name: (4, 4) if name == "T_base_ee" else (len(names),) for name in COLUMNS})

    @classmethod
    def of(
        cls, names: tuple[str, ...], stamp_ns: Stamps, log_time_ns: Stamps, columns: Mapping[str, Iterable[Float64]]
    ) -> "JointStream":
        """The stream that had these columns, given as blocks of rows. Raises ValueError for other lengths."""
        stream = cls(names)
        stream._stamps.extend(stamp_ns.tolist())
        stream._log_times.extend(log_time_ns.tolist())
        for name, blocks in columns.items():
            stream._columns.add_column(name, blocks)
        if columns and len(stream._columns) != len(stream):
            raise ValueError(f"columns of other lengths than {len(stream)}")
        return stream

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamp_ns(self) -> Stamps:
        """Of the messages (T,)."""
        return np.array(self._stamps, dtype=np.int64)

    @property
    def log_time_ns(self) -> Stamps:
        """When they were logged (T,)."""
        return np.array(self._log_times, dtype=np.int64)

    def columns(self) -> dict[str, Rows]:
        """position, velocity, commanded_velocity (T, J), T_base_ee (T, 4, 4): NaN where a state has none, not there
        where none has one.
        """
        return self._columns.tables()

    def add(self, state: RawJoints) -> None:
        """The next state. Raises OverflowError for a time beyond 64 bits."""
        times = array("q", (state.stamp_ns, state.log_time_ns))  # both, before either is kept
        self._stamps.append(times[0])
        self._log_times.append(times[1])
        self._columns.add({name: self._row(state, name) for name in COLUMNS})

    def _row(self, state: RawJoints, name: str) -> Float64 | None:
        value: Float64 | None = getattr(state, name)
        if value is None or name == "T_base_ee" or not len(value):
            return value if value is not None and len(value) else None
        if state.names not in self._orders:
            self._orders[state.names] = [state.names.index(joint) for joint in self.names]
        return value[self._orders[state.names]]


class JointLog:
    """The states of a topic in file order; first_names: of the first, None before it."""

    def __init__(self) -> None:
        self.first_names: tuple[str, ...] | None = None
        self._num = 0
        self._streams: dict[frozenset[str], JointStream] = {}

    @classmethod
    def of(cls, num: int, streams: Sequence[JointStream]) -> "JointLog":
        """The log of `num` states that had these streams."""
        log = cls()
        log._num = num
        log._streams = {frozenset(stream.names): stream for stream in streams}
        log.first_names = streams[0].names if streams else None
        return log

    def __len__(self) -> int:
        return self._num

    @property
    def streams(self) -> list[JointStream]:
        """By which joints they name; states that name none are in none."""
        return list(self._streams.values())

    def extend(self, states: Iterable[RawJoints]) -> None:
        """The next states. Raises OverflowError for a time beyond 64 bits."""
        for state in states:
            if state.names:
                key = frozenset(state.names)
                stream = self._streams[key] if key in self._streams else JointStream(state.names)
                stream.add(state)
                self._streams[key] = stream
            if self.first_names is None:
                self.first_names = state.names
            self._num += 1

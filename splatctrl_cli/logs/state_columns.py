"""Cleaned joint states as columns that memory need not hold, and as the states they are."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.rows import BLOCK, RowFile, Rows, Table, of_columns, ranges, selected
from splatctrl_cli.records import Float64, JointState

Stamps = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class StateColumns(Sequence[JointState]):
    """T states by stamp: stamp_ns (T,); position, velocity (T, J); what a log may have beside them, None where it has
    none: commanded_velocity (T, J), T_base_ee and T_world_ee (T, 4, 4), NaN where a state has none.

    ``columns[i]`` and iteration give states, read a block at a time.
    """

    stamp_ns: Stamps
    position: Table
    velocity: Table
    commanded_velocity: Table | None = None
    T_base_ee: Table | None = None
    T_world_ee: Table | None = None

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @overload
    def __getitem__(self, index: int) -> JointState: ...
    @overload
    def __getitem__(self, index: slice) -> list[JointState]: ...
    def __getitem__(self, index: int | slice) -> JointState | list[JointState]:
        if isinstance(index, slice):
            first, last, step = index.indices(len(self))
            return self.states(first, last)[::step] if step > 0 else [self[i] for i in range(first, last, step)]
        number = index + (len(self) if index < 0 else 0)
        if not 0 <= number < len(self):
            raise IndexError(f"state {index} of {len(self)}")
        return self.states(number, number + 1)[0]

    def __iter__(self) -> Iterator[JointState]:
        for first, last in ranges(len(self)):
            yield from self.states(first, last)

    def states(self, first: int, last: int) -> list[JointState]:
        """The states of a range."""
        optional = (self.commanded_velocity, self.T_base_ee, self.T_world_ee)
        commanded, base, world = (_optional(values, first, last) for values in optional)
        position, velocity = self.position[first:last], self.velocity[first:last]
        return [
            JointState(
                stamp_ns=stamp,
                position=position[i],
                velocity=velocity[i],
                commanded_velocity=commanded[i],
                T_base_ee=base[i],
                T_world_ee=world[i],
            )
            for i, stamp in enumerate(self.stamp_ns[first:last].tolist())
        ]

    def select(self, index: NDArray[np.int64]) -> "StateColumns":
        """The states of an index (K,), in its order."""
        commanded, base, world = self.commanded_velocity, self.T_base_ee, self.T_world_ee
        return StateColumns(
            stamp_ns=self.stamp_ns[index],
            position=selected(self.position, index),
            velocity=selected(self.velocity, index),
            commanded_velocity=None if commanded is None else selected(commanded, index),
            T_base_ee=None if base is None else selected(base, index),
            T_world_ee=None if world is None else selected(world, index),
        )

    def of_joints(self, order: NDArray[np.int64]) -> "StateColumns":
        """The joints of an order (J,)."""
        commanded = self.commanded_velocity
        return StateColumns(
            stamp_ns=self.stamp_ns,
            position=of_columns(self.position, order),
            velocity=of_columns(self.velocity, order),
            commanded_velocity=None if commanded is None else of_columns(commanded, order),
            T_base_ee=self.T_base_ee,
            T_world_ee=self.T_world_ee,
        )


class StateCollector:
    """Takes states one after the other and gives their columns."""

    def __init__(self, num_joints: int) -> None:
        self._num_joints = num_joints
        self._stamps: list[Stamps] = []
        self._files: dict[str, RowFile] = {}
        self._num = 0
        self._waiting: list[JointState] = []

    def add(self, state: JointState) -> None:
        """The next state. Raises InputError for one of another number of joints."""
        if np.shape(state.position) != (self._num_joints,):
            number = self._num + len(self._waiting)
            raise InputError(
                f"joint state {number}: expected {self._num_joints} joints, got {np.size(state.position)}"
            )
        self._waiting.append(state)
        if len(self._waiting) == BLOCK:
            self._flush()

    def columns(self) -> StateColumns:
        """Of all states so far."""
        self._flush()
        stamps = np.concatenate(self._stamps) if self._stamps else np.zeros(0, dtype=np.int64)
        found: dict[str, Table] = {name: Rows(file) for name, file in self._files.items()}
        nothing = np.zeros((0, self._num_joints))
        return StateColumns(
            stamp_ns=stamps,
            position=found.get("position", nothing),
            velocity=found.get("velocity", nothing),
            commanded_velocity=found.get("commanded_velocity"),
            T_base_ee=found.get("T_base_ee"),
            T_world_ee=found.get("T_world_ee"),
        )

    def _flush(self) -> None:
        states = self._waiting
        if not states:
            return
        self._waiting = []
        self._stamps.append(np.array([state.stamp_ns for state in states], dtype=np.int64))
        joints, pose = (self._num_joints,), (4, 4)
        self._append("position", joints, [state.position for state in states])
        self._append("velocity", joints, [state.velocity for state in states])
        self._append("commanded_velocity", joints, [state.commanded_velocity for state in states])
        self._append("T_base_ee", pose, [state.T_base_ee for state in states])
        self._append("T_world_ee", pose, [state.T_world_ee for state in states])
        self._num += len(states)

    def _append(self, name: str, shape: tuple[int, ...], values: Sequence[Float64 | None]) -> None:
        is_absent = all(value is None for value in values)
        if is_absent and name not in self._files:
            return
        nothing = np.full(shape, np.nan)
        append_after(self._files, name, shape, self._num, np.array([nothing if v is None else v for v in values]))


def append_after(files: dict[str, RowFile], name: str, shape: tuple[int, ...], num: int, rows: Float64) -> None:
    """Add rows to the file of a column; one that comes up late is NaN at the `num` states before."""
    if name not in files:
        files[name] = RowFile(shape)
        for first, last in ranges(num):
            files[name].append(np.full((last - first, *shape), np.nan))
    files[name].append(rows)


def _optional(values: Table | None, first: int, last: int) -> list[Float64 | None]:
    """A value per state of a range, None where it is not finite."""
    if values is None:
        return [None] * (last - first)
    return [value if np.isfinite(value).all() else None for value in values[first:last]]

"""Cleaned joint states, as columns on disk and as states."""

from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, overload

import numpy as np

from splatctrl_cli.errors import refuse_if
from splatctrl_cli.files.spilled_rows import BLOCK, RowFile, Rows, Table, blocks_of, ranges, select
from splatctrl_cli.records import Float64, Index, JointState, Posture, Stamps

OF_JOINTS = ("position", "velocity", "commanded_velocity")
COLUMNS = (*OF_JOINTS, "T_base_ee", "T_world_ee")


@dataclass(frozen=True, kw_only=True, eq=False)
class StateColumns(Sequence[JointState]):
    """T states by stamp: stamp_ns (T,); position, velocity (T, J).

    commanded_velocity (T, J), T_base_ee, T_world_ee (T, 4, 4): None if absent, NaN where a state has none. Indexing
    and iteration return states, reading a block at a time.
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
        refuse_if(not 0 <= number < len(self), f"state {index} of {len(self)}", error=IndexError)
        return self.states(number, number + 1)[0]

    def __iter__(self) -> Iterator[JointState]:
        for first, last in ranges(len(self)):
            yield from self.states(first, last)

    def postures(self, within_ns: int) -> Posture:
        """Function from stamp [ns] to positions (J,), None without a state within `within_ns`.

        Linear between two such states.
        """

        def posture(stamp_ns: int) -> Float64 | None:
            after = int(np.searchsorted(self.stamp_ns, stamp_ns))
            near = [
                i
                for i in (after - 1, after)
                if 0 <= i < len(self) and abs(int(self.stamp_ns[i]) - stamp_ns) <= within_ns
            ]
            if not near:
                return None
            if len(near) == 1:
                return self[near[0]].position
            before, later = self[near[0]], self[near[1]]
            share = (stamp_ns - before.stamp_ns) / max(later.stamp_ns - before.stamp_ns, 1)
            return np.asarray((1 - share) * before.position + share * later.position)

        return posture

    def states(self, first: int, last: int) -> list[JointState]:
        """States from `first` up to, but not with, `last`."""
        commanded, base, world = (
            _optional(values, first, last) for values in (self.commanded_velocity, self.T_base_ee, self.T_world_ee)
        )
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

    def select(self, index: Index) -> Self:
        """States of an index (K,), in its order."""
        return self._changed(lambda table, _: select(table, index), COLUMNS, stamp_ns=self.stamp_ns[index])

    def select_joints(self, order: Index) -> Self:
        return self._changed(lambda table, _: select(table, columns=order), OF_JOINTS)

    def convert_joints(self, order: Index, factor: Float64, offset: Float64) -> Self:
        """Joints (J,): ``position[order] * factor + offset``; velocities without offset."""
        plain = self.select_joints(order)
        if (factor == 1.0).all() and (offset == 0.0).all():
            return plain

        def moved(table: Table, name: str) -> Table:
            shift = offset if name == "position" else 0.0
            return Rows(RowFile((len(order),), (block * factor + shift for block in blocks_of(table))))

        return plain._changed(moved, OF_JOINTS)

    def tables(self) -> dict[str, Table]:
        return {name: table for name in COLUMNS if (table := getattr(self, name)) is not None}

    def _changed(self, change: Callable[[Table, str], Table], names: Collection[str], **others: Any) -> Self:
        changed: dict[str, Any] = {
            name: change(table, name) for name, table in self.tables().items() if name in names
        }
        return replace(self, **others, **changed)


NO_STATES = StateColumns(stamp_ns=np.zeros(0, np.int64), position=np.zeros((0, 0)), velocity=np.zeros((0, 0)))


class ColumnWriter:
    """A writer of columns by state, in blocks; NaN if missing."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], blocks: Mapping[str, Iterable[Float64]]) -> None:
        """shapes: of one row; blocks: known states' columns. Raises ValueError if these differ in length."""
        self._shapes = shapes
        self._files = {name: RowFile(shapes[name], of_column) for name, of_column in blocks.items()}
        self._num, *others = {len(file) for file in self._files.values()} or {0}  # states that are in the files
        refuse_if(others, f"{', '.join(self._files)}: columns of several lengths", error=ValueError)
        self._waiting: list[Mapping[str, Float64 | None]] = []

    def __len__(self) -> int:
        return self._num + len(self._waiting)

    def add(self, values: Mapping[str, Float64 | None]) -> None:
        self._waiting.append(values)
        if len(self._waiting) == BLOCK:
            self._flush()

    def columns(self) -> dict[str, Rows]:
        """Columns (T, ...) with any value so far; NaN where a state has none."""
        self._flush()
        return {name: Rows(self._files[name]) for name in self._shapes if name in self._files}

    def _flush(self) -> None:
        states, self._waiting = self._waiting, []
        for name, shape in self._shapes.items() if states else ():
            values, nothing = [state[name] for state in states], np.full(shape, np.nan)
            if name not in self._files and any(value is not None for value in values):
                self._files[name] = RowFile(
                    shape, ((np.full((last - first, *shape), np.nan) for first, last in ranges(self._num)))
                )  # a column whose first value comes late
            if name in self._files:
                self._files[name].append(np.array([nothing if value is None else value for value in values]))
        self._num += len(states)


class StateCollector:
    def __init__(self, num_joints: int) -> None:
        self._num_joints = num_joints
        self._stamps = array("q")
        joints, pose = (num_joints,), (4, 4)
        self._columns = ColumnWriter({name: joints if name in OF_JOINTS else pose for name in COLUMNS}, {})

    def add(self, state: JointState) -> None:
        """Add a state. Raises InputError for another number of joints."""
        refuse_if(
            np.shape(state.position) != (self._num_joints,),
            f"joint state {len(self._stamps)}: expected {self._num_joints} joints, got {np.size(state.position)}",
        )
        self._stamps.append(state.stamp_ns)
        self._columns.add({name: getattr(state, name) for name in COLUMNS})

    def columns(self) -> StateColumns:
        nothing = np.zeros((0, self._num_joints))
        tables: dict[str, Table] = {"position": nothing, "velocity": nothing, **self._columns.columns()}
        return StateColumns(stamp_ns=np.array(self._stamps, dtype=np.int64), **tables)


def _optional(values: Table | None, first: int, last: int) -> list[Float64 | None]:
    if values is None:
        return [None] * (last - first)
    return [value if np.isfinite(value).all() else None for value in values[first:last]]

"""What a replay keeps of its states: columns and objects in files, read whole, one at a time, or by blocks."""

import pickle
import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from typing import Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.control.audit import AuditTrace, Clearance
from splatctrl_cli.control.ladder import Rung
from splatctrl_cli.control.open_loop import OpenLoopTrace, is_shaped
from splatctrl_cli.control.step import ControlStep, VelocityMargin
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.files.rows import IN_MEMORY, RowFile, Rows, scratch_folder
from splatctrl_cli.records import Float64, FloatRows

BLOCK = 1024  # states that are replayed at once
RUNGS = tuple(Rung)
Stamps = NDArray[np.int64]
T = TypeVar("T")


class StampColumn:
    """Stamps [ns], in memory: eight bytes for each state."""

    def __init__(self) -> None:
        self._parts: list[Stamps] = []

    def append(self, stamp_ns: Stamps) -> None:
        """Add the next (T,)."""
        self._parts.append(stamp_ns)

    @property
    def all(self) -> Stamps:
        """(T,)."""
        if len(self._parts) != 1:
            self._parts = [np.concatenate([np.zeros(0, dtype=np.int64), *self._parts])]
        return self._parts[0]


class StoredObjects(Sequence[T], Generic[T]):
    """Objects in a file without a name, read a block at a time."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY, dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._starts: list[int] = []  # of each block: its first object, and where it is in the file
        self._places: list[int] = []
        self._num = 0
        self._read: tuple[int, list[T]] = (-1, [])

    def extend(self, objects: Sequence[T]) -> None:
        """Add a block."""
        if not objects:
            return
        self._starts.append(self._num)
        self._places.append(self._file.seek(0, 2))
        pickle.dump(list(objects), self._file, protocol=pickle.HIGHEST_PROTOCOL)
        self._num += len(objects)

    def __len__(self) -> int:
        return self._num

    def __iter__(self) -> Iterator[T]:
        for number in range(len(self._starts)):
            yield from self._block(number)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            first, last, step = index.indices(self._num)
            return self._range(first, last) if step == 1 else [self[i] for i in range(first, last, step)]
        at = index + (self._num if index < 0 else 0)
        if not 0 <= at < self._num:
            raise IndexError(f"{index} of {self._num}")
        number = int(np.searchsorted(self._starts, at, side="right")) - 1
        return self._block(number)[at - self._starts[number]]

    def _range(self, first: int, last: int) -> list[T]:
        found: list[T] = []
        while first + len(found) < last:
            at = first + len(found)
            number = int(np.searchsorted(self._starts, at, side="right")) - 1
            start = self._starts[number]
            found += self._block(number)[at - start : last - start]
        return found

    def _block(self, number: int) -> list[T]:
        if self._read[0] != number:
            self._file.seek(self._places[number])
            self._read = number, pickle.load(self._file)
        return self._read[1]


class Figures:
    """Columns of one number, or one row of them, per state, by name; NaN where a state has none."""

    def __init__(self) -> None:
        self._files: dict[str, RowFile] = {}

    def append(self, **columns: Float64) -> None:
        """Add the next states' (T,)."""
        for name, values in columns.items():
            self._files.setdefault(name, RowFile(values.shape[1:])).append(values)

    def __getitem__(self, name: str) -> Float64:
        """A whole column (T,)."""
        return self._files[name].read(0, len(self._files[name]))

    def rows(self, name: str) -> Rows:
        """A column (T,) that is read as it is asked for."""
        return Rows(self._files[name])

    def block(self, name: str, first: int, last: int) -> Float64:
        """Part of a column."""
        return self._files[name].read(first, last)


class StoredClearance:
    """As `Clearance`, a column read each time it is asked for."""

    def __init__(self, figures: Figures, name: str) -> None:
        self._figures, self._name = figures, name

    @property
    def distance(self) -> Float64:
        """(T,) [m]."""
        return self._figures[f"distance {self._name}"]

    @property
    def rows(self) -> Rows:
        """The distance (T,) [m], read as it is asked for."""
        return self._figures.rows(f"distance {self._name}")

    @property
    def sphere(self) -> NDArray[np.int64]:
        """(T,)."""
        return self._figures[f"sphere {self._name}"].astype(np.int64)


class StoredAudit:
    """As `AuditTrace`, in files: position is read by rows, the other columns each time they are asked for."""

    def __init__(self) -> None:
        self._stamps, self._figures = StampColumn(), Figures()
        self._position: RowFile | None = None
        self._names: tuple[str, ...] = ()

    def add(self, part: AuditTrace) -> None:
        """The next states."""
        if self._position is None:
            self._position, self._names = RowFile(part.position.shape[1:]), tuple(part.clearance)
        self._stamps.append(part.stamp_ns)
        self._position.append(part.position)
        for name, clearance in part.clearance.items():
            columns = {f"distance {name}": clearance.distance, f"sphere {name}": clearance.sphere.astype(np.float64)}
            self._figures.append(**columns)
        self._figures.append(
            limit_margin=part.limit_margin,
            limit_joint=part.limit_joint.astype(np.float64),
            self_clearance=part.self_clearance,
            self_pair=part.self_pair.astype(np.float64),
            unknown_share=part.unknown_share,
        )

    @property
    def stamp_ns(self) -> Stamps:
        """(T,)."""
        return self._stamps.all

    @property
    def position(self) -> Rows:
        """(T, J)."""
        assert self._position is not None
        return Rows(self._position)

    @property
    def clearance(self) -> Mapping[str, StoredClearance]:
        """By field name."""
        return {name: StoredClearance(self._figures, name) for name in self._names}

    @property
    def limit_margin(self) -> Float64:
        """(T,) [rad]."""
        return self._figures["limit_margin"]

    @property
    def self_clearance(self) -> Float64:
        """(T,) [m]."""
        return self._figures["self_clearance"]

    @property
    def unknown_share(self) -> Float64:
        """(T,)."""
        return self._figures["unknown_share"]

    def block(self, first: int, last: int) -> AuditTrace:
        """Some of the states."""

        def part(name: str) -> Float64:
            return self._figures.block(name, first, last)

        return AuditTrace(
            stamp_ns=self.stamp_ns[first:last],
            position=self.position[first:last],
            clearance={
                name: Clearance(distance=part(f"distance {name}"), sphere=part(f"sphere {name}").astype(np.int64))
                for name in self._names
            },
            limit_margin=part("limit_margin"),
            limit_joint=part("limit_joint").astype(np.int64),
            self_clearance=part("self_clearance"),
            self_pair=part("self_pair").astype(np.int64),
            unknown_share=part("unknown_share"),
        )


class StoredSteps:
    """Steps of a controller, None where it was not asked, with the figures (T,) that are asked for over all of them:
    clearance, residual, scale, rung (its number), refused, shaped, and shaped by each kind of row.
    """

    def __init__(self) -> None:
        self.stored: StoredObjects[ControlStep | None] = StoredObjects()
        self.figures = Figures()
        self._velocity: RowFile | None = None

    @property
    def velocity(self) -> Rows:
        """(T, J) [rad/s], NaN without a step."""
        assert self._velocity is not None
        return Rows(self._velocity)

    def extend(self, steps: Sequence[ControlStep | None], num_joints: int) -> None:
        """The next steps."""
        blank = np.full(num_joints, np.nan)
        self._velocity = self._velocity or RowFile((num_joints,))
        self._velocity.append(np.array([blank if step is None else step.velocity for step in steps]))
        self.stored.extend(steps)
        rows = np.full((6 + len(RowKind), len(steps)), np.nan)
        for i, step in enumerate(steps):
            if step is not None:
                rows[:6, i] = (
                    step.clearance,
                    step.residual,
                    step.scale,
                    RUNGS.index(step.rung),
                    step.num_refused,
                    is_shaped(step),
                )
                rows[6:, i] = [is_shaped(step, kind) for kind in RowKind]
        names = (
            "clearance",
            "residual",
            "scale",
            "rung",
            "refused",
            "shaped",
            *(f"shaped {kind}" for kind in RowKind),
        )
        self.figures.append(**dict(zip(names, rows, strict=True)))


class StoredLoop:
    """A `StepRecord` in files."""

    def __init__(self, num_joints: int) -> None:
        self.kept, self._num_joints = StoredSteps(), num_joints
        self._stamps, self._position = StampColumn(), RowFile((num_joints,))
        self._waiting: list[tuple[int, Float64, ControlStep]] = []

    @property
    def stamp_ns(self) -> Stamps:
        """(T,)."""
        self._flush()
        return self._stamps.all

    @property
    def position(self) -> Rows:
        """(T, J)."""
        self._flush()
        return Rows(self._position)

    @property
    def steps(self) -> Sequence[ControlStep]:
        """The steps; none is None."""
        self._flush()
        return self.kept.stored  # type: ignore[return-value]

    def add(self, stamp_ns: int, q: Float64, step: ControlStep) -> None:
        """The next step."""
        self._waiting.append((stamp_ns, q, step))
        if len(self._waiting) == BLOCK:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        stamps, positions, steps = zip(*self._waiting, strict=True)
        self._waiting = []
        self._stamps.append(np.array(stamps, dtype=np.int64))
        self._position.append(np.array(positions))
        self.kept.extend(steps, self._num_joints)


class StoredOpenLoop:
    """As `OpenLoopTrace`, in files; figures (T,): size and largest of the difference, and by how much the logged
    velocity keeps the tightest barrier row and limit.
    """

    def __init__(self) -> None:
        self.kept, self.figures = StoredSteps(), Figures()
        self.margins: StoredObjects[VelocityMargin | None] = StoredObjects()
        self._logged: RowFile | None = None
        self._difference: RowFile | None = None

    @property
    def steps(self) -> Sequence[ControlStep | None]:
        """None where the controller was not asked."""
        return self.kept.stored

    @property
    def logged(self) -> Rows:
        """(T, J) [rad/s]."""
        assert self._logged is not None
        return Rows(self._logged)

    @property
    def commanded(self) -> FloatRows:
        """(T, J) [rad/s], NaN where there is none."""
        return self.kept.velocity

    @property
    def difference(self) -> Rows:
        """(T, J) [rad/s] commanded less logged."""
        assert self._difference is not None
        return Rows(self._difference)

    def add(self, part: OpenLoopTrace) -> None:
        """The next states."""
        num_joints = part.logged.shape[1]
        self._logged = self._logged or RowFile((num_joints,))
        self._logged.append(part.logged)
        self._difference = self._difference or RowFile((num_joints,))
        self._difference.append(part.difference)
        self.kept.extend(part.steps, num_joints)
        self.margins.extend(part.margins)
        nothing = (np.nan, np.nan)
        room = np.array([nothing if m is None else (m.barrier, m.limit) for m in part.margins])
        self.figures.append(
            size=np.linalg.norm(part.difference, axis=1),
            largest=np.max(np.abs(part.difference), axis=1),
            barrier=room[:, 0],
            limit=room[:, 1],
        )

    def block(self, first: int, last: int) -> OpenLoopTrace:
        """Some of the states."""
        return OpenLoopTrace(
            logged=self.logged[first:last],
            commanded=np.asarray(self.commanded[first:last]),
            steps=tuple(self.steps[first:last]),
            margins=tuple(self.margins[first:last]),
        )

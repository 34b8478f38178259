"""States of a replay in files, read whole, singly, or by blocks."""

import pickle
import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar, overload

import numpy as np

from splatctrl_cli.control.audit import AuditTrace, Clearance
from splatctrl_cli.control.open_loop import OpenLoopTrace, is_shaped
from splatctrl_cli.control.qp import Rung
from splatctrl_cli.control.replay import StepRecord
from splatctrl_cli.control.step import ControlStep, VelocityMargin
from splatctrl_cli.control.terms import RowKind
from splatctrl_cli.files.spilled_rows import IN_MEMORY, RowFile, Rows, scratch_folder
from splatctrl_cli.records import Float64, Stamps

BLOCK = 1024  # states that are replayed at once
RUNGS = tuple(Rung)
STEP_FIGURES = (
    *("clearance", "residual", "scale", "rung", "refused", "shaped"),
    *(f"shaped {kind}" for kind in RowKind),
)
AUDITED = ("position", "limit_margin", "limit_joint", "self_clearance", "self_pair", "unknown_share")
T = TypeVar("T")


def join_stamps(parts: list[Stamps]) -> Stamps:
    """Stamps (T,) [ns] of blocks, which become one block in place."""
    if len(parts) != 1:
        parts[:] = [np.concatenate([np.zeros(0, dtype=np.int64), *parts])]
    return parts[0]


class StoredObjects(Sequence[T], Generic[T]):
    """Objects in an unnamed file, read by blocks."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY, dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._starts: list[int] = []  # first object of each block; `_places`: its file offset
        self._places: list[int] = []
        self._num = 0
        self._read: tuple[int, list[T]] = (-1, [])

    def extend(self, objects: Sequence[T]) -> None:
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
            return [self[i] for i in range(*index.indices(self._num))]
        at = index + (self._num if index < 0 else 0)
        if not 0 <= at < self._num:
            raise IndexError(f"{index} of {self._num}")
        number = int(np.searchsorted(self._starts, at, side="right")) - 1
        return self._block(number)[at - self._starts[number]]

    def _block(self, number: int) -> list[T]:
        if self._read[0] != number:
            self._file.seek(self._places[number])
            self._read = number, pickle.load(self._file)
        return self._read[1]


@dataclass(eq=False)
class Figures:
    """Named columns of a number or row per state; NaN without a value."""

    _files: dict[str, RowFile] = field(default_factory=dict)

    def append(self, **columns: Float64) -> None:
        for name, values in columns.items():
            self._files.setdefault(name, RowFile(values.shape[1:])).append(values)

    def __getitem__(self, name: str) -> Float64:
        """A whole column (T,)."""
        return self._files[name].read(0, len(self._files[name]))

    def rows(self, name: str) -> Rows:
        """Lazily read column (T,)."""
        return Rows(self._files[name])


class StoredAudit:
    """An `AuditTrace` in files; its clearances are distances alone, their spheres are in `figures`."""

    def __init__(self) -> None:
        self._stamps, self.figures = list[Stamps](), Figures()
        self._names: tuple[str, ...] = ()

    def add(self, part: AuditTrace) -> None:
        self._names = tuple(part.clearance)
        self._stamps.append(part.stamp_ns)
        for name, clearance in part.clearance.items():
            self.figures.append(
                **{f"distance {name}": clearance.distance, f"sphere {name}": clearance.sphere.astype(np.float64)}
            )
        self.figures.append(**{name: np.asarray(getattr(part, name), np.float64) for name in AUDITED})

    @property
    def stamp_ns(self) -> Stamps:
        """(T,)."""
        return join_stamps(self._stamps)

    @property
    def position(self) -> Rows:
        """(T, J)."""
        return self.figures.rows("position")

    @property
    def clearance(self) -> Mapping[str, Rows]:
        """Distances (T,) [m] by field."""
        return {name: self.figures.rows(f"distance {name}") for name in self._names}

    def block(self, first: int, last: int) -> AuditTrace:
        def part(name: str) -> Float64:
            return self.figures.rows(name)[first:last]

        return AuditTrace(
            stamp_ns=self.stamp_ns[first:last],
            clearance={
                name: Clearance(distance=part(f"distance {name}"), sphere=part(f"sphere {name}").astype(np.int64))
                for name in self._names
            },
            limit_joint=part("limit_joint").astype(np.int64),
            self_pair=part("self_pair").astype(np.int64),
            position=part("position"),
            limit_margin=part("limit_margin"),
            self_clearance=part("self_clearance"),
            unknown_share=part("unknown_share"),
        )


@dataclass(eq=False)
class StoredSteps:
    """Steps of a controller, None where it had none, with `STEP_FIGURES` (T,) over all.

    Also the velocity (T, J) [rad/s], NaN without a step.
    """

    stored: StoredObjects[ControlStep | None] = field(default_factory=StoredObjects)
    figures: Figures = field(default_factory=Figures)

    def extend(self, steps: Sequence[ControlStep | None], num_joints: int) -> None:
        blank = np.full(num_joints, np.nan)
        self.stored.extend(steps)
        rows = np.array([(np.nan,) * len(STEP_FIGURES) if step is None else _figures_of(step) for step in steps])
        self.figures.append(
            velocity=np.array([blank if step is None else step.velocity for step in steps]),
            **dict(zip(STEP_FIGURES, rows.T, strict=True)),
        )


def _figures_of(step: ControlStep) -> tuple[float, ...]:
    shaped: tuple[float, ...] = (is_shaped(step), *(is_shaped(step, kind) for kind in RowKind))
    if step.rung is Rung.OUTSIDE:
        shaped = (np.nan,) * len(shaped)
    return (step.clearance, step.residual, step.scale, RUNGS.index(step.rung), step.num_refused, *shaped)


class StoredLoop(StepRecord):
    """Steps in files."""

    def __init__(self, num_joints: int) -> None:
        self.kept, self._num_joints = StoredSteps(), num_joints
        self._stamps, self._position = list[Stamps](), RowFile((num_joints,))
        self._waiting: list[tuple[int, Float64, ControlStep]] = []

    @property
    def stamp_ns(self) -> Stamps:
        """(T,)."""
        self._flush()
        return join_stamps(self._stamps)

    @property
    def position(self) -> Rows:
        """(T, J)."""
        self._flush()
        return Rows(self._position)

    @property
    def steps(self) -> Sequence[ControlStep]:
        self._flush()
        return self.kept.stored  # type: ignore[return-value]

    def add(self, stamp_ns: int, q: Float64, step: ControlStep) -> None:
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
    """An `OpenLoopTrace` in files.

    figures (T,): size and largest of the difference; the logged velocity's slack to barrier and limit. Also logged
    and difference (commanded less logged) (T, J) [rad/s].
    """

    def __init__(self) -> None:
        self.kept, self.figures = StoredSteps(), Figures()
        self.margins: StoredObjects[VelocityMargin | None] = StoredObjects()
        self.steps: Sequence[ControlStep | None] = self.kept.stored  # None where the controller did not run

    def add(self, part: OpenLoopTrace) -> None:
        self.kept.extend(part.steps, part.logged.shape[1])
        self.margins.extend(part.margins)
        room = np.array([(np.nan, np.nan) if m is None else (m.barrier, m.limit) for m in part.margins])
        self.figures.append(
            logged=part.logged,
            difference=part.difference,
            size=np.linalg.norm(part.difference, axis=1),
            largest=np.max(np.abs(part.difference), axis=1),
            barrier=room[:, 0],
            limit=room[:, 1],
        )

    def block(self, first: int, last: int) -> OpenLoopTrace:
        return OpenLoopTrace(
            logged=self.figures.rows("logged")[first:last],
            commanded=self.kept.figures.rows("velocity")[first:last],
            steps=tuple(self.steps[first:last]),
            margins=tuple(self.margins[first:last]),
        )

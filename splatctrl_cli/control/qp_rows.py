"""Every row at a configuration, and which of them the program needs: the terms' rows, one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.arm import ArmModel
from splatctrl_cli.control.barriers import SceneRows, SelfRows, can_bind, is_immovable
from splatctrl_cli.control.terms import Barrier, BarrierTerm, State
from splatctrl_cli.records import Bool, DistanceField, Float64


@dataclass(frozen=True, kw_only=True)
class Rows:
    """The rows at one configuration (M, one barrier of each term), and which of them the QP needs.

    The first barrier is that of the moving spheres, the second that of the pairs. margin (M,) [m]; is_fixed: no joint
    velocity changes it; in_qp: not fixed, and some velocity of the box violates it. cuts: further rows of the QP
    against what a solution would have met (`RowBuilder.cut`); their index is the place of the row they belong to.
    """

    barriers: tuple[Barrier, ...]
    margin: Float64
    is_fixed: Bool
    in_qp: Bool
    cuts: Barrier | None = None

    @property
    def external(self) -> Barrier:
        return self.barriers[0]

    @property
    def own(self) -> Barrier:
        return self.barriers[1]

    @property
    def distance(self) -> Float64:
        return np.concatenate([barrier.distance for barrier in self.barriers])

    @property
    def h(self) -> Float64:
        return np.concatenate([barrier.h for barrier in self.barriers])

    @property
    def for_qp(self) -> tuple[Barrier, ...]:
        ends = np.cumsum([len(barrier) for barrier in self.barriers])[:-1]
        parts = np.split(self.in_qp, ends)
        rows = tuple(barrier.select(part) for barrier, part in zip(self.barriers, parts, strict=True))
        return rows if self.cuts is None else (*rows, self.cuts)

    def spread(self, values: Float64) -> Float64:
        """Values of the QP's rows as values (M,) of all rows, zero elsewhere; a row's is the largest of its cuts'."""
        everywhere, num_rows = np.zeros(len(self.in_qp)), int(self.in_qp.sum())
        everywhere[self.in_qp] = values[:num_rows]
        if self.cuts is not None:
            np.maximum.at(everywhere, self.cuts.index, values[num_rows:])
        return everywhere


class RowBuilder:
    """Builds the rows of an arm in a distance field; names and kinds (M,) say what a row guards."""

    def __init__(
        self,
        model: ArmModel,
        config: ControlConfig,
        field: DistanceField,
        acceleration: Float64 | None = None,
        further: Sequence[BarrierTerm] = (),
    ) -> None:
        """acceleration (J,) [rad/s^2]: what joints can brake with; None: they stop at once."""
        self._model, self._acceleration = model, acceleration
        self._scene = SceneRows(model, config, field, acceleration)
        self._others: tuple[BarrierTerm, ...] = (SelfRows(model, config, acceleration), *further)
        self._margin = np.concatenate([term.margin for term in self._terms])
        self.names = tuple(name for term in self._terms for name in term.names)
        self.kinds = tuple(term.kind for term in self._terms for _ in term.names)

    @property
    def _terms(self) -> tuple[BarrierTerm, ...]:
        return (self._scene, *self._others)

    @property
    def num_external(self) -> int:
        """Rows against the scene; they come first."""
        return len(self._scene.names)

    def with_field(self, field: DistanceField) -> "RowBuilder":
        """The same rows in another field."""
        other = object.__new__(RowBuilder)
        other.__dict__.update(self.__dict__, _scene=self._scene.in_field(field))
        return other

    def at(self, state: State) -> Rows:
        """Every row at a state."""
        barriers = tuple(term.rows(state) for term in self._terms)
        is_fixed = np.concatenate([is_immovable(b.G, self._model.velocity_limit) for b in barriers])
        binds = np.concatenate([can_bind(b.G, b.h, *state.box) for b in barriers])
        return Rows(barriers=barriers, margin=self._margin, is_fixed=is_fixed, in_qp=binds & ~is_fixed)

    def cut(self, rows: Rows, state: State, velocity: Float64, chosen: NDArray[np.integer]) -> Rows:
        """The rows with one more for each of the `chosen` rows against the scene (`SceneRows.cut`)."""
        cut = self._scene.cut(state, velocity, chosen, rows.external.distance)
        return replace(rows, cuts=cut if rows.cuts is None else rows.cuts.joined(cut))

    def room(self, state: State, velocity: Float64) -> Float64:
        """``h - G v`` (M,) [m/s] of every row at a state for a velocity (J,)."""
        if self._acceleration is None:
            return np.concatenate([term.room(state, velocity) for term in self._terms])
        rows = [term.rows(state) for term in self._terms]
        return np.concatenate([b.h for b in rows]) - np.concatenate([b.G for b in rows]) @ velocity

    def distances(self, q: Float64) -> Float64:
        """Every row's distance (M,) [m] at q."""
        centers = self._model.sphere_centers(q)
        return np.concatenate([term.distances(centers) for term in self._terms])

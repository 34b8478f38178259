"""Rows of all terms at a configuration, the QP's subset, and III-E as printed.

III-E: ``min over (v, x, e) (u - x)' Q (u - x) + (x - J v)' R (x - J v) + e' S e``. x is the end-effector velocity,
``x - J v`` the paper's delta_x; e has one slack of either sign per external row.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.barriers import SceneRows, SelfRows, can_bind
from splatctrl_cli.control.qp import Choice, QpSolver, QuadraticProgram, Rung, is_usable, stand_still
from splatctrl_cli.control.terms import NO_SPHERE, Barrier, BarrierTerm, Cost, State, box_rows, configured_weights
from splatctrl_cli.records import Bool, DistanceField, Float64, Integers
from splatctrl_cli.robot.model import RobotModel


@dataclass(frozen=True, kw_only=True)
class Rows:
    """All M rows at one configuration, and the subset that the QP needs.

    barriers: one per term, first moving spheres, then pairs. margin (M,) [m]. is_fixed: no joint velocity changes the
    row. in_qp: it is not fixed, and some velocity of the box violates it. cuts: further QP rows (`RowBuilder.cut`),
    each with its scene row's index.
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
        parts = np.split(self.in_qp, np.cumsum([len(barrier) for barrier in self.barriers])[:-1])
        rows = tuple(barrier.select(part) for barrier, part in zip(self.barriers, parts, strict=True))
        return rows if self.cuts is None else (*rows, self.cuts)

    def spread(self, values: Float64) -> Float64:
        """Values of all rows (M,): zero outside the QP, the largest where a row has cuts."""
        everywhere, num_rows = np.zeros(len(self.in_qp)), int(self.in_qp.sum())
        everywhere[self.in_qp] = values[:num_rows]
        if self.cuts is not None:
            np.maximum.at(everywhere, self.cuts.index, values[num_rows:])
        return everywhere


class RowBuilder:
    """Builds an arm's rows in a distance field; names, kinds (M,); scene: its `SceneRows`."""

    def __init__(
        self,
        model: RobotModel,
        config: ControlConfig,
        field: DistanceField,
        acceleration: Float64 | None = None,
        further: Sequence[BarrierTerm] = (),
    ) -> None:
        """acceleration: as for `SceneRows`."""
        self._model, self._acceleration = model, acceleration
        self.scene = SceneRows(model, config, field, acceleration)
        self._others: tuple[BarrierTerm, ...] = (SelfRows(model, config, acceleration), *further)
        self._margin = np.concatenate([term.margin for term in self._terms])
        self.names = tuple(name for term in self._terms for name in term.names)
        self.kinds = tuple(term.kind for term in self._terms for _ in term.names)

    @property
    def _terms(self) -> tuple[BarrierTerm, ...]:
        return (self.scene, *self._others)

    def replace_field(self, field: DistanceField, balls: BallDistance | None) -> "RowBuilder":
        """Rows in another field (`SceneRows.replace_field`)."""
        other = copy(self)
        other.scene = self.scene.replace_field(field, balls)
        return other

    def at(self, state: State) -> Rows:
        barriers = tuple(term.rows(state) for term in self._terms)
        # Rows that no joint velocity changes: of fixed spheres, or in a flat field.
        is_fixed = np.concatenate([np.abs(b.G) @ self._model.velocity_limit < fixed.IMMOVABLE_ROW for b in barriers])
        binds = np.concatenate([can_bind(b.G, b.h, *state.box) for b in barriers])
        return Rows(barriers=barriers, margin=self._margin, is_fixed=is_fixed, in_qp=binds & ~is_fixed)

    def cut(self, rows: Rows, state: State, velocity: Float64, chosen: Integers) -> Rows:
        """Rows with a cut per `chosen` scene row (`SceneRows.cut`)."""
        cut = self.scene.cut(state, velocity, chosen, rows.external.distance)
        return replace(rows, cuts=cut if rows.cuts is None else rows.cuts.joined(cut))

    def room(self, state: State, velocity: Float64) -> Float64:
        """``h - G v`` (M,) [m/s] of every row for a velocity (J,)."""
        if self._acceleration is None:
            return np.concatenate([term.room(state, velocity) for term in self._terms])
        rows = [term.rows(state) for term in self._terms]
        return np.concatenate([b.h for b in rows]) - np.concatenate([b.G for b in rows]) @ velocity

    def distances(self, q: Float64, by_surface: Bool = NO_SPHERE) -> Float64:
        """Every row's distance (M,) [m] at q; by_surface as in `State`."""
        centers = self._model.sphere_centers(q)
        scene = self.scene.raise_by_surfaces(q, self.scene.distances(centers), by_surface)
        return np.concatenate([scene, *(term.distances(centers) for term in self._others)])


PRINTED = "printed"


def assemble_printed(
    state: State, weights: tuple[Float64, Float64], posture: Cost, external: Barrier, firm: Sequence[Barrier]
) -> QuadraticProgram:
    """Program of III-E as printed, over ``z = (v, x, e)``.

    Rows: upper, lower box limits (2 J), external (M), firm. An external row is ``grad d v >= -(d - epsilon) + e``;
    other rows have no slack. weights: diagonals (6,) of Q and R; posture: "home pose bias" of III-E, which determines
    all seven joints.
    """
    J, M = len(state.q), len(external)
    v, x, e = slice(0, J), slice(J, J + 6), slice(J + 6, J + 6 + M)
    H, c = np.zeros((J + 6 + M, J + 6 + M)), np.zeros(J + 6 + M)
    Q, R, A = np.diag(weights[0]), np.diag(weights[1]), state.jacobian
    H[v, v] = 2.0 * A.T @ R @ A + posture[0]
    H[v, x] = -2.0 * A.T @ R
    H[x, v] = H[v, x].T
    H[x, x] = 2.0 * (Q + R)
    H[e, e] = 2.0 * external.slack_weight * np.eye(M)
    c[v], c[x] = posture[1], -2.0 * Q @ state.reference
    num_rows = 2 * J + M + sum(len(rows) for rows in firm)
    G, h = np.zeros((num_rows, len(c))), np.zeros(num_rows)
    G[: 2 * J, v], h[: 2 * J] = box_rows(*state.box)
    rows, last = slice(2 * J, 2 * J + M), slice(2 * J + M, None)
    G[rows, v], G[rows, e], h[rows] = external.G, np.eye(M), external.h
    if firm:
        G[last, v], h[last] = np.concatenate([b.G for b in firm]), np.concatenate([b.h for b in firm])
    return QuadraticProgram(H=H, c=c, G=G, h=h)


def solve_printed(
    solver: QpSolver, state: State, posture: Cost, barriers: Sequence[Barrier], config: ControlConfig
) -> Choice:
    """The printed program's answer if solved and checked, else standstill.

    The paper has no second rung. slack is ``max(-e, 0)``; a positive e tightens its row.
    """
    external, *firm = barriers
    J, M, num_firm = len(state.q), len(external), sum(len(rows) for rows in firm)
    solution = solver(assemble_printed(state, configured_weights(config), posture, external, firm))
    if not is_usable(solution, config.max_residual):
        return stand_still(J, M + num_firm, solution, num_refused=1)
    slack = np.concatenate([np.maximum(-solution.z[J + 6 :], 0.0), np.zeros(num_firm)])
    return Choice(
        velocity=solution.z[:J],
        rung=Rung.RELAXED if np.any(slack > config.slack_tolerance) else Rung.SOLVED,
        slack=slack,
        box_multipliers=solution.multipliers[: 2 * J],
        row_multipliers=solution.multipliers[2 * J :],
        solution=solution,
        num_refused=0,
    )

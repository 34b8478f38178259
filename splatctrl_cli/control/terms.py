"""Terms of the QP of III-E over joint velocities; the solver adds them.

A further term is a function from state to cost ``(H, c)``, or a `BarrierTerm` with rows ``G v - s <= h``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property, partial

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.goals import Guide
from splatctrl_cli.records import Bool, Columns, Float64, Integers
from splatctrl_cli.robot.model import RobotModel

Cost = tuple[Float64, Float64]
"""H (J, J) and c (J,) of a cost ``1/2 v' H v + c' v`` over joint velocities v (J,)."""

NO_SPHERE: Bool = np.zeros(1, dtype=np.bool_)  # among the moving spheres


@dataclass(frozen=True, kw_only=True)
class State:
    """A step's state, as terms see it.

    q (J,) [rad]; box: allowed velocities (J,), (J,) [rad/s]; reference (6,) [m/s, rad/s] of `frame`; guide: the
    goal's motion (None: at rest); last_velocity (J,) [rad/s] (None: unknown); distance_rate: dd/dt [m/s] of the
    moving spheres, (M,) or one number; by_surface (M,): spheres that count by their link's surface.
    """

    model: RobotModel
    frame: str
    q: Float64
    box: tuple[Float64, Float64]
    reference: Float64 = field(default_factory=lambda: np.zeros(6))
    guide: Guide | None = None
    last_velocity: Float64 | None = None
    distance_rate: float | Float64 = 0.0
    by_surface: Bool = field(default_factory=lambda: NO_SPHERE)

    @cached_property
    def jacobian(self) -> Float64:
        """(6, J) of the frame."""
        return self.model.frame_jacobian(self.q, self.frame)

    @cached_property
    def spheres(self) -> tuple[Float64, Float64]:
        """Centres (S, 3) [m], Jacobians (S, 3, J)."""
        return self.model.spheres_at(self.q)


CostTerm = Callable[[State], Cost]
"""A cost over joint velocities at a state."""


def lean_home(state: State, *, home: Float64, gain: float, weight: float) -> Cost:
    """Home bias of III-E, which makes a redundant arm's QP strictly convex.

    It leads to home (J,) [rad], or to the guide's posture and motion.
    """
    if state.guide is None:
        return stray_cost(gain * (home - state.q), weight)
    return stray_cost(gain * (state.guide.posture - state.q) + state.guide.velocity, weight)


def change_little(state: State, *, weight: float) -> Cost:
    """Smoothness: a cost of change from the last velocity, if known."""
    if state.last_velocity is None:
        return stray_cost(np.zeros(len(state.q)), 0.0)
    return stray_cost(state.last_velocity, weight)


def standard_costs(config: ControlConfig, home: Float64) -> tuple[CostTerm, ...]:
    lean = partial(lean_home, home=home, gain=config.posture_gain, weight=config.posture_weight)
    smooth = partial(change_little, weight=config.smoothness_weight)
    return (lean, smooth) if config.smoothness_weight > 0 else (lean,)


def configured_weights(config: ControlConfig) -> tuple[Float64, Float64]:
    """Diagonals (6,) of Q and R."""
    Q = np.repeat([config.weight_linear, config.weight_angular], 3)
    return Q, config.weight_kinematics * Q


def eliminated_weight(weight_task: Float64, weight_kinematics: Float64) -> Float64:
    """III-E's weight (6,) after elimination of end-effector velocity and slack.

    ``min over d of (e - d)' Q (e - d) + d' R d`` is ``e' W e`` with ``W = (Q^-1 + R^-1)^-1``; Q, R diagonal (6,).
    """
    return np.asarray(1.0 / (1.0 / weight_task + 1.0 / weight_kinematics))


def reach_cost(jacobian: Float64, velocity: Float64, weight: Float64) -> Cost:
    """Cost ``(u - J v)' W (u - J v)`` of missing velocity u: first two terms of III-E.

    jacobian (6, J); u (6,) [m/s, rad/s], world; weight (6,): diagonal of W.
    """
    weighted = jacobian.T * weight
    return 2.0 * weighted @ jacobian, -2.0 * weighted @ velocity


def stray_cost(velocity: Float64, weight: float) -> Cost:
    """Cost ``weight |v - velocity|^2`` of leaving a joint velocity (J,) [rad/s]."""
    return 2.0 * weight * np.eye(len(velocity)), -2.0 * weight * velocity


def sum_costs(costs: Sequence[Cost]) -> Cost:
    H, c = np.zeros_like(costs[0][0]), np.zeros_like(costs[0][1])
    for cost_H, cost_c in costs:
        H += cost_H
        c += cost_c
    return H, c


class RowKind(StrEnum):
    """Object that a row guards."""

    LIMIT = "limit"
    SCENE = "scene"
    SELF = "self"


@dataclass(frozen=True, kw_only=True)
class Barrier(Columns):
    """M barrier rows ``G v - s <= h``, with ``G = -dd/dq`` (M, J).

    ``h = alpha (d - epsilon) + dd/dt`` (M,), less where joints cannot stop at once (`barriers.distance_bound`);
    distance d (M,) [m]; index (M,): among names (spheres, or pairs). Slack costs ``slack_cost * s + slack_weight *
    s^2`` per row [s in m/s].
    """

    index: Integers
    G: Float64
    h: Float64
    distance: Float64
    slack_cost: float
    slack_weight: float


class BarrierTerm(ABC):
    """M named rows that bound the velocity.

    A term without a distance defines `rows` alone: infinite distance exempts it from step checks.
    """

    kind = RowKind.LIMIT
    names: tuple[str, ...]

    @cached_property
    def margin(self) -> Float64:
        """Margins (M,) [m]."""
        return np.zeros(len(self.names))

    @abstractmethod
    def rows(self, state: State) -> Barrier:
        """Every row, in the order of the names."""

    def room(self, state: State, velocity: Float64) -> Float64:
        """``h - G v`` (M,) [m/s] of a velocity (J,)."""
        rows = self.rows(state)
        return np.asarray(rows.h - rows.G @ velocity)

    def distances(self, centers: Float64) -> Float64:
        """Distances (M,) [m] for sphere centers (S, 3), NaN if unknown."""
        return np.full(len(self.names), np.inf)

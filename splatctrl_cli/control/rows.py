"""Every barrier row of III-E at a configuration: one for each moving sphere, then one for each pair of spheres."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control import barriers
from splatctrl_cli.control.arm import ArmModel, sphere_names
from splatctrl_cli.control.barriers import Barrier
from splatctrl_cli.control.limits import braking_speed
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.records import Bool, DistanceField, Float64

MARGIN = "margin"
BRAKING_SHARE = (
    0.5  # of the deceleration that a row could have alone; 1 lost up to 6 mm where several rows brake at once
)


@dataclass(frozen=True, kw_only=True)
class Rows:
    """The rows at one configuration (M, external then self), and which of them the QP needs.

    margin (M,) [m]; is_fixed: no joint velocity changes it; in_qp: not fixed, and some velocity of the box violates
    it. cuts: further rows of the program, against what a solution would have met (`RowBuilder.cut`); their index is
    the place of the row that they belong to.
    """

    external: Barrier
    own: Barrier
    margin: Float64
    is_fixed: Bool
    in_qp: Bool
    cuts: Barrier | None = None

    @property
    def distance(self) -> Float64:
        return np.concatenate([self.external.distance, self.own.distance])

    @property
    def h(self) -> Float64:
        return np.concatenate([self.external.h, self.own.h])

    @property
    def for_qp(self) -> tuple[Barrier, ...]:
        num_external = len(self.external)
        rows = self.external.select(self.in_qp[:num_external]), self.own.select(self.in_qp[num_external:])
        return rows if self.cuts is None else (*rows, self.cuts)

    def spread(self, values: Float64) -> Float64:
        """Values of the QP's rows as values (M,) of all rows, zero elsewhere; a row's is the largest of its cuts'."""
        everywhere, num_rows = np.zeros(len(self.in_qp)), int(self.in_qp.sum())
        everywhere[self.in_qp] = values[:num_rows]
        if self.cuts is not None:
            np.maximum.at(everywhere, self.cuts.index, values[num_rows:])
        return everywhere


class RowBuilder:
    """Builds the rows of an arm in a distance field; names (M,) say which sphere or pair a row guards."""

    def __init__(
        self, model: ArmModel, config: ControlConfig, field: DistanceField, acceleration: Float64 | None = None
    ) -> None:
        """acceleration (J,) [rad/s^2]: what joints can brake with; None: they stop at once."""
        self._model, self._config, self._field = model, config, field
        self._acceleration = acceleration
        self._moving = np.flatnonzero(model.moving_spheres)
        self._radii = np.asarray(model.sphere_set.radii, dtype=np.float64)
        self._pairs = np.asarray(model.self_pairs(), dtype=np.int64).reshape(-1, 2)
        own_margin = np.full(len(self._pairs), config.self_margin)
        self._margin = np.concatenate([scene_margin(model, config)[self._moving], own_margin])
        self.names = _row_names(sphere_names(model.sphere_set), self._moving, self._pairs)

    @property
    def num_external(self) -> int:
        """Rows against the scene; they come first."""
        return len(self._moving)

    def with_field(self, field: DistanceField) -> "RowBuilder":
        """The same rows in another field."""
        other = object.__new__(RowBuilder)
        other.__dict__.update(self.__dict__, _field=field)
        return other

    def at(self, q: Float64, box: tuple[Float64, Float64], distance_rate: float | Float64) -> Rows:
        """Every barrier row at q: gradient and distance come from one query of one function."""
        config = self._config
        centers, jacobians = self._model.spheres_at(q)
        distance, gradient = self._queried(centers)
        between, direction = barriers.pair_distance(centers, self._radii, self._pairs)
        G = -barriers.external_gradient(gradient, jacobians[self._moving])
        external = Barrier(
            index=self._moving,
            G=G,
            h=self._bound(distance, self._margin[: self.num_external], G, distance_rate),
            distance=distance,
            slack_cost=config.slack_cost,
            slack_weight=config.weight_slack,
        )
        own_G, own_h = self._pair_rows(between, direction, jacobians, box)
        own = Barrier(
            index=np.arange(len(self._pairs)),
            G=own_G,
            h=own_h,
            distance=between,
            slack_cost=config.self_slack_cost,
            slack_weight=config.weight_slack,
        )
        both = (external, own)
        is_fixed = np.concatenate([barriers.is_immovable(b.G, self._model.velocity_limit) for b in both])
        can_bind = np.concatenate([barriers.can_bind(b.G, b.h, *box) for b in both])
        return Rows(external=external, own=own, margin=self._margin, is_fixed=is_fixed, in_qp=can_bind & ~is_fixed)

    def cut(
        self,
        rows: Rows,
        q: Float64,
        velocity: Float64,
        chosen: NDArray[np.integer],
        distance_rate: float | Float64,
    ) -> Rows:
        """The rows at q with one more for each of the `chosen` rows of moving spheres: against what it is nearest to
        after a period of `velocity` (J,), which need not be what it is nearest to now.

        That surface's distance is taken as linear about the place where it was met. Where it is convex seen from
        there, as a ball is, it is farther than that in truth; and now it is no nearer than what is nearest now.
        """
        period = self._config.period
        later = q + period * velocity
        centers, jacobians = self._model.spheres_at(later)
        spheres = self._moving[chosen]
        distance, gradient = self._field.query(np.ascontiguousarray(centers[spheres]))
        G = -barriers.external_gradient(gradient, jacobians[spheres])
        now = np.maximum(distance - self._radii[spheres] + period * (G @ velocity), rows.external.distance[chosen])
        rate = np.broadcast_to(distance_rate, self.num_external)[chosen]
        cut = Barrier(
            index=chosen,
            G=G,
            h=self._bound(now, self._margin[chosen], G) + rate,
            distance=now,
            slack_cost=rows.external.slack_cost,
            slack_weight=rows.external.slack_weight,
        )
        return replace(rows, cuts=cut if rows.cuts is None else rows.cuts.joined(cut))

    def room(self, q: Float64, velocity: Float64, distance_rate: float | Float64) -> Float64:
        """``h - G v`` (M,) [m/s] of every row at q for a velocity (J,)."""
        if self._acceleration is not None:
            rows = self.at(q, (velocity, velocity), distance_rate)
            return np.asarray(rows.h - np.concatenate([rows.external.G, rows.own.G]) @ velocity)
        centers, jacobians = self._model.spheres_at(q)
        distance, gradient = self._queried(centers)
        between, direction = barriers.pair_distance(centers, self._radii, self._pairs)
        motion = jacobians @ velocity
        apart = motion[self._pairs[:, 0]] - motion[self._pairs[:, 1]]
        approach = [np.sum(gradient * motion[self._moving], axis=1), np.sum(direction * apart, axis=1)]
        rate = np.zeros(len(self.names))
        rate[: self.num_external] = distance_rate
        h = self._bound(np.concatenate([distance, between]), self._margin, None) + rate
        return np.asarray(h + np.concatenate(approach))

    def distances(self, q: Float64) -> Float64:
        """Every row's distance (M,) [m] at q; NaN where the field has none, which keeps no promise."""
        centers = self._model.sphere_centers(q)
        distance = self._field.query(np.ascontiguousarray(centers[self._moving]))[0] - self._radii[self._moving]
        return np.concatenate([distance, barriers.pair_distance(centers, self._radii, self._pairs)[0]])

    def _bound(
        self, distance: Float64, margin: Float64, G: Float64 | None, distance_rate: float | Float64 = 0.0
    ) -> Float64:
        """h (M,) of rows G (M, J), which counts only where joints cannot stop at once: then with the way that braking
        takes.

        A row's approach G v can be braked by at most ``|G| a``; BRAKING_SHARE of it is counted on, for it changes on
        the way and other rows want their part.
        """
        config = self._config
        if self._acceleration is None or G is None:
            bound = barriers.barrier_bound(distance, margin=margin, gain=config.barrier_gain)
        else:
            deceleration = BRAKING_SHARE * (np.abs(G) @ self._acceleration)
            bound = braking_speed(distance - margin, config.barrier_gain, deceleration, config.period)
        return np.asarray(bound + distance_rate)

    def _pair_rows(
        self, distance: Float64, direction: Float64, jacobians: Float64, box: tuple[Float64, Float64]
    ) -> tuple[Float64, Float64]:
        """G (P, J) and h (P,) of the pairs. Without a limit to braking G is zero for those whose spheres are too slow
        to use up h, which no velocity of the box brings to bind.
        """
        margin = self._margin[self.num_external :]
        if self._acceleration is not None:
            G = -barriers.pair_gradient(direction, jacobians, self._pairs)
            return G, self._bound(distance, margin, G)
        G = np.zeros((len(distance), jacobians.shape[2]))
        h = self._bound(distance, margin, G)
        speed = barriers.fastest_spheres(jacobians, *box)
        near = np.flatnonzero(h <= speed[self._pairs[:, 0]] + speed[self._pairs[:, 1]])
        G[near] = -barriers.pair_gradient(direction[near], jacobians, self._pairs[near])
        return G, h

    def _queried(self, centers: Float64) -> tuple[Float64, Float64]:
        """Distance (M,) of the moving spheres' surfaces and the field's gradient (M, 3) at their centres."""
        points = np.ascontiguousarray(centers[self._moving])
        distance, gradient = self._field.query(points)
        bad = ~(np.isfinite(distance) & np.all(np.isfinite(gradient), axis=1))
        if np.any(bad):
            first = int(np.argmax(bad))
            where = ", ".join(f"{v:.3f}" for v in points[first])
            raise NotEvaluableError(
                f"sphere {self.names[first]} at ({where}) m: the field has no distance there",
                remedy="bake a field that covers the robot's reach",
            )
        return distance - self._radii[self._moving], gradient


def scene_margin(model: ArmModel, config: ControlConfig) -> Float64:
    """The distance (S,) [m] that every sphere keeps to the scene: epsilon, and where `config.coverage` is "margin"
    also what the spheres leave uncovered of their body.

    A point of the surface is no farther than that deficit from a sphere, so by the triangle inequality the surface
    keeps epsilon where the spheres keep this, of any distance that changes by no more than a metre per metre.
    """
    deficit = np.asarray(model.sphere_deficit) if config.coverage == MARGIN else np.zeros(len(model.moving_spheres))
    return config.margin + deficit


def _row_names(spheres: tuple[str, ...], moving: NDArray[np.integer], pairs: NDArray[np.integer]) -> tuple[str, ...]:
    """Names of the barrier rows: moving spheres, then pairs."""
    return tuple(spheres[s] for s in moving) + tuple(f"{spheres[a]}~{spheres[b]}" for a, b in pairs)

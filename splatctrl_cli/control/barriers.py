"""Barrier rows of III-E: moving spheres against scene and people, pairs of spheres; rates dd/dt."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.terms import Barrier, BarrierTerm, RowKind, State, braking_speed
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.kernels.chain import pair_gaps
from splatctrl_cli.records import Bool, DistanceField, Float64, Integers
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import sphere_names

MARGIN = "margin"


class SceneRows(BarrierTerm):
    """A row per moving sphere against a distance field's nearest surface.

    Spheres in `State.by_surface` take their link's surface distance where that is larger.
    """

    kind = RowKind.SCENE

    def __init__(
        self, model: RobotModel, config: ControlConfig, field: DistanceField, acceleration: Float64 | None
    ) -> None:
        """acceleration (J,) [rad/s^2]: of braking; None: joints stop at once."""
        self._model, self._config, self._field, self._acceleration = model, config, field, acceleration
        self._balls: BallDistance | None = None
        self._moving = np.flatnonzero(model.moving_spheres)
        self._radii = np.asarray(model.sphere_set.radii, dtype=np.float64)[self._moving]
        self.margin = scene_margin(model, config)[self._moving]
        names = sphere_names(model.sphere_set)
        self.names = tuple(names[s] for s in self._moving)
        self._links = np.array(model.sphere_set.links)[self._moving]

    def replace_field(self, field: DistanceField, balls: BallDistance | None) -> "SceneRows":
        """Rows in another field, whose scene is `balls` (None: links' surfaces do not count)."""
        other = copy(self)
        other._field, other._balls = field, balls
        return other

    def raise_by_surfaces(self, q: Float64, distance: Float64, chosen: Bool, G: Float64 | None = None) -> Float64:
        """Distances (M,) [m], those of `chosen` (M,) spheres raised to their link's surface gap.

        Rows G (M, J) of raised spheres become minus the gap's gradient, in place.
        """
        if self._balls is None or not chosen.any():
            return distance
        postures = q[None] if G is None else q + fixed.SURFACE_STEP * np.eye(len(q) + 1, len(q), -1)
        links = set(self._links[chosen].tolist())
        for link, gap in self._model.surface_gaps(postures, self._balls.centers, self._balls.radii, links).items():
            raised = gap[0] + self.margin - self._config.margin
            is_raised = chosen & (self._links == link) & (raised > distance)
            distance = np.where(is_raised, raised, distance)
            if G is not None:
                G[is_raised] = (gap[0] - gap[1:]) / fixed.SURFACE_STEP
        return distance

    def rows(self, state: State) -> Barrier:
        centers, jacobians = state.spheres
        distance, gradient = self._query(centers)
        G = -external_gradient(gradient, jacobians[self._moving])
        distance = self.raise_by_surfaces(state.q, distance, state.by_surface, G)
        h = distance_bound(self._config, self._acceleration, distance, self.margin, G, state.distance_rate)
        return self._barrier(self._moving, G, h, distance)

    def cut(self, state: State, velocity: Float64, chosen: Integers, distance: Float64) -> Barrier:
        """Rows of `chosen` spheres against their nearest surfaces after a period of `velocity` (J,).

        The distance is linearised at the period's end: conservative for a surface convex as seen from there, such as
        a ball. At the state, it counts as at least the present `distance` (M,).
        """
        period = self._config.period
        q = state.q + period * velocity
        centers, jacobians = state.model.spheres_at(q)
        later, gradient = self._field.query(np.ascontiguousarray(centers[self._moving]))
        G = -external_gradient(gradient, jacobians[self._moving])
        later = self.raise_by_surfaces(q, later - self._radii, state.by_surface, G)
        now, G = np.maximum(later + period * (G @ velocity), distance)[chosen], G[chosen]
        rate = np.broadcast_to(state.distance_rate, len(self.names))[chosen]
        h = distance_bound(self._config, self._acceleration, now, self.margin[chosen], G, rate)
        return self._barrier(chosen, G, h, now)

    def distances(self, centers: Float64) -> Float64:
        """Distances (M,) [m]; NaN where unknown, which fails a step's check."""
        return self._field.query(np.ascontiguousarray(centers[self._moving]))[0] - self._radii

    def _barrier(self, index: Integers, G: Float64, h: Float64, distance: Float64) -> Barrier:
        cost, weight = self._config.slack_cost, self._config.weight_slack
        return Barrier(index=index, G=G, h=h, distance=distance, slack_cost=cost, slack_weight=weight)

    def _query(self, centers: Float64) -> tuple[Float64, Float64]:
        points = np.ascontiguousarray(centers[self._moving])
        distance, gradient = self._field.query(points)
        if np.any(bad := ~(np.isfinite(distance) & np.all(np.isfinite(gradient), axis=1))):
            first = int(np.argmax(bad))
            where = ", ".join(f"{v:.3f}" for v in points[first])
            raise NotEvaluableError(
                f"sphere {self.names[first]} at ({where}) m: the field has no distance there",
                remedy="bake a field that covers the robot's reach",
            )
        return distance - self._radii, gradient


class SelfRows(BarrierTerm):
    """A row per pair of spheres that could collide."""

    kind = RowKind.SELF

    def __init__(self, model: RobotModel, config: ControlConfig, acceleration: Float64 | None) -> None:
        """acceleration: as for `SceneRows`."""
        self._config, self._acceleration = config, acceleration
        self._radii = np.asarray(model.sphere_set.radii, dtype=np.float64)
        self._pairs = np.asarray(model.self_pairs(), dtype=np.int64).reshape(-1, 2)
        self.margin = config.self_margin - np.asarray(model.self_allowance, dtype=np.float64)
        names = sphere_names(model.sphere_set)
        self.names = tuple(f"{names[a]}~{names[b]}" for a, b in self._pairs)

    def rows(self, state: State) -> Barrier:
        """Rows of the pairs.

        If joints stop at once, G is zero for pairs too slow to violate their row.
        """
        centers, jacobians = state.spheres
        distance, direction = pair_gaps(centers, self._radii, self._pairs)
        if self._acceleration is not None:
            G = -pair_gradient(direction, jacobians, self._pairs)
            h = distance_bound(self._config, self._acceleration, distance, self.margin, G)
        else:
            G = np.zeros((len(distance), jacobians.shape[2]))
            h = distance_bound(self._config, None, distance, self.margin, G)
            speed = fastest_spheres(jacobians, *state.box)
            near = np.flatnonzero(h <= speed[self._pairs[:, 0]] + speed[self._pairs[:, 1]])
            G[near] = -pair_gradient(direction[near], jacobians, self._pairs[near])
        return Barrier(
            index=np.arange(len(self._pairs)),
            G=G,
            h=h,
            distance=distance,
            slack_cost=self._config.self_slack_cost,
            slack_weight=self._config.weight_slack,
        )

    def room(self, state: State, velocity: Float64) -> Float64:
        centers, jacobians = state.spheres
        distance, direction = pair_gaps(centers, self._radii, self._pairs)
        motion = jacobians @ velocity
        apart = motion[self._pairs[:, 0]] - motion[self._pairs[:, 1]]
        h = barrier_bound(distance, margin=self.margin, gain=self._config.barrier_gain)
        return np.asarray(h + np.sum(direction * apart, axis=1))

    def distances(self, centers: Float64) -> Float64:
        return pair_gaps(centers, self._radii, self._pairs)[0]


def scene_margin(model: RobotModel, config: ControlConfig) -> Float64:
    """Spheres' scene margins (S,) [m]: epsilon, plus deficits if `config.coverage` is "margin".

    By the triangle inequality, the surface then stays epsilon away, for any 1-Lipschitz distance.
    """
    deficit = np.asarray(model.sphere_deficit) if config.coverage == MARGIN else np.zeros(len(model.moving_spheres))
    return config.margin + deficit


def distance_bound(
    config: ControlConfig,
    acceleration: Float64 | None,
    distance: Float64,
    margin: Float64,
    G: Float64,
    rate: float | Float64 = 0.0,
) -> Float64:
    """h (M,) [m/s], with room for braking if joints have an acceleration limit a (J,).

    Only then G (M, J) counts: a row's approach G v can be braked by at most ``|G| a``, of which BRAKING_SHARE is
    used. rate [m/s]: dd/dt of a changing field.
    """
    if acceleration is None:
        return barrier_bound(distance, margin=margin, gain=config.barrier_gain, rate=rate)
    deceleration = fixed.BRAKING_SHARE * (np.abs(G) @ acceleration)
    return np.asarray(braking_speed(distance - margin, config.barrier_gain, deceleration, config.period) + rate)


def external_gradient(gradient: Float64, jacobians: Float64) -> Float64:
    """``dd/dq`` (M, J): gradient (M, 3), not normalised, times Jacobians (M, 3, J)."""
    return np.asarray(np.matmul(gradient[:, None, :], jacobians)[:, 0, :])


def pair_gradient(direction: Float64, jacobians: Float64, pairs: Integers) -> Float64:
    """``dd/dq`` (P, J) of sphere pairs; jacobians (S, 3, J)."""
    return np.asarray(np.matmul(direction[:, None, :], jacobians[pairs[:, 0]] - jacobians[pairs[:, 1]])[:, 0, :])


def barrier_bound(distance: Float64, *, margin: float | Float64, gain: float, rate: float | Float64 = 0.0) -> Float64:
    """h (M,): ``alpha (d - epsilon) + dd/dt`` [m/s]; rate: dd/dt of a changing field."""
    return np.asarray(gain * (distance - margin) + rate)


def can_bind(G: Float64, h: Float64, lowest: Float64, highest: Float64) -> Bool:
    """True for rows (M,) that some velocity of the box violates; other rows change no solution."""
    return np.asarray(np.maximum(G * lowest, G * highest).sum(axis=1) > h)


def fastest_spheres(jacobians: Float64, lowest: Float64, highest: Float64) -> Float64:
    """Upper bounds (S,) [m/s] on the spheres' speeds over the box; jacobians (S, 3, J)."""
    speed = np.abs(jacobians) @ np.maximum(np.abs(lowest), np.abs(highest))
    return np.asarray(np.sqrt(np.einsum("si,si->s", speed, speed)))


@dataclass(frozen=True, kw_only=True)
class SceneStep:
    """The two newest scenes known at a time, `seconds` apart."""

    newer: DistanceField
    older: DistanceField
    seconds: float


FieldAt = Callable[[int], DistanceField]
"""Stamp [ns] -> the field known then; the same object for the same scene."""

SceneStepAt = Callable[[int], SceneStep | None]
"""Stamp [ns] -> the two newest scenes known then; None if there was only one."""


def distance_rate(step: SceneStep | None, points: Float64, limit: float) -> float | Float64:
    """Rate dd/dt (Q,) [m/s] at fixed points (Q, 3) [m], from older to newer scene.

    It is clipped to [-limit, 0], 0 for missing distances, and assumed to last until the next scene.
    """
    if step is None:
        return 0.0
    change = (step.newer.query(points)[0] - step.older.query(points)[0]) / step.seconds
    return np.asarray(np.clip(np.nan_to_num(change), -limit, 0.0))


def rate_of(
    config: ControlConfig, model: RobotModel, scene_step_at: SceneStepAt | None, stamp_ns: int, q: Float64
) -> float | Float64:
    """Rate dd/dt [m/s] of the moving spheres at a posture (J,), 0 unless configured."""
    step = None if scene_step_at is None or config.distance_rate == "none" else scene_step_at(stamp_ns)
    if step is None:
        return 0.0
    points = np.ascontiguousarray(model.sphere_centers(q)[np.flatnonzero(model.moving_spheres)])
    return distance_rate(step, points, config.max_distance_rate)


class PeopleGrown:
    """A scene's field in which people extend `extra` [m] farther.

    Distance min(scene, people - extra), with the smaller term's gradient.
    """

    def __init__(self, scene: DistanceField, people: DistanceField, extra: float) -> None:
        self._scene, self._people, self._extra = scene, people, extra

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        distance, gradient = self._scene.query(points)
        to_people, from_people = self._people.query(points)
        is_nearer = to_people - self._extra < distance
        return (
            np.where(is_nearer, to_people - self._extra, distance),
            np.where(is_nearer[:, None], from_people, gradient),
        )


def guard_people(scene: DistanceField, people: DistanceField | None, config: ControlConfig) -> DistanceField:
    """Field from which a controller keeps `config.margin`.

    People are nearer by `config.human_margin` less the margin.
    """
    extra = config.human_margin - config.margin
    return scene if people is None or extra <= 0 else PeopleGrown(scene, people, extra)

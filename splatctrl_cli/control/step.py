"""One step of the QP-IK controller of III-E: query the field, build the rows, solve, check, fall back."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control import barriers, tasks
from splatctrl_cli.control.arm import ArmModel, sphere_names
from splatctrl_cli.control.barriers import Barrier
from splatctrl_cli.control.limits import velocity_box
from splatctrl_cli.control.problem import assemble
from splatctrl_cli.control.qp import ClarabelSolver, QpSolution, QpSolver
from splatctrl_cli.control.target import pose_error, reference_velocity
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError
from splatctrl_cli.records import Bool, DistanceField, Float64

SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)  # of a step that turns out worse than its rows promised; then none
MULTIPLIER = 1e-4  # above which a row counts as intervening; an idle row's multiplier ends below 1e-6


class Rung(StrEnum):
    """How a step came about: the ladder from a plain solution down to standing still."""

    SOLVED = "solved"
    RELAXED = "relaxed"
    MINIMUM_VIOLATION = "minimum-violation"
    HOLD = "hold"


@dataclass(frozen=True, kw_only=True)
class RowSlack:
    """A barrier row that gave way by `slack` [m/s]."""

    name: str
    slack: float


@dataclass(frozen=True, kw_only=True)
class ControlStep:
    """What the controller decided at one configuration, and how sure it may be of it.

    velocity (J,) [rad/s], already scaled by `scale` (1 unless the next distance broke a row's promise);
    pose_error (6,) [m, rad]; clearance [m] of the nearest moving sphere by the controller's own field;
    self_clearance [m] (inf without pairs); intervening are the rows that shape the solution; violated_fixed the
    violated rows that no joint velocity changes here; residual is the worst KKT residual of the QP used.
    """

    velocity: Float64
    rung: Rung
    scale: float
    pose_error: Float64
    clearance: float
    nearest: str
    self_clearance: float
    relaxed: tuple[RowSlack, ...]
    intervening: tuple[str, ...]
    violated_fixed: tuple[str, ...]
    num_rows: int
    residual: float
    status: str


@dataclass(frozen=True, kw_only=True)
class StaticViolation:
    """A sphere that no joint moves and that is closer to the scene than the margin."""

    sphere: str
    clearance: float


@dataclass(frozen=True, kw_only=True)
class _Barriers:
    """All rows at one configuration: external (moving spheres), then self (pairs)."""

    external: Barrier
    self: Barrier

    @property
    def distance(self) -> Float64:
        return np.concatenate([self.external.distance, self.self.distance])

    @property
    def h(self) -> Float64:
        return np.concatenate([self.external.h, self.self.h])


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """The ladder's answer before it is checked against the field again."""

    velocity: Float64
    rung: Rung
    slack: Float64
    multipliers: Float64
    solution: QpSolution


class QpIkController:
    """Drives a frame of an arm to a goal pose under the barrier rows of a distance field (paper, III-E)."""

    def __init__(
        self,
        model: ArmModel,
        config: ControlConfig,
        field: DistanceField,
        *,
        frame: str,
        home: Float64 | None = None,
        solver: QpSolver | None = None,
    ) -> None:
        check_config(config)
        if np.any(~(np.asarray(model.velocity_limit) > 0)):
            joint = int(np.argmax(~(np.asarray(model.velocity_limit) > 0)))
            raise InputError(
                f"joint {model.joint_names[joint]}: expected a velocity limit above zero, "
                f"got {model.velocity_limit[joint]:g}",
                remedy="set it in the URDF's <limit velocity=...>",
            )
        self._model, self._config, self._field, self._frame = model, config, field, frame
        self._solver: QpSolver = ClarabelSolver() if solver is None else solver
        self._home = middle_posture(model) if home is None else np.asarray(home, dtype=np.float64)
        self._moving = np.flatnonzero(model.moving_spheres)
        if not len(self._moving):
            raise InputError("robot: no collision sphere moves with a joint", remedy="check --spheres")
        self._radii = np.asarray(model.sphere_set.radii, dtype=np.float64)
        self._names = sphere_names(model.sphere_set)
        self._pairs = np.asarray(model.self_pairs(), dtype=np.int64).reshape(-1, 2)
        weight = np.repeat([config.weight_linear, config.weight_angular], 3)
        self._weight = tasks.eliminated_weight(weight, config.weight_kinematics * weight)

    def with_field(self, field: DistanceField) -> "QpIkController":
        """The same controller on another field (a newer scene)."""
        other = object.__new__(QpIkController)
        other.__dict__.update(self.__dict__, _field=field)
        return other

    def step(self, q: Float64, T_world_goal: Float64, *, distance_rate: float | Float64 = 0.0) -> ControlStep:
        """The joint velocity at q (J,) [rad] towards a goal pose (4, 4) of the controlled frame.

        distance_rate is dd/dt [m/s] of the moving spheres' distances, (M,) or one number, for a field that changes
        with time. Raises InputError for a q that is not finite, NotEvaluableError where the field has no distance.
        """
        q = checked_posture(self._model, q)
        config = self._config
        error = pose_error(self._model.frame_pose(q, self._frame), T_world_goal)
        reference = reference_velocity(
            error, gain=config.pose_gain, max_linear=config.max_linear_speed, max_angular=config.max_angular_speed
        )
        box = velocity_box(q, self._model.lower, self._model.upper, self._model.velocity_limit, config.barrier_gain)
        rows = self._barriers(q, distance_rate)
        jacobian = self._model.frame_jacobian(q, self._frame)
        costs = [
            tasks.velocity_task(jacobian, reference, self._weight),
            tasks.posture_task(config.posture_gain * (self._home - q), config.posture_weight),
        ]
        fixed = np.concatenate([barriers.is_immovable(b.G, self._model.velocity_limit) for b in _both(rows)])
        in_qp = ~fixed & np.concatenate([barriers.can_bind(b.G, b.h, *box) for b in _both(rows)])
        choice = self._descend_ladder(costs, box, rows, in_qp)
        scale = self._kept_scale(q, choice, rows)
        slack = choice.slack
        return ControlStep(
            velocity=choice.velocity * scale,
            rung=choice.rung if scale > 0 else Rung.HOLD,
            scale=scale,
            pose_error=error,
            clearance=float(np.min(rows.external.distance)),
            nearest=self._names[self._moving[int(np.argmin(rows.external.distance))]],
            self_clearance=float(np.min(rows.self.distance, initial=np.inf)),
            relaxed=tuple(
                RowSlack(name=self._row_name(i), slack=float(slack[i]))
                for i in _where(slack > config.slack_tolerance)
            ),
            intervening=self._intervening(choice, in_qp),
            violated_fixed=tuple(
                self._row_name(i) for i in _where(fixed & (rows.distance < self._row_margins(rows)))
            ),
            num_rows=int(in_qp.sum()),
            residual=choice.solution.residuals.worst,
            status=choice.solution.status,
        )

    def _barriers(self, q: Float64, distance_rate: float | Float64) -> _Barriers:
        """Every barrier row at q: gradient and distance come from one query of one function."""
        config = self._config
        centers, jacobians = self._model.sphere_centers(q), self._model.sphere_jacobians(q)
        distance, gradient = self._queried(centers)
        between, direction = barriers.pair_distance(centers, self._radii, self._pairs)
        external = Barrier(
            index=self._moving,
            G=-barriers.external_gradient(gradient, jacobians[self._moving]),
            h=barriers.barrier_bound(distance, margin=config.margin, gain=config.barrier_gain, rate=distance_rate),
            distance=distance,
            slack_cost=config.slack_cost,
            slack_weight=config.weight_slack,
        )
        own = Barrier(
            index=np.arange(len(self._pairs)),
            G=-barriers.pair_gradient(direction, jacobians, self._pairs),
            h=barriers.barrier_bound(between, margin=config.self_margin, gain=config.barrier_gain),
            distance=between,
            slack_cost=config.self_slack_cost,
            slack_weight=config.weight_slack,
        )
        return _Barriers(external=external, self=own)

    def _queried(self, centers: Float64) -> tuple[Float64, Float64]:
        """Distance (M,) of the moving spheres' surfaces and the field's gradient (M, 3) at their centres."""
        points = np.ascontiguousarray(centers[self._moving])
        distance, gradient = self._field.query(points)
        bad = ~(np.isfinite(distance) & np.all(np.isfinite(gradient), axis=1))
        if np.any(bad):
            first = int(np.argmax(bad))
            where = ", ".join(f"{v:.3f}" for v in points[first])
            raise NotEvaluableError(
                f"sphere {self._names[self._moving[first]]} at ({where}) m: the field has no distance there",
                remedy="bake a field that covers the robot's reach",
            )
        return distance - self._radii[self._moving], gradient

    def _descend_ladder(
        self, costs: list[tasks.Cost], box: tuple[Float64, Float64], rows: _Barriers, in_qp: Bool
    ) -> _Choice:
        """Solved or relaxed; else the least violation; else hold still. Only checked solutions are used."""
        J, num_external = len(box[0]), len(rows.external)
        chosen = [
            rows.external.select(in_qp[:num_external]),
            rows.self.select(in_qp[num_external:]),
        ]
        least = [tasks.posture_task(np.zeros(J), 1.0)]
        for rung, terms in ((Rung.SOLVED, costs), (Rung.MINIMUM_VIOLATION, least)):
            solution = self._solver.solve(assemble(terms, *box, chosen))
            if not is_usable(solution, self._config.max_residual):
                continue
            slack = np.zeros(len(in_qp))
            slack[in_qp] = np.maximum(solution.z[J:], 0.0)
            if rung is Rung.SOLVED and np.any(slack > self._config.slack_tolerance):
                rung = Rung.RELAXED  # noqa: PLW2901
            return _Choice(
                velocity=solution.z[:J], rung=rung, slack=slack, multipliers=solution.multipliers, solution=solution
            )
        return _Choice(
            velocity=np.zeros(J),
            rung=Rung.HOLD,
            slack=np.zeros(len(in_qp)),
            multipliers=np.zeros_like(solution.multipliers),
            solution=solution,
        )

    def _kept_scale(self, q: Float64, choice: _Choice, rows: _Barriers) -> float:
        """The largest of SCALES whose next distances are no worse than the rows promised, else 0.

        A row promises ``d(q + dt v) >= d - dt (h + s)``; a sphere on its way back out need only not lose ground.
        """
        if choice.rung is Rung.HOLD:
            return 0.0
        config = self._config
        promised = rows.distance - config.period * (rows.h + choice.slack)
        floor = np.minimum(promised, rows.distance) - config.promise_tolerance
        for scale in SCALES:
            if np.all(self._distances(q + scale * config.period * choice.velocity) >= floor):
                return scale
        return 0.0

    def _distances(self, q: Float64) -> Float64:
        """Every row's distance at q; NaN where the field has none, which keeps no promise."""
        centers = self._model.sphere_centers(q)
        distance = self._field.query(np.ascontiguousarray(centers[self._moving]))[0] - self._radii[self._moving]
        return np.concatenate([distance, barriers.pair_distance(centers, self._radii, self._pairs)[0]])

    def _intervening(self, choice: _Choice, in_qp: Bool) -> tuple[str, ...]:
        """The limits and barrier rows whose multiplier is not zero."""
        J = len(choice.velocity)
        active = choice.multipliers > MULTIPLIER
        sides = [f"{name} {side}" for side in ("highest", "lowest") for name in self._model.joint_names]
        limits = [sides[i] for i in np.flatnonzero(active[: 2 * J])]
        binding = np.flatnonzero(in_qp)[active[2 * J : 2 * J + int(in_qp.sum())]]
        return tuple(limits + [self._row_name(int(i)) for i in binding])

    def _row_name(self, row: int) -> str:
        if row < len(self._moving):
            return self._names[int(self._moving[row])]
        first, second = (int(i) for i in self._pairs[row - len(self._moving)])
        return f"{self._names[first]}~{self._names[second]}"

    def _row_margins(self, rows: _Barriers) -> Float64:
        return np.repeat([self._config.margin, self._config.self_margin], [len(rows.external), len(rows.self)])


def _where(mask: Bool) -> list[int]:
    return [int(i) for i in np.flatnonzero(mask)]


def _both(rows: _Barriers) -> tuple[Barrier, Barrier]:
    return rows.external, rows.self


def static_violations(
    model: ArmModel, config: ControlConfig, field: DistanceField, q: Float64
) -> tuple[StaticViolation, ...]:
    """The spheres that no joint moves and that stand within the margin: a matter of mounting, not of control."""
    still = np.flatnonzero(~np.asarray(model.moving_spheres))
    if not len(still):
        return ()
    points = np.ascontiguousarray(model.sphere_centers(q)[still])
    distance = field.query(points)[0] - model.sphere_set.radii[still]
    names = sphere_names(model.sphere_set)
    return tuple(
        StaticViolation(sphere=names[s], clearance=float(d))
        for s, d in zip(still, distance, strict=True)
        if d < config.margin
    )


def is_usable(solution: QpSolution, max_residual: float) -> bool:
    """True for a solution that is exactly solved and whose residuals, computed by us, check."""
    return solution.is_solved and solution.residuals.worst <= max_residual


def middle_posture(model: ArmModel) -> Float64:
    """The home posture (J,) [rad] where none is given: the middle of each joint's range, 0 where unlimited."""
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    return np.where(limited, 0.5 * (np.where(limited, model.lower, 0.0) + np.where(limited, model.upper, 0.0)), 0.0)


def check_config(config: ControlConfig) -> None:
    """Raise UsageError for a period, gain or weight that no controller can run with."""
    if not config.period > 0:
        raise UsageError(f"control.period: expected above 0 s, got {config.period:g}")
    if not 0 < config.barrier_gain * config.period <= 1:
        raise UsageError(
            f"control.barrier_gain: expected gain * period in (0, 1], got {config.barrier_gain * config.period:g}",
            remedy="lower control.barrier_gain or control.period",
        )
    weights = ("weight_linear", "weight_angular", "weight_kinematics", "weight_slack", "posture_weight")
    for name in (*weights, "slack_cost", "self_slack_cost"):
        if not getattr(config, name) > 0:
            raise UsageError(f"control.{name}: expected above 0, got {getattr(config, name):g}")


def checked_posture(model: ArmModel, q: Float64, *, what: str = "joint positions") -> Float64:
    """q as (J,) float64. Raises InputError where it has another size or is not finite."""
    posture = np.asarray(q, dtype=np.float64)
    if posture.shape != (len(model.joint_names),):
        raise InputError(f"{what}: expected {len(model.joint_names)} joints, got shape {posture.shape}")
    if not np.all(np.isfinite(posture)):
        joint = int(np.argmin(np.isfinite(posture)))
        raise InputError(f"{what}: joint {model.joint_names[joint]} is {posture[joint]}, expected a finite angle")
    return posture

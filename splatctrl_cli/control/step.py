"""The step of the QP-IK controller (III-E): query field, build rows, solve, recheck."""

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from splatctrl_cli.config import ControlConfig, fixed
from splatctrl_cli.control.audit import BallDistance
from splatctrl_cli.control.goals import Guide, pose_error, reference_velocity
from splatctrl_cli.control.preconditions import check_coverage, check_model, checked_posture
from splatctrl_cli.control.qp import SOLVERS, Choice, QpSolver, Rung, descend, stand_still, unsolved
from splatctrl_cli.control.qp_rows import PRINTED, RowBuilder, Rows, solve_printed
from splatctrl_cli.control.terms import (
    BarrierTerm,
    Cost,
    CostTerm,
    JointLimits,
    RowKind,
    State,
    configured_weights,
    eliminated_weight,
    reach_cost,
    standard_costs,
    sum_costs,
)
from splatctrl_cli.records import Bool, DistanceField, Float64
from splatctrl_cli.robot.model import RobotModel

RELAXED_NEAR = 2.0  # [margins]: farther away, slack allows only a faster approach, and every distance is judged


@dataclass(frozen=True, kw_only=True)
class RowSlack:
    """A barrier row relaxed by `slack` [m/s]; is_near: its distance is at most `RELAXED_NEAR` margins."""

    name: str
    slack: float
    is_near: bool


@dataclass(frozen=True, kw_only=True)
class Intervention:
    """A row that shapes the command; multiplier: cost per unit of the row."""

    name: str
    kind: RowKind
    multiplier: float


@dataclass(frozen=True, kw_only=True)
class VelocityMargin:
    """Room of a joint velocity in its tightest rows, negative if it violates them.

    barrier: least ``h - G v`` [m/s]; limit: least distance to the joint limits' box [rad/s].
    """

    barrier: float
    barrier_row: str
    limit: float
    limit_row: str


@dataclass(frozen=True, kw_only=True)
class ControlStep:
    """The controller's decision at one configuration.

    velocity (J,) [rad/s], scaled by `scale` (below 1 if a distance after the step would be too small);
    pose_error (6,) [m, rad]; clearance [m] of the nearest moving sphere by the controller's field; self_clearance [m]
    (inf without pairs); violated_fixed: violated rows that no joint velocity changes; fixed_distance [m]: their least
    distance (inf without any); interventions: rows that shape the solution; num_rows: in the QP; residual, status:
    worst KKT residual and status of the last solution; num_refused: number of unusable solutions; by_surface: for the
    next `step`.
    """

    velocity: Float64
    rung: Rung
    scale: float
    pose_error: Float64
    clearance: float
    nearest: str
    self_clearance: float
    relaxed: tuple[RowSlack, ...]
    interventions: tuple[Intervention, ...]
    violated_fixed: tuple[str, ...]
    num_rows: int
    residual: float
    status: str
    num_refused: int
    fixed_distance: float = np.inf
    by_surface: tuple[str, ...] = ()

    @property
    def intervening(self) -> tuple[str, ...]:
        return tuple(intervention.name for intervention in self.interventions)


@dataclass(frozen=True, kw_only=True)
class Moment:
    """A controller's input: the stamp [ns] and `QpIkController.step`'s arguments.

    by_surface: from the step before.
    """

    stamp_ns: int
    q: Float64
    T_world_goal: Float64
    guide: Guide | None
    last_velocity: Float64 | None
    distance_rate: float | Float64
    by_surface: Collection[str] = ()


@dataclass(frozen=True, kw_only=True)
class View:
    """State before a decision: pose error (6,) [m, rad], state and rows."""

    error: Float64
    state: State
    rows: Rows


class QpIkController:
    """Drives a frame to a goal pose under a distance field's barrier rows (III-E)."""

    def __init__(
        self,
        model: RobotModel,
        config: ControlConfig,
        field: DistanceField,
        *,
        frame: str,
        home: Float64 | None = None,
        solver: QpSolver | None = None,
        terms: Sequence[CostTerm | BarrierTerm] = (),
    ) -> None:
        """home (J,) [rad]: posture to lean to (default: `model.middle`); terms: added to the paper's.

        Raises InputError for a robot without moving spheres, velocity limits or required coverage.
        """
        check_model(model)
        check_coverage(model, config)
        self._model, self._config, self._frame = model, config, frame
        self._solver: QpSolver = SOLVERS[config.solver] if solver is None else solver
        self._limits = JointLimits.of(model, config)
        self._builder = RowBuilder(
            model, config, field, self._limits.acceleration, [term for term in terms if isinstance(term, BarrierTerm)]
        )
        self._limit_names = tuple(f"{joint} {side}" for side in ("highest", "lowest") for joint in model.joint_names)
        self.row_names, self.row_kinds = self._builder.names, self._builder.kinds
        costs = [term for term in terms if not isinstance(term, BarrierTerm)]
        home = np.asarray(model.middle if home is None else home, dtype=np.float64)
        self._costs: tuple[CostTerm, ...] = (*standard_costs(config, home), *costs)
        self._reach_weight = eliminated_weight(*configured_weights(config))

    def replace_field(self, field: DistanceField, balls: BallDistance | None = None) -> "QpIkController":
        """Controller on a newer field (`SceneRows.replace_field`)."""
        other = copy(self)
        other._builder = self._builder.replace_field(field, balls)
        return other

    def step(
        self,
        q: Float64,
        T_world_goal: Float64,
        *,
        distance_rate: float | Float64 = 0.0,
        guide: Guide | None = None,
        last_velocity: Float64 | None = None,
        by_surface: Collection[str] = (),
    ) -> ControlStep:
        """Joint velocity at q (J,) [rad] towards a goal pose (4, 4).

        distance_rate: dd/dt [m/s] of the moving spheres, (M,) or one number. guide: the goal's motion (None: at
        rest). last_velocity (J,) [rad/s]: for acceleration and smoothness (None: neither counts). by_surface: spheres
        that count by their link's surface; with a relaxed row, a sphere joins them if that surface is farther. Raises
        InputError for a non-finite q, NotEvaluableError where the field has no distance.
        """
        moment = Moment(
            stamp_ns=0,
            q=q,
            T_world_goal=T_world_goal,
            guide=guide,
            last_velocity=last_velocity,
            distance_rate=distance_rate,
            by_surface=by_surface,
        )
        return self.decide(self.view(moment))

    def decide(self, view: View) -> ControlStep:
        """Step of a view. Raises as `step`."""
        config, error, state, rows = self._config, view.error, view.state, view.rows
        rest = self._limits.rest(state.last_velocity)
        costs = [cost(state) for cost in self._costs]
        if config.program == PRINTED:
            printed = solve_printed(self._solver, state, sum_costs(costs), rows.for_qp, config)
            return self._report(error, rows, printed, rest, float(printed.rung is not Rung.HOLD))
        costs.append(reach_cost(state.jacobian, state.reference, self._reach_weight))
        rows, choice, is_kept = self._descend(state, costs, rows)
        while np.any(newly := self._sticking_out(state, rows, choice)):
            state = replace(state, by_surface=state.by_surface | newly)
            rows, choice, is_kept = self._descend(state, costs, self._builder.at(state))
        scale = 1.0 if is_kept else self._kept_scale(state, choice, rows, rest)
        return replace(self._report(error, rows, choice, rest, scale), by_surface=self._named(state.by_surface))

    def view(self, moment: Moment) -> View:
        """A step's input at a moment. Raises as `step`."""
        q = checked_posture(self._model, moment.q)
        error = pose_error(self._model.frame_pose(q, self._frame), moment.T_world_goal)
        linear, angular = self._config.max_linear_speed, self._config.max_angular_speed
        reference = reference_velocity(error, gain=self._config.pose_gain, max_linear=linear, max_angular=angular)
        state = State(
            model=self._model,
            frame=self._frame,
            q=q,
            box=self._limits.box(q, moment.last_velocity),
            reference=reference if moment.guide is None else reference + moment.guide.twist,
            guide=moment.guide,
            last_velocity=moment.last_velocity,
            distance_rate=moment.distance_rate,
            by_surface=np.array([name in moment.by_surface for name in self._builder.scene.names]),
        )
        return View(error=error, state=state, rows=self._builder.at(state))

    def take_velocity(self, view: View, velocity: Float64 | None, status: str = "") -> ControlStep:
        """Step of an external velocity (J,) [rad/s]; slack is its row violation.

        Without a velocity the arm stops, for the reason in `status`.
        """
        rest, rows = self._limits.rest(view.state.last_velocity), view.rows
        J, M = len(rest), int(rows.in_qp.sum())
        choice = replace(
            stand_still(J, M, unsolved(J, M, status), num_refused=0),
            velocity=rest if velocity is None else velocity,
            rung=Rung.HOLD if velocity is None else Rung.OUTSIDE,
        )
        if velocity is not None and M:
            broken = np.concatenate([barrier.G @ velocity - barrier.h for barrier in rows.for_qp])
            choice = replace(choice, slack=np.maximum(broken, 0.0))
        return self._report(view.error, rows, choice, rest, 1.0)

    def margin_of(self, q: Float64, velocity: Float64, *, distance_rate: float | Float64 = 0.0) -> VelocityMargin:
        """Room that any joint velocity (J,) [rad/s] leaves at q (J,).

        The change of velocity does not count. Raises the errors of `step`.
        """
        q = checked_posture(self._model, q)
        lowest, highest = self._limits.box(q)
        state = State(model=self._model, frame=self._frame, q=q, box=(lowest, highest), distance_rate=distance_rate)
        room = self._builder.room(state, velocity)
        limits = np.concatenate([highest - velocity, velocity - lowest])
        row, limit = int(np.argmin(room)), int(np.argmin(limits))
        return VelocityMargin(
            barrier=float(room[row]),
            barrier_row=self.row_names[row],
            limit=float(limits[limit]),
            limit_row=self._limit_names[limit],
        )

    def _descend(self, state: State, costs: Sequence[Cost], rows: Rows) -> tuple[Rows, Choice, bool]:
        """Rows, the ladder's choice, and True if no distance after the step is too small.

        A sphere that would meet another surface than its row's gets a further row, and the ladder runs again: cutting
        planes, at most `config.max_cuts` rounds.
        """
        num_external, max_cuts = len(self._builder.scene.names), self._config.max_cuts
        for num_cuts in range(max_cuts + 1):
            choice = descend(self._solver, costs, state.box, rows.for_qp, self._config)
            if choice.rung is Rung.HOLD:
                break
            later = self._builder.distances(state.q + self._config.period * choice.velocity, state.by_surface)
            broken = self._broken(choice, rows, later)
            if not np.any(broken):
                return rows, choice, True
            can_be_cut = broken[:num_external] & np.isfinite(later[:num_external])
            if num_cuts == max_cuts or not np.any(can_be_cut):
                break
            rows = self._builder.cut(rows, state, choice.velocity, np.flatnonzero(can_be_cut))
        return rows, choice, False

    def _sticking_out(self, state: State, rows: Rows, choice: Choice) -> Bool:
        """True for spheres (M,) with relaxed rows whose links' surfaces are farther away."""
        distance, scene = rows.external.distance, self._builder.scene
        has_given_way = rows.spread(choice.slack)[: len(distance)] > self._config.slack_tolerance
        return np.asarray(scene.raise_by_surfaces(state.q, distance, has_given_way & ~state.by_surface) > distance)

    def _broken(self, choice: Choice, rows: Rows, later: Float64) -> Bool:
        """True for rows (M,) whose `later` distance, after a period, is less than predicted.

        A row predicts ``d(q + dt v) >= d - dt (h + s)``; d suffices if it is less. The tolerance is
        `promise_tolerance` outside the margin, and WITHIN_SHARE of it within. Distances within the margin may shrink
        if the rows' total shortfall shrinks.
        """
        config = self._config
        promised = rows.distance - config.period * (rows.h + rows.spread(choice.slack))
        is_within = rows.distance < rows.margin
        tolerance = np.where(is_within, fixed.WITHIN_SHARE, 1.0) * config.promise_tolerance
        broken = ~(later >= np.minimum(promised, rows.distance) - tolerance)
        if np.any(broken) and np.all(is_within[broken]):
            lack, lack_later = (float(np.sum(np.maximum(rows.margin - d, 0.0))) for d in (rows.distance, later))
            if lack_later < lack - fixed.WITHIN_SHARE * config.promise_tolerance:
                return np.zeros_like(broken)
        return np.asarray(broken)

    def _kept_scale(self, state: State, choice: Choice, rows: Rows, rest: Float64) -> float:
        """Largest of STEP_SCALES at which no row is `_broken`, else 0."""
        if choice.rung is Rung.HOLD:
            return 0.0
        for scale in fixed.STEP_SCALES:
            q = state.q + self._config.period * _blend(choice.velocity, rest, scale)
            if not np.any(self._broken(choice, rows, self._builder.distances(q, state.by_surface))):
                return scale
        return 0.0

    def _report(self, error: Float64, rows: Rows, choice: Choice, rest: Float64, scale: float) -> ControlStep:
        slack = rows.spread(choice.slack)
        is_near = rows.distance <= RELAXED_NEAR * rows.margin
        violated_fixed = rows.is_fixed & (rows.distance < rows.margin)
        return ControlStep(
            velocity=_blend(choice.velocity, rest, scale),
            rung=choice.rung if scale > 0 else Rung.HOLD,
            scale=scale,
            pose_error=error,
            clearance=float(np.min(rows.external.distance)),
            nearest=self.row_names[int(np.argmin(rows.external.distance))],
            self_clearance=float(np.min(rows.own.distance, initial=np.inf)),
            relaxed=tuple(
                RowSlack(name=self.row_names[i], slack=float(slack[i]), is_near=bool(is_near[i]))
                for i in np.flatnonzero(slack > self._config.slack_tolerance)
            ),
            interventions=self._interventions(choice, rows),
            violated_fixed=self._named(violated_fixed),
            fixed_distance=float(np.min(rows.distance[violated_fixed], initial=np.inf)),
            num_rows=int(rows.in_qp.sum()),
            residual=choice.solution.residuals.worst,
            status=choice.solution.status,
            num_refused=choice.num_refused,
        )

    def _interventions(self, choice: Choice, rows: Rows) -> tuple[Intervention, ...]:
        multipliers = np.concatenate([choice.box_multipliers, rows.spread(choice.row_multipliers)])
        names, num_limits = (*self._limit_names, *self.row_names), len(self._limit_names)
        return tuple(
            Intervention(
                name=names[i],
                kind=RowKind.LIMIT if i < num_limits else self.row_kinds[i - num_limits],
                multiplier=float(multipliers[i]),
            )
            for i in np.flatnonzero(multipliers > fixed.MULTIPLIER)
        )

    def _named(self, rows: Bool) -> tuple[str, ...]:
        return tuple(self.row_names[i] for i in np.flatnonzero(rows))


class Commander:
    """Source of commands: our own controller."""

    @property
    def is_over(self) -> bool:
        """True once no step will follow; the last one was to rest."""
        return False

    def step(self, controller: QpIkController, moment: Moment) -> ControlStep:
        """Step at a moment; `controller` is ours in the current scene."""
        return controller.decide(controller.view(moment))


OURS = Commander()


def _blend(velocity: Float64, rest: Float64, scale: float) -> Float64:
    return velocity if scale == 1.0 else rest + scale * (velocity - rest)

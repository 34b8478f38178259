"""Separation of a replayed arm from people, by declared inputs (``--separation``; ISO/TS 15066, 5.5.4)."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from splatctrl_cli.config.fixed import MISPLACED
from splatctrl_cli.control.audit import BallDistance, DistanceFunction, part_clearances
from splatctrl_cli.control.columns import NamedColumns
from splatctrl_cli.control.near_space import NEVER_SEEN, Seen
from splatctrl_cli.control.separation import (
    ANYTHING,
    LABELLED,
    PERSON,
    PERSON_SPEED,
    Approach,
    ArmMotion,
    DeclaredSeparation,
    Stop,
)
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import SphereField
from splatctrl_cli.jobs.replay.metrics import Metrics
from splatctrl_cli.jobs.replay.request import Replay, ReplayInputs, ReplayRequest, SeparationInput, Trace
from splatctrl_cli.jobs.replay.state_pass import blocks_of
from splatctrl_cli.records import Bool, Float64, Floats
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import sphere_names

NEWCOMER_APART = 0.05  # [m] from all surfaces of the empty cell's map: maps of one place differ by less
VOXEL = 0.02  # [m] of a map that does not say its own
VOXELS = 2  # of map error, assumed: one covers the true error at 94.5 % of the states of a shelf, two at all
STOP_POSTURES = 5  # of the path of a stop at which clearance is measured; a bound holds in between
NO_CLAIM = "No compliance with ISO/TS 15066 or ISO 10218-2 is claimed. Power and force limiting is not assessed."
FIGURES = {  # of the summary, with units and meaning
    "separation_margin_min": ("m", "least separation less S_p"),
    "time_below_separation": ("s", "time below S_p"),
    "standstill_below_s": ("s", "time below S_p at any speed of the arm"),
    "speed_scale_min": ("", "speed scale that keeps S_p"),
    "time_to_contact_min": ("s", "least time to contact"),
    "stop_clearance_min": ("m", "least clearance of the stopping volume to static surfaces"),
}
MEASURED, DECLARED, ASSUMED = "measured", "declared", "assumed"


def check_separation(request: ReplayRequest) -> None:
    """Raise UsageError for a baked field, which has no times of its space."""
    refuse_if(
        request.separation is not None and request.field is not None,
        "--separation: a baked field does not say when space was seen",
        remedy="give --scene or --lockstep",
        error=UsageError,
    )


def add_separation(declared: DeclaredSeparation, inputs: ReplayInputs, replay: Replay) -> Replay:
    """Add columns of the separation to the trace, and its inputs to the replay.

    Raises InputError for maps without times, or if labels define people and no map has any.
    """
    separation_inputs = (
        *_person_inputs(declared),
        *_time_inputs(declared, inputs),
        *_distance_inputs(declared, inputs, replay),
    )
    judge = _SeparationPass(declared, inputs, replay, {each.symbol: each.value for each in separation_inputs})
    for first, last in blocks_of(inputs.scene, inputs.model, replay.trace.stamp_ns):
        replay.trace.append(judge.columns(first, last))
    refuse_if(
        declared.who == LABELLED and not judge.surfaces.num_labelled,
        f"{inputs.source.name}: person.who = 'labelled': no map has a surface with depth and a person's label",
        remedy="record masks of people with depth (--human-topic of reconstruct), or declare who = 'newcomer'",
    )
    return replace(replay, separation=separation_inputs)


def _person_inputs(declared: DeclaredSeparation) -> Iterator[SeparationInput]:
    is_assumed = declared.who == ANYTHING
    how = "every surface of the map counts" if is_assumed else f"surfaces that count: {declared.who}"
    yield SeparationInput(symbol="person", unit="", source=ASSUMED if is_assumed else DECLARED, how=how)
    unseen = "space never seen counts as a person" if declared.unseen == PERSON else "space never seen is empty"
    yield SeparationInput(
        symbol="unseen", unit="", source=DECLARED if declared.unseen == PERSON else ASSUMED, how=unseen
    )
    yield _number("v_h", "m/s", declared.speed, "a person's speed", PERSON_SPEED, "the standard's constant")
    yield SeparationInput(symbol="C", value=declared.intrusion, unit="m", source=DECLARED, how="intrusion distance")


def _number(
    symbol: str, unit: str, declared_value: float | None, how: str, default: float, why: str
) -> SeparationInput:
    """Declared number, else the assumed one and why."""
    if declared_value is not None:
        return SeparationInput(symbol=symbol, value=declared_value, unit=unit, source=DECLARED, how=how)
    return SeparationInput(symbol=symbol, value=default, unit=unit, source=ASSUMED, how=why)


def _time_inputs(declared: DeclaredSeparation, inputs: ReplayInputs) -> Iterator[SeparationInput]:
    scene = inputs.scene
    if declared.reaction_time is None:
        refuse_if(
            len(scene.stamps_ns) < 2,
            f"{inputs.source.name}: --separation: expected two maps or more to measure the reaction time",
            remedy="declare robot.reaction_time",
        )
        latency = max(np.subtract(scene.known_ns, scene.stamps_ns).tolist()) * 1e-9
        period = float(np.median(np.diff(scene.stamps_ns))) * 1e-9
        how = f"latency {latency:g} s and period of the maps {period:.3g} s"
        yield SeparationInput(symbol="T_r", value=latency + period, unit="s", source=MEASURED, how=how)
    else:
        yield SeparationInput(
            symbol="T_r", value=declared.reaction_time, unit="s", source=DECLARED, how="reaction time"
        )
    if declared.deceleration is not None:
        yield SeparationInput(
            symbol="a",
            value=declared.deceleration,
            unit="m/s^2",
            source=DECLARED,
            how="worst-case deceleration: T_s = v/a, S_s = v^2/2a",
        )
        return
    num = len(declared.stops)
    yield SeparationInput(symbol="T_s, S_s", unit="", source=DECLARED, how=f"stop table of {num} rows")
    yield _number("payload", "", declared.payload, "share of the rated load", 1.0, "the rated load")


def _distance_inputs(declared: DeclaredSeparation, inputs: ReplayInputs, replay: Replay) -> Iterator[SeparationInput]:
    figures, map_error = inputs.scene.figures(), replay.map_error
    if declared.map_error is None and map_error is not None and map_error.bound is not None:
        how = f"bound on the map's error, {100 * map_error.bound.confidence:.3g} % confidence; plus v_h times the age"
        yield SeparationInput(symbol="Z_d", value=map_error.bound.bound, unit="m", source=MEASURED, how=how)
    else:
        assumed = VOXELS * float(figures.get("voxel") or VOXEL)
        why = f"{VOXELS} voxels of the map, for --evidence is missing; plus v_h times the evidence's age"
        yield _number("Z_d", "m", declared.map_error, "map error; plus v_h times the evidence's age", assumed, why)
    residual = figures.get("self_mask_residual_mm")
    if declared.robot_error is None and residual is not None:
        how = "robot in the images against its joints; plus surface outside of its spheres"
        yield SeparationInput(symbol="Z_r", value=1e-3 * float(residual), unit="m", source=MEASURED, how=how)
    else:
        yield _number("Z_r", "m", declared.robot_error, "robot error", MISPLACED, "the most that a verdict allows")


def evidence_age(trace: Trace) -> Float64:
    """Age (T,) [s] of depth about the arm: the map's age, plus the lag when last evaluated."""
    of_map, of_arm = trace["map_age_s"], trace["evidence_age"]
    looked = np.flatnonzero(np.isfinite(of_arm))
    before = np.searchsorted(looked, np.arange(len(of_map)), side="right")
    older = np.concatenate([[0.0], np.maximum(of_arm - of_map, 0.0)[looked]])
    return np.asarray(of_map + older[before])


class _SeparationPass:
    """Columns of the separation, block by block; number: the inputs by symbol."""

    def __init__(
        self, declared: DeclaredSeparation, inputs: ReplayInputs, replay: Replay, number: dict[str, float | None]
    ) -> None:
        model = inputs.model
        self._declared, self._inputs, self._trace = declared, inputs, replay.trace
        self._number = {symbol: value or 0.0 for symbol, value in number.items()}
        self._approach = Approach(
            person_speed=self._number["v_h"],
            reaction_time=self._number["T_r"],
            stopping=declared.stopping(model.joint_names),
        )
        self._moving = np.flatnonzero(model.moving_spheres)
        self._levers, self._names = model.lever_arms()[self._moving], sphere_names(model.sphere_set)
        self._age, self._speed = evidence_age(replay.trace), _joint_speeds(inputs, replay)
        refuse_if(
            np.isnan(self._age).any(),
            f"{inputs.source.name}: --separation: the maps have no times",
            remedy="reconstruct with snapshots, or give --lockstep",
        )
        self._seconds = np.append(np.diff(replay.trace.stamp_ns) * 1e-9, 0.0)
        self.surfaces = _Surfaces(declared, inputs)

    def columns(self, first: int, last: int) -> NamedColumns:
        """Columns of the sphere with the least margin. States `first` to `last` share one scene."""
        stamp, q = int(self._trace.rows("stamp_ns")[first]), self._trace.rows("q")[first:last]
        robot, (people, statics) = self._inputs.model.at(stamp), self.surfaces.at(stamp)
        centers = robot.sphere_centers_batch(q)
        motion = self._motion(robot, q, centers, people, self._speed[first:last])
        each, is_surface = _clearances(robot, q, people, centers)
        unseen = self._number["Z_d"] + self._number["v_h"] * self._age[first:last]
        robot_error = self._robot_error(robot, is_surface)
        room = each - self._number["C"] - unseen[:, None] - robot_error
        full = np.ones(len(q))
        travel = self._approach.travel(motion, full)
        margin = room - travel.total
        needed = travel.total + self._number["C"] + unseen[:, None] + robot_error
        worst = np.where(np.isinf(margin).all(axis=1), needed.argmax(axis=1), margin.argmin(axis=1))
        at = np.arange(len(q)), worst
        stop = self._approach.stopping.stop(motion, full)
        return {
            "separation": each[at],
            "protective_distance": needed[at],
            "separation_margin": margin[at],
            "separation_part": [self._names[self._moving[sphere]] for sphere in worst.tolist()],
            "S_h": travel.person,
            "S_r": travel.reaction[at],
            "S_s": travel.stopping[at],
            "Z_d": unseen,
            "Z_r": robot_error[worst],
            "speed_scale": self._approach.speed_scale(motion, room),
            "time_to_contact": self._approach.time_to_contact(motion, each),
            "stop_clearance": self._stop_clearance(robot, q, motion, stop, statics),
            "below_s": np.where(margin[at] < 0, self._seconds[first:last], 0.0),
        }

    def _motion(
        self, robot: RobotModel, q: Float64, centers: Float64, people: "_Balls | None", speed: Float64
    ) -> ArmMotion:
        points = centers[:, self._moving]
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        gradient = np.zeros_like(flat) if people is None else people.field.query(flat)[1]
        reached = np.linalg.norm(points - robot.base_position, axis=2) + robot.sphere_set.radii[self._moving]
        return ArmMotion(
            joint_speed=speed,
            velocity_limit=robot.velocity_limit,
            jacobian=np.array([robot.spheres_at(posture)[1][self._moving] for posture in q]),
            gradient=gradient.reshape(points.shape),
            extension=reached.max(axis=1) / (self._declared.reach or np.inf),
        )

    def _robot_error(self, robot: RobotModel, is_surface: Bool) -> Float64:
        """Z_r (M,): declared, else the residual plus the surface outside of a link's spheres."""
        deficit = np.where(is_surface, 0.0, np.maximum(robot.sphere_deficit[self._moving], 0.0))
        if self._declared.robot_error is not None:
            return np.full(len(deficit), self._number["Z_r"])
        refuse_if(
            np.isnan(deficit).any(),
            f"--separation: Z_r is unknown: {robot.coverage_unknown}",
            remedy="give a URDF with collision geometry, or declare distance.robot_error",
        )
        return np.asarray(self._number["Z_r"] + deficit)

    def _stop_clearance(
        self, robot: RobotModel, q: Float64, motion: ArmMotion, stop: Stop, statics: "_Balls | None"
    ) -> Float64:
        """Lower bound (T,) [m] of the clearance to static surfaces along a straight stop in joint space."""
        way = motion.joint_speed * self._number["T_r"] + np.sign(motion.joint_speed) * stop.joint_travel
        shares = np.linspace(0.0, 1.0, STOP_POSTURES)
        postures = (q[:, None] + shares[:, None] * way[:, None]).reshape(-1, q.shape[1])
        each = _clearances(robot, postures, statics)[0].reshape(len(q), STOP_POSTURES, -1)
        between = 0.5 / (STOP_POSTURES - 1) * np.abs(way) @ self._levers.T
        return np.asarray(np.min(each.min(axis=1) - between, axis=1))


def _joint_speeds(inputs: ReplayInputs, replay: Replay) -> Float64:
    """Joint velocities (T, J): logged, or a driven arm's commands (0 without one)."""
    if replay.closed_loop is not None:
        return np.asarray(np.nan_to_num(replay.trace["v"]), np.float64)
    stamps = replay.trace.stamp_ns
    first = int(np.searchsorted(inputs.states.stamp_ns, stamps[0]))
    return np.asarray(inputs.states.velocity[first : first + len(stamps)], np.float64)


@dataclass(frozen=True, kw_only=True)
class _Balls:
    """Surfaces as balls, with the gradient of their distance."""

    field: SphereField
    distance: BallDistance

    @classmethod
    def of(cls, centers: Floats, radii: Floats) -> "_Balls | None":
        """None without balls."""
        if not len(radii):
            return None
        field = SphereField(Spheres.of(centers, radii))
        distance: DistanceFunction = lambda points: field.query(points)[0]  # noqa: E731
        return cls(field=field, distance=BallDistance(of_points=distance, centers=centers, radii=radii))


def _clearances(
    robot: RobotModel, q: Float64, balls: _Balls | None, centers: Float64 | None = None
) -> tuple[Float64, Bool]:
    if balls is None:
        num = int(np.count_nonzero(robot.moving_spheres))
        return np.full((len(q), num), np.inf), np.ones(num, bool)
    return part_clearances(robot, q, balls.distance, centers)


class _Surfaces:
    """Surfaces of people and static surfaces, in the scene known at a stamp."""

    def __init__(self, declared: DeclaredSeparation, inputs: ReplayInputs) -> None:
        self._declared, self._scene = declared, inputs.scene
        self.num_labelled = 0
        self._empty: DistanceFunction | None = None
        if declared.empty_at is not None:
            first_ns, last_ns = int(inputs.states.stamp_ns[0]), int(inputs.states.stamp_ns[-1])
            stamp_ns = max(first_ns + round(declared.empty_at * 1e9), inputs.scene.first_ns or first_ns)
            refuse_if(
                stamp_ns > last_ns,
                f"{inputs.source.name}: person.empty_at: expected a time within the log, which ends after "
                f"{(last_ns - first_ns) * 1e-9:.2f} s, got {declared.empty_at:g} s",
                remedy="give a time at which the cell is empty",
            )
            self._empty = inputs.scene.at(stamp_ns).distances["exact"]

    def at(self, stamp_ns: int) -> tuple[_Balls | None, _Balls | None]:
        """People, and static surfaces; None for none."""
        known = self._scene.at(stamp_ns)
        exact = known.distances["exact"]
        assert isinstance(exact, BallDistance)
        assert known.is_person is not None
        self.num_labelled += int(known.is_person.sum())
        is_person = known.is_person if self._declared.who == LABELLED else np.ones(len(exact.radii), bool)
        if self._empty is not None:
            is_person = self._empty(np.asarray(exact.centers, np.float64)) > NEWCOMER_APART
        is_static = ~is_person if self._declared.who != ANYTHING else is_person
        centers, radii = exact.centers[is_person], exact.radii[is_person]
        if self._declared.unseen == PERSON and (seen := self._scene.seen_at(stamp_ns)) is not None:
            cells = unseen_cells(seen)
            centers = np.concatenate([centers, cells])
            radii = np.concatenate([radii, np.full(len(cells), 0.5 * 3**0.5 * seen.voxel)])
        return _Balls.of(centers, radii), _Balls.of(exact.centers[is_static], exact.radii[is_static])


def unseen_cells(seen: Seen) -> Float64:
    """Centres (K, 3) [m], world, of voxels that no camera ever saw, at the border of such space."""
    cells = np.indices(seen.shape).reshape(3, -1).T
    classes = seen.look(seen.origin + seen.voxel * cells)[1]
    is_unseen = np.isin(classes, NEVER_SEEN).reshape(seen.shape)
    return np.asarray(seen.origin + seen.voxel * np.argwhere(is_unseen & ~binary_erosion(is_unseen)))


def _figures(replay: Replay, metrics: Metrics) -> dict[str, float | None]:
    below, scale = replay.trace["below_s"], replay.trace["speed_scale"]
    own = metrics | {"standstill_below_s": float(below[scale <= 0].sum())}
    return {name: own[name] for name in FIGURES}


def separation_document(replay: Replay, metrics: Metrics) -> dict[str, Any]:
    """Content of ``separation.json``."""
    return {
        "standard": "ISO/TS 15066:2016, 5.5.4.2.3: S_p = S_h + S_r + S_s + C + Z_d + Z_r",
        "claim": NO_CLAIM,
        "figures": [
            {"name": name, "value": value, "unit": FIGURES[name][0], "meaning": FIGURES[name][1]}
            for name, value in _figures(replay, metrics).items()
        ],
        "inputs": [asdict(each) for each in replay.separation or ()],
    }


def separation_lines(replay: Replay, metrics: Metrics) -> list[str]:
    """Sentences for the terminal."""
    if replay.separation is None:
        return []
    known = {name: value for name, value in _figures(replay, metrics).items() if value is not None}
    figures = [f"{FIGURES[name][1]} {value:.3g} {FIGURES[name][0]}".rstrip() for name, value in known.items()]
    assumed = ", ".join(each.symbol for each in replay.separation if each.source == ASSUMED) or "nothing"
    return [*(f"separation: {figure}" for figure in figures), f"separation: assumed: {assumed}", NO_CLAIM]

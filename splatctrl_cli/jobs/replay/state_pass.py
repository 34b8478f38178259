"""States of a replay, measured and stored block by block."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter

import numpy as np

from splatctrl_cli.config import Config, fixed
from splatctrl_cli.control.audit import (
    AuditTrace,
    Clearance,
    DistanceFunction,
    Reach,
    audit,
    between_states,
    clearances,
    moving_clearance,
    observed_at,
    part_clearances,
)
from splatctrl_cli.control.columns import (
    Event,
    EventKind,
    NamedColumns,
    Obstacle,
    audit_columns,
    audit_signals,
    events_of,
    motion_signals,
    names_at,
    step_signals,
)
from splatctrl_cli.control.near_space import NEVER_SEEN, Account, NearSpace
from splatctrl_cli.control.preconditions import FixedParts
from splatctrl_cli.control.terms import MotionLimits
from splatctrl_cli.jobs.replay.hindsight import Hindsight, NewerDepth
from splatctrl_cli.jobs.replay.known_scene import KnownFields, KnownScene
from splatctrl_cli.jobs.replay.request import BLOCK, Trace
from splatctrl_cli.records import Bool, Float64, Stamps
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_margins import KeptMargin, SelfSurfaces, sphere_gaps
from splatctrl_cli.robot.sphere_files import sphere_names
from splatctrl_cli.voxels import EvidenceClass

KINDS = len(EvidenceClass)
NEAR_COLUMNS: Mapping[str, tuple[int, ...]] = {  # columns of evidence about the arm, with their shapes at a state
    **dict.fromkeys(("evidence_age", "evidence_ahead", "unseen", "assumed"), ()),
    **{"unseen_path": (), "unseen_path_place": (3,)},
    **{"blind_to_surface": (), "blind_to_surface_place": (3,)},
    **{"class_shares": (KINDS,), "class_distance": (KINDS,), "class_places": (KINDS * 3,)},
}


def blocks_of(scene: KnownScene, robot: RobotModel, stamps: Stamps) -> Iterator[tuple[int, int]]:
    """Ranges of at most BLOCK stamps (T,), each with one scene and one robot surface."""
    first = 0
    while first < len(stamps):
        known, last = scene.at(int(stamps[first])), first + 1
        changes = [stamp for stamp in robot.changes if stamp > stamps[first]]
        end = min(first + BLOCK, len(stamps), *np.searchsorted(stamps, changes).tolist())
        while last < end and scene.at(int(stamps[last])) is known:
            last += 1
        yield first, last
        first = last


class ReplayRecord:
    """Audit of T states in the scenes known at their times.

    trace: `audit_columns`, and columns by state. `obstacle`: in words, the nearest to the closest sphere.
    `map_age_s`. `clearance_between` [m]: bound since the state before, NaN at the first; `is_met`: 1 if a posture on
    the way attains the bound. `unbounded_s`: time without a bound. `clearance_surface` [m]: of the body.
    `clearance_splats` [m]: of the spheres to splats only. `velocity_share`, `acceleration_share`: of the limits, with
    their joints. `NEAR_COLUMNS`: NaN where not evaluated.

    hindsight: later depth that covers times without depth about the arm. newer_depth: later depth of states judged by
    an older map. closest: gap [m] and stamp of link pairs below their margin.
    """

    def __init__(
        self,
        model: RobotModel,
        scene: KnownScene,
        *,
        config: Config,
        max_map_age: float,
        is_continuous: bool = True,
        declared: Declarations | None = None,
        first_state_ns: int = 0,
        surfaces: SelfSurfaces | None = None,
        pair_margins: Sequence[KeptMargin] = (),
    ) -> None:
        """Start an empty record.

        is_continuous: False if the arm is re-anchored, so that nothing is bounded between states. declared: intended
        contact, at times from `first_state_ns`. surfaces: for self-collision; None uses the spheres.
        """
        self._declared, self._first_state_ns = declared or Declarations(), first_state_ns
        self.trace = Trace()
        self.fields: tuple[str, ...] = ()
        self._robot = self._model = model
        self._scene, self._max_map_age = scene, max_map_age
        self._margin, self._longest = config.control.margin, config.verdict.longest_interval
        self.fixed_parts = FixedParts(model, 2.0 * (self._margin - fixed.SLIGHTLY_UNDER))
        self._spheres = sphere_names(model.sphere_set)
        self._surfaces, self._pair_margins = surfaces, pair_margins
        self._enough = max(config.control.self_margin, config.control.margin)
        self.closest: dict[KeptMargin, tuple[float, int]] = {}
        spheres = [f"{self._spheres[a]} and {self._spheres[b]}" for a, b in model.self_pairs()]
        self._pairs = spheres if surfaces is None else surfaces.names
        self._reach, self._is_continuous = Reach.of(model), is_continuous
        limit = np.asarray(config.control.max_acceleration, np.float64)
        self._limits = MotionLimits(
            np.asarray(model.velocity_limit),
            np.broadcast_to(limit, model.velocity_limit.shape) if limit.any() else None,
        )
        self._near = NearSpace(model, config.control.margin, max_map_age)
        self._posture_before: Float64 | None = None  # at the end of the last block
        self.hindsight = Hindsight(scene, self._near, config.control.margin, self.clearance_in)
        self.newer_depth = NewerDepth(scene, config.control.margin - fixed.SLIGHTLY_UNDER, self.clearance_in)
        self._before: tuple[int, Float64, Float64] | None = None  # the last state: stamp, position, velocity
        self._last_scene: KnownFields | None = None
        self._was_free: Bool | None = None  # voxels (X, Y, Z), in any scene before

    def measure_block(self, stamps: Stamps, positions: Float64, velocities: Float64) -> AuditTrace:
        """Audit and store the next block of states (T, J), which share one scene."""
        scene, self._model = self._scene, self._robot.at(int(stamps[0]))
        part = audit(self._model, stamps, positions, lambda stamp: scene.at(stamp).distances, observed=scene.observed)
        part = self._look_at_self(self._judge_scene(part))
        self.fields = tuple(part.clearance)
        self.newer_depth.add(stamps, positions, part.clearance["exact"].distance)
        strain = self._limits.add(stamps, positions if self._is_continuous else np.zeros_like(positions))
        joints = self._model.joint_names
        self._look_at_statics(part)
        columns = {
            **audit_columns(part, self._spheres, joints, self._pairs),
            "obstacle": ["" if obstacle is None else str(obstacle) for obstacle in self._nearest(part)],
            "map_age_s": np.array([scene.age_s(stamp) for stamp in stamps.tolist()]),
            **self._bound(part, velocities),
            "velocity_share": strain.velocity,
            "velocity_joint": names_at(joints, strain.velocity_joint),
            "acceleration_share": strain.acceleration,
            "acceleration_joint": names_at(joints, strain.acceleration_joint),
            **self._look_around(part),
            "clearance_splats": self._clearance_of_splats(part),
        }
        self.trace.append(columns)
        return part

    def events(self) -> tuple[Event, ...]:
        """Events of all states, and of a controller's `step_columns` if the trace has them."""
        trace, number = self.trace, {name: number for number, name in enumerate(self._spheres)}
        signals = [
            *audit_signals(trace, self.fields, self._margin),
            *motion_signals(trace, self._margin - fixed.SLIGHTLY_UNDER, self._max_map_age),
            *(step_signals(trace) if "rung" in trace else ()),
        ]

        def near(kind: EventKind, name: str, at: int) -> Obstacle | None:
            if name not in number or kind is EventKind.WITHOUT_DISTANCE:
                return None
            stamp = int(trace.rows("stamp_ns")[at])
            center = self._robot.at(stamp).sphere_centers(trace.rows("q")[at])[[number[name]]]
            return self._scene.at(stamp).obstacles(center)[0]

        return events_of(trace.stamp_ns, signals, near)

    def _judge_scene(self, part: AuditTrace) -> AuditTrace:
        """Leave declared contact out, and let objects approach until the next map."""
        clearance, of_spheres, moving = dict(part.clearance), dict(part.of_spheres), self._reach.moving
        known = self._scene.at(int(part.stamp_ns[0]))
        for name, each in part.of_spheres.items():
            judged = self._unexpected(known, part.stamp_ns, part.position, each)
            if name == "exact":
                judged = self._approached(
                    part.stamp_ns, part.position, judged, lambda later: later.distances["exact"]
                )
            of_spheres[name], nearest = judged, judged.argmin(axis=1)
            clearance[name] = Clearance(distance=judged[np.arange(len(judged)), nearest], sphere=moving[nearest])
        return replace(part, clearance=clearance, of_spheres=of_spheres)

    def _approached(
        self, stamps: Stamps, positions: Float64, each: Float64, pick: Callable[[KnownFields], DistanceFunction]
    ) -> Float64:
        """Lower clearances `each` (T, M) [m] linearly in time to the next map's clearances.

        This assumes that objects approach at constant speed. Maps known later than their stamp, or over
        `UNWATCHED_NS` apart, change nothing. pick: selects a map's distance.
        """
        scene, now_ns = self._scene, int(stamps[0])
        first, next_ns = scene.depth_ns(now_ns), scene.next_ns(now_ns)
        if first is None or next_ns is None or next_ns != scene.depth_ns(next_ns):
            return each
        if next_ns - first > fixed.UNWATCHED_NS:
            return each
        known = scene.at(next_ns)
        later = self._clearances_in(known, self._model, stamps, positions, pick(known))
        share, is_lower = (stamps - first) / (next_ns - first), (later < each) & np.isfinite(each)
        return each + share[:, None] * np.subtract(later, each, out=np.zeros_like(each), where=is_lower)

    def _clearances_in(
        self, known: KnownFields, robot: RobotModel, stamps: Stamps, positions: Float64, distance_to: DistanceFunction
    ) -> Float64:
        return self._unexpected(known, stamps, positions, moving_clearance(robot, positions, distance_to)[1])

    def _unexpected(self, known: KnownFields, stamps: Stamps, positions: Float64, each: Float64) -> Float64:
        """Clearances `each` (T, M) [m] of moving spheres, infinite where contact is declared."""
        if not self._declared.expected_contact:
            return each
        links, unexpected = self._model.sphere_set.links, each.copy()
        for state, column in zip(*np.nonzero(each < self._margin), strict=True):
            sphere = int(self._reach.moving[column])
            center = self._model.sphere_centers(positions[state])[[sphere]]
            place = np.array(known.obstacles(center)[0].position)
            if self._declared.find_expected(links[sphere], place, (int(stamps[state]) - self._first_state_ns) * 1e-9):
                unexpected[state, column] = np.inf
        return unexpected

    def clearance_in(self, scene_ns: int, stamps: Stamps, positions: Float64) -> Float64:
        """Return clearances (T,) [m] of states (T, J) in the scene known at `scene_ns`, without declared contact."""
        known, gaps = self._scene.at(scene_ns), []
        for its in np.split(np.arange(len(stamps)), np.searchsorted(stamps, self._robot.changes)):
            if len(its):
                robot = self._robot.at(int(stamps[its[0]]))
                each = self._clearances_in(known, robot, stamps[its], positions[its], known.distances["exact"])
                gaps.append(each.min(axis=1))
        return np.concatenate(gaps)

    def _look_at_self(self, part: AuditTrace) -> AuditTrace:
        """Use gaps of link surfaces where known, and record pairs below their margin."""
        surfaces, gaps = self._surfaces, np.empty((len(part.position), 0))
        if surfaces is not None:
            gaps = surfaces.gaps(part.position, self._model.sphere_centers_batch(part.position), self._enough)
            nearest = gaps.argmin(axis=1) if gaps.size else np.full(len(gaps), -1)
            part = replace(part, self_clearance=gaps.min(axis=1, initial=np.inf), self_pair=nearest)
        for pair in self._pair_margins:
            number = None if surfaces is None else surfaces.number_of(pair.links)
            own = sphere_gaps(self._model, pair.links, part.position) if number is None else gaps[:, number]
            at = int(own.argmin())
            if own[at] < min(pair.apart, self.closest.get(pair, (np.inf, 0))[0]):
                self.closest[pair] = float(own[at]), int(part.stamp_ns[at])
        return part

    def _bound(self, part: AuditTrace, velocities: Float64) -> NamedColumns:
        """Bound the clearance between each state and the state before, in this block's scene."""
        known = self._scene.at(int(part.stamp_ns[0])).distances
        name = "certified" if "certified" in known else "exact"
        is_surface = part_clearances(self._model, part.position[:1], known[name])[1]
        deficit = self._reach.radii - self._model.sphere_set.radii[self._reach.moving]
        deficit[is_surface] = 0.0
        stamps, positions, at_states = part.stamp_ns, part.position, part.of_spheres[name] - deficit
        if self._before is not None:
            stamp, q, velocity = self._before
            earlier = clearances(self._model, self._reach, q[None], known[name])
            earlier[:, np.isinf(at_states[0])] = np.inf  # contact declared now was declared on the way
            stamps, positions = np.concatenate([[stamp], stamps]), np.concatenate([q[None], positions])
            velocities = np.concatenate([velocity[None], velocities])
            at_states = np.concatenate([earlier, at_states])
        between = between_states(
            self._model,
            self._reach,
            stamps,
            positions,
            velocities,
            at_states,
            known[name],
            margin=self._margin - fixed.SLIGHTLY_UNDER,
            longest=self._longest,
        )
        self._before = int(stamps[-1]), positions[-1], velocities[-1]
        first = (
            [] if len(between.lower) == len(part.stamp_ns) else [np.nan]
        )  # the motion's first state has none before
        seconds = np.where(between.is_bounded | (not self._is_continuous), 0.0, np.diff(stamps) * 1e-9)
        lower = np.where(between.is_bounded & self._is_continuous, between.lower, np.nan)
        return {
            "clearance_between": np.concatenate([first, lower]),
            "unbounded_s": np.nan_to_num(np.concatenate([first, seconds])),
            "is_met": np.nan_to_num(np.concatenate([first, between.is_met])),
            "clearance_surface": at_states[-len(part.stamp_ns) :].min(axis=1),
        }

    def _look_at_statics(self, part: AuditTrace) -> None:
        stamp = int(part.stamp_ns[0])
        known = self._scene.at(stamp)
        if known is self._last_scene:
            return
        self._last_scene, before, seen = known, self._was_free, self._scene.seen_at(stamp)
        was_free = None
        if seen is not None and before is not None:
            was_free = partial(observed_at, before.view(np.uint8), seen.origin, seen.voxel)
        if seen is not None and seen.is_free is not None:  # the final map has no states
            self._was_free = seen.is_free if before is None else before | seen.is_free
        self.fixed_parts.look(known.distances["exact"], part.position[0], was_free)

    def _look_around(self, part: AuditTrace) -> NamedColumns:
        num = len(part.stamp_ns)
        columns = {name: np.full((num, *shape), np.nan) for name, shape in NEAR_COLUMNS.items()}
        if self._scene.has_seen_times:
            self.hindsight.add(part.stamp_ns, part.position)
        for at, is_timed in self._near.choose(part.stamp_ns, self._model.sphere_centers_batch(part.position)).items():
            stamp = int(part.stamp_ns[at])
            if (known := self._scene.seen_at(stamp)) is not None:
                exact = self._scene.at(stamp).distances["exact"]
                before, q = part.position[at - 1] if at else self._posture_before, part.position[at]
                way = self._near.postures_between(before, q) if before is not None and self._is_continuous else ()
                accounts = [self._near.look(stamp, each, known, exact) for each in (q, *way)]
                for name, value in _fold_accounts(accounts).items():
                    columns[name][at] = value
                if not self._scene.has_seen_times:
                    columns["assumed"][at] = np.nan  # space seen free once may be occupied now
                elif is_timed:
                    columns["evidence_age"][at], columns["evidence_ahead"][at] = accounts[0].age, accounts[0].ahead
                    self.hindsight.looked(stamp, accounts[0].age)
        self._posture_before = part.position[-1]
        return columns

    def _clearance_of_splats(self, part: AuditTrace) -> Float64:
        alone, splats = part.clearance["exact"].distance.copy(), attrgetter("splats_alone")
        low = np.flatnonzero(alone < self._margin - fixed.SLIGHTLY_UNDER)
        if len(low):
            stamps, positions = part.stamp_ns[low], part.position[low]
            known = self._scene.at(int(stamps[0]))
            each = self._clearances_in(known, self._model, stamps, positions, splats(known))
            alone[low] = self._approached(stamps, positions, each, splats).min(axis=1)
        return alone

    def _nearest(self, part: AuditTrace) -> list[Obstacle | None]:
        nearest = part.clearance["barrier"]
        closest: list[Obstacle | None] = [None] * len(part.stamp_ns)
        if len(states := np.flatnonzero(np.isfinite(nearest.distance))):
            centers = self._model.sphere_centers_batch(part.position[states])
            points = np.ascontiguousarray(centers[np.arange(len(states)), nearest.sphere[states]])
            obstacles = self._scene.at(int(part.stamp_ns[0])).obstacles(points)
            for state, obstacle in zip(states.tolist(), obstacles, strict=True):
                closest[state] = obstacle
        return closest


def _fold_accounts(accounts: Sequence[Account]) -> dict[str, float | Float64]:
    """Fold the accounts of a state and the postures before it.

    Shares by class are the state's own. Distances are the least, unseen and assumed shares the largest over all
    postures.
    """
    shares, nearest = (np.array([getattr(each, name) for each in accounts]) for name in ("shares", "nearest"))
    least, places = nearest.argmin(axis=0), np.array([each.places for each in accounts])
    unseen, blind = (min(accounts, key=attrgetter(name)) for name in ("unseen_path", "blind_to_surface"))
    return {
        "class_shares": shares[0],
        "class_distance": nearest.min(axis=0),
        "class_places": places[least, np.arange(KINDS)].ravel(),
        "unseen": float(shares[:, NEVER_SEEN].sum(axis=1).max()),
        "assumed": max(each.assumed for each in accounts),
        "unseen_path": unseen.unseen_path,
        "unseen_path_place": unseen.unseen_path_place,
        "blind_to_surface": blind.blind_to_surface,
        "blind_to_surface_place": blind.blind_place,
    }

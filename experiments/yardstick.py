"""Motions of one task side by side: what IV reports of each, by one function for all of them.

T states, M moving spheres, J joints.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from experiments.paths import effector_length, joint_length
from splatctrl_cli.blocks import (
    Bool,
    ControlConfig,
    DistanceFunction,
    DistancesAt,
    Float64,
    RobotModel,
    Stamps,
    audit,
    is_at_goal,
    pose_error,
    runs_of,
)

CHUNK = 256  # states whose spheres are asked at once

TrueDistance = Callable[[Float64, int], Float64]
"""points (Q, 3) [m], world, and a stamp [ns] -> distance (Q,) [m] to what is really there."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """T states at stamp_ns (T,), position (T, J) [rad]; between them the joints move straight.

    is_intervened (T,): where something other than the task shaped the motion; None where nothing could.
    """

    stamp_ns: Stamps
    position: Float64
    is_intervened: Bool | None = None


@dataclass(frozen=True, kw_only=True)
class MotionFigures:
    """The figures of a motion (IV).

    has_arrived: at its end the frame is at the goal's pose; is_success: and no state is in collision by the
    controller's field, or where it has no distance. joint_path [rad], effector_path [m], effector_turn [degrees];
    clearance [m]: the least of every distance over the states, by name; barrier (T,) [m]: the controller's at each;
    proved [m]: `proved_clearance`;
    true_clearance [m] over the states, None without a truth; num_interventions: intervals, None where nothing could
    intervene. Distances that are missing are left out of the least ones, which are NaN where all are missing.
    """

    has_arrived: bool
    is_success: bool
    duration: float
    joint_path: float
    effector_path: float
    effector_turn: float
    clearance: Mapping[str, float]
    barrier: Float64
    proved: float
    true_clearance: float | None
    num_interventions: int | None


@dataclass(frozen=True, kw_only=True)
class Yardstick:
    """Measures of all motions of a task: the frame, the pose (4, 4) that it should reach, and distances.

    distances_at names the distances known at a stamp, the controller's own as ``barrier``; certified_at: for
    `proved_clearance`; truth: None if unknown.
    """

    model: RobotModel
    frame: str
    T_world_goal: Float64
    config: ControlConfig
    distances_at: DistancesAt
    certified_at: Callable[[int], DistanceFunction]
    truth: TrueDistance | None = None

    def figures(self, motion: Motion) -> MotionFigures:
        """The figures of a motion, in the scene known at each of its stamps."""
        of_states = audit(self.model, motion.stamp_ns, motion.position, self.distances_at)
        clearance = {name: of.distance for name, of in of_states.clearance.items()}
        error = pose_error(self.model.frame_pose(motion.position[-1], self.frame), self.T_world_goal)
        has_arrived = is_at_goal(error, self.config)
        moved, turned = effector_length(self.model, motion.position, self.frame)
        return MotionFigures(
            has_arrived=has_arrived,
            is_success=has_arrived and bool(np.all(clearance["barrier"] > 0)),
            duration=float(motion.stamp_ns[-1] - motion.stamp_ns[0]) * 1e-9,
            joint_path=joint_length(motion.position),
            effector_path=moved,
            effector_turn=turned,
            clearance={name: float(np.fmin.reduce(distance)) for name, distance in clearance.items()},
            barrier=clearance["barrier"],
            proved=proved_clearance(self.model, motion, self.certified_at),
            true_clearance=None if self.truth is None else _true_clearance(self.model, motion, self.truth),
            num_interventions=None if motion.is_intervened is None else len(runs_of(motion.is_intervened)),
        )


def proved_clearance(model: RobotModel, motion: Motion, certified_at: Callable[[int], DistanceFunction]) -> float:
    """Lower bound [m] of all moving spheres' distances, at the states and between them; NaN if one is missing.

    certified_at gives at a stamp a lower bound of a 1-Lipschitz distance, the same object for the same scene. Half
    of the way to the next state and half of the way from the last one count by the scene of the state: over each, a
    sphere goes no farther than half of what its lever arms allow for the whole.
    """
    moving = np.flatnonzero(model.moving_spheres)
    travel = np.abs(np.diff(motion.position, axis=0)) @ model.lever_arms()[moving].T / 2
    still = np.zeros((1, len(moving)))
    beside = np.maximum(np.concatenate([travel, still]), np.concatenate([still, travel]))
    least = np.inf
    for chosen, distance_to in _by_scene(motion.stamp_ns, certified_at):
        centers = model.sphere_centers_batch(motion.position[chosen])[:, moving]
        distance = distance_to(np.ascontiguousarray(centers).reshape(-1, 3)).reshape(-1, len(moving))
        least = float(np.minimum(least, np.min(distance - model.sphere_set.radii[moving] - beside[chosen])))
    return least


def _true_clearance(model: RobotModel, motion: Motion, truth: TrueDistance) -> float:
    moving = np.flatnonzero(model.moving_spheres)
    centers = model.sphere_centers_batch(motion.position)[:, moving]
    radii = model.sphere_set.radii[moving]
    return min(
        float(np.min(truth(np.ascontiguousarray(points), int(stamp)) - radii))
        for points, stamp in zip(centers, motion.stamp_ns, strict=True)
    )


def _by_scene(
    stamp_ns: Stamps, certified_at: Callable[[int], DistanceFunction]
) -> Iterator[tuple[slice, DistanceFunction]]:
    """Runs of at most CHUNK states that see the same scene."""
    first = 0
    while first < len(stamp_ns):
        scene, last = certified_at(int(stamp_ns[first])), first + 1
        while last < min(len(stamp_ns), first + CHUNK) and certified_at(int(stamp_ns[last])) is scene:
            last += 1
        yield slice(first, last), scene
        first = last

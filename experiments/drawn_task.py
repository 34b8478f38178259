"""A task in a random environment: a start, a goal and a path between them among the true solids."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.environments import Environment, drawn, ring_of_cameras
from experiments.solids import Ball, Cuboid, Rod, Solid, Solids
from splatctrl_cli import InputError
from splatctrl_cli.blocks import (
    PEAK,
    Clearance,
    ControlConfig,
    Float64,
    Motion,
    PlannerConfig,
    Primitive,
    RecordingOptions,
    RobotModel,
    Scene,
    goal_postures,
    plan,
    random_postures,
)

TASK_CLEARANCE = 0.03  # [m] that a way through a drawn environment keeps: the margin, and what a map errs by
TASK_SPARE = 0.002  # [m] more of start and goal
TASK_ENVIRONMENTS = 50  # drawn until one has a way
TASK_GUESSES = 24  # random postures that the search for a place begins with
TASK_POSTURES = 4  # at a goal
TASK_APART = 0.20  # [m] of start and goal
MOVING = 0.88  # of a recording; the rest is at its ends


@dataclass(frozen=True, kw_only=True)
class Task:
    """waypoints (W, J) [rad] from start to goal, no nearer to anything than `TASK_CLEARANCE`; T_world_goal (4, 4) of
    the arm's tip. num_refused: pairs of places without a path between them, and environments without any path.
    """

    environment: Environment
    waypoints: Float64
    T_world_goal: Float64
    num_refused: int

    def scene(self, model: RobotModel, options: RecordingOptions, num_cameras: int) -> Scene:
        """The environment with its cameras and the motion from rest to rest."""
        weights = np.max(np.abs(np.diff(self.waypoints, axis=0)) / model.velocity_limit, axis=1) * PEAK
        times = 0.5 * (1 - MOVING) + MOVING * np.concatenate([[0.0], np.cumsum(weights)]) / weights.sum()
        return Scene(
            primitives=self.environment.primitives,
            temporary=(),
            motion=Motion(times=times * options.duration_s, waypoints=self.waypoints),
            cameras=ring_of_cameras(num_cameras, options.width, options.height),
        )


def task_of(kind: str, seed: int, model: RobotModel) -> Task:
    """The task that a seed draws in one of `ENVIRONMENTS`; raises InputError if `TASK_ENVIRONMENTS` environments have
    no task.
    """
    num_refused = 0
    for attempt in range(TASK_ENVIRONMENTS):
        environment = drawn(kind, np.random.default_rng([seed, attempt]))
        room = Clearance.of(model, solids_of(environment.primitives), margin=TASK_CLEARANCE)
        for start, goals, T in _pairs(environment, room, model):
            found = plan(room, start, goals, PlannerConfig())
            if found.is_solved:
                return Task(
                    environment=environment, waypoints=found.waypoints, T_world_goal=T, num_refused=num_refused
                )
            num_refused += 1
        num_refused += 1
    raise InputError(
        f"{model.urdf.path}: expected a way in one of {TASK_ENVIRONMENTS} of kind {kind}, got none",
        remedy="give another --seed, or an arm of 0.8 m of reach",
    )


def solids_of(primitives: Sequence[Primitive]) -> Solids:
    """The same as solids that a planner asks."""
    return Solids(solids=[_solid(primitive) for primitive in primitives])


def _solid(primitive: Primitive) -> Solid:
    T, size = primitive.T_world_shape, primitive.size
    if primitive.kind == "box":
        return Cuboid(size=np.array(size), T_world_shape=T)
    if primitive.kind == "sphere":
        return Ball(center=T[:3, 3], radius=size[0])
    return Rod(radius=size[0], length=size[1], T_world_shape=T, is_round=primitive.kind == "capsule")


def _pairs(
    environment: Environment, room: Clearance, model: RobotModel
) -> Iterator[tuple[Float64, Float64, Float64]]:
    """Yield a start (J,), goals (G, J) of one tip pose, and that pose, for places far apart."""
    tip, guesses = (
        model.frame_names[-1],
        np.array([model.middle, *random_postures(model, TASK_GUESSES, seed=0)]),
    )
    reached: list[tuple[Float64, Float64]] = []
    for place in environment.places:
        free = goal_postures(model, tip, place, guesses, ControlConfig(), at_most=TASK_POSTURES)
        free = free[room.at(free) > TASK_SPARE] if len(free) else free
        if not len(free):
            continue
        for before, T in reached:
            if np.linalg.norm(T[:3, 3] - place[:3, 3]) > TASK_APART:
                yield before[0], free, place
        reached.append((free, place))

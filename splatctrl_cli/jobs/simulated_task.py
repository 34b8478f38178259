"""A task in a drawn environment: a start, a goal and a way between them, found among the true solids."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config import ControlConfig, PlannerConfig, fixed
from splatctrl_cli.errors import InputError
from splatctrl_cli.planner.birrt import plan
from splatctrl_cli.planner.configuration_clearance import Clearance
from splatctrl_cli.planner.planned import goal_postures
from splatctrl_cli.planner.solid_scene import Ball, Cuboid, Rod, Solid, Solids
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import random_postures
from splatctrl_cli.simulate.arm import PEAK, Motion
from splatctrl_cli.simulate.environments import Environment, drawn, ring_of_cameras
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import RecordingOptions, Scene

MOVING = 0.88  # of a recording; the rest is at its ends


@dataclass(frozen=True, kw_only=True)
class Task:
    """waypoints (W, J) [rad] from start to goal, no nearer to anything than `fixed.TASK_CLEARANCE`; T_world_goal
    (4, 4) of the arm's tip. num_refused: pairs of places without a way between them, and environments without any.
    """

    environment: Environment
    waypoints: Float64
    T_world_goal: Float64
    num_refused: int

    def scene(self, model: RobotModel, options: RecordingOptions) -> Scene:
        """The environment with its cameras and the motion from rest to rest."""
        weights = np.max(np.abs(np.diff(self.waypoints, axis=0)) / model.velocity_limit, axis=1) * PEAK
        times = 0.5 * (1 - MOVING) + MOVING * np.concatenate([[0.0], np.cumsum(weights)]) / weights.sum()
        return Scene(
            primitives=self.environment.primitives,
            temporary=(),
            motion=Motion(times=times * options.duration_s, waypoints=self.waypoints),
            cameras=ring_of_cameras(options.num_cameras, options.width, options.height),
        )


def task_of(kind: str, seed: int, model: RobotModel) -> Task:
    """The task that a seed draws in one of `ENVIRONMENTS`; raises InputError where an arm finds none in
    `fixed.TASK_ENVIRONMENTS` environments.
    """
    num_refused = 0
    for attempt in range(fixed.TASK_ENVIRONMENTS):
        environment = drawn(kind, np.random.default_rng([seed, attempt]))
        room = Clearance.of(model, solids_of(environment.primitives), margin=fixed.TASK_CLEARANCE)
        for start, goals, T in _pairs(environment, room, model):
            found = plan(room, start, goals, PlannerConfig())
            if found.is_solved:
                return Task(
                    environment=environment, waypoints=found.waypoints, T_world_goal=T, num_refused=num_refused
                )
            num_refused += 1
        num_refused += 1
    raise InputError(
        f"{model.urdf.path}: expected a way in one of {fixed.TASK_ENVIRONMENTS} of kind {kind}, got none",
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
    """A start (J,), goals (G, J) that are one pose of the tip, and that pose, of places that are apart."""
    tip, guesses = (
        model.frame_names[-1],
        np.array([model.middle, *random_postures(model, fixed.TASK_GUESSES, seed=0)]),
    )
    reached: list[tuple[Float64, Float64]] = []
    for place in environment.places:
        free = goal_postures(model, tip, place, guesses, ControlConfig(), at_most=fixed.TASK_POSTURES)
        free = free[room.at(free) > fixed.TASK_SPARE] if len(free) else free
        if not len(free):
            continue
        for before, T in reached:
            if np.linalg.norm(T[:3, 3] - place[:3, 3]) > fixed.TASK_APART:
                yield before[0], free, place
        reached.append((free, place))

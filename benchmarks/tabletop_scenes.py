"""Random tables for the simulated arm: the truth, what its cameras saw of it, the map made of that, and a task."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.random_tabletop import random_things
from benchmarks.scenes import sample_robot
from splatctrl_cli.config import Config
from splatctrl_cli.control.goals import pose_error
from splatctrl_cli.evaluate.views import seen_by
from splatctrl_cli.kernels.chain import pair_gaps
from splatctrl_cli.records import Box, Float64, RgbdFrame, SplatSet
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.posture import posture_of
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.render import DepthNoise, Renderer
from splatctrl_cli.simulate.tabletop import arm_solids, cameras, furniture
from splatctrl_cli.simulate.truth import distance_to

FRAME = "hand"
SIZE = (320, 240)  # of the images [px]
NUM_TIME_STEPS = 5  # of each camera, the arm at rest
SPACING = 0.004  # [m] of the samples of the things' surfaces; the table 5 mm, floor and walls 2 cm
HAND = ((0.32, -0.48, 0.14), (0.72, 0.48, 0.30))  # [m] where the hand starts and ends; its fingertips are 11 cm lower
LEAST_TRAVEL = 0.35  # [m] of the hand, from side to side
LEAST_CLEARANCE = 0.06  # [m] of the arm by the truth at both ends
HAND_CORNERS = np.array([(0, 0, 0), (0, -0.09, 0.033), (0, 0.09, 0.033), (0, -0.04, 0.11), (0, 0.04, 0.11)])  # [m]
TILT = np.deg2rad(20.0)  # of the hand from straight down, at most
HOME = np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.1, 0.785])  # [rad]
STAMP_NS = 10**9


@dataclass(frozen=True, kw_only=True)
class Task:
    """From a posture (J,) to a pose (4, 4) of the hand, which some collision-free posture (J,) has."""

    start: Float64
    T_world_goal: Float64
    goal_posture: Float64


@dataclass(frozen=True, kw_only=True)
class TableScene:
    """One seeded table: what is there, and what three cameras recorded of it with the arm at the start."""

    seed: int
    primitives: tuple[Primitive, ...]
    task: Task
    frames: tuple[tuple[RgbdFrame, ...], ...]

    def distance(self, points_world: Float64) -> Float64:
        """Exact signed distance (Q,) [m] to everything that is there."""
        return distance_to(self.primitives, points_world, STAMP_NS)

    @cached_property
    def seen(self) -> "cKDTree[None]":
        """The samples of true surfaces that a camera measured."""
        points = np.concatenate([surface_points(p, _spacing(p)) for p in self.primitives])
        return cKDTree(points[seen_by(points, [frame for step in self.frames for frame in step])])

    def distance_to_seen(self, points_world: Float64) -> Float64:
        """Distance (Q,) [m] to what a camera saw; larger than exact by at most the samples' half spacing."""
        return np.asarray(self.seen.query(points_world)[0], dtype=np.float64)


def table_scene(seed: int) -> TableScene:
    """The scene of a seed; tasks are drawn anew until one has a collision-free posture at both ends."""
    things = random_things(seed)
    primitives = (*furniture(), *things)
    task = _task(np.random.default_rng([seed, 1]), primitives)
    return TableScene(seed=seed, primitives=primitives, task=task, frames=_recorded(seed, primitives, task.start))


def reconstructed(scene: TableScene, config: Config) -> SplatSet:
    """The map of the scene's frames, the arm's own splats labelled."""
    model = sample_robot()
    reach, base = model.reach(), model.base_position
    fitter = SceneFitter(config.scene, config.occupancy, Box(lower=base - reach, upper=base + reach), seed=scene.seed)
    q = scene.task.start
    for frames in scene.frames:
        fitter.step(frames, posture_of(model, q, {frame.stamp_ns: q for frame in frames}))
    return fitter.splats()


def surface_points(primitive: Primitive, spacing: float) -> Float64:
    """Points (K, 3) [m], world, on a primitive's surface, no point of it farther than about `spacing` from one."""
    if primitive.kind == "box":
        local = _box_points(np.array(primitive.size) / 2, spacing)
    elif primitive.kind == "cylinder":
        local = _cylinder_points(*primitive.size, spacing)
    else:
        radius = primitive.size[0]
        number = int(np.ceil(4 * np.pi * radius**2 / spacing**2))
        height = 1 - (2 * np.arange(number) + 1) / number
        turn = np.pi * (3 - np.sqrt(5)) * np.arange(number)
        rho = np.sqrt(1 - height**2)
        local = radius * np.column_stack([rho * np.cos(turn), rho * np.sin(turn), height])
    return local @ primitive.T_world_shape[:3, :3].T + primitive.T_world_shape[:3, 3]


def _spacing(primitive: Primitive) -> float:
    if primitive.name == "table":
        return 0.005
    return 0.02 if primitive.name in {p.name for p in furniture()} else SPACING


def _box_points(half: Float64, spacing: float) -> Float64:
    sides = [np.linspace(-h, h, max(int(np.ceil(2 * h / spacing)), 1) + 1) for h in half]
    faces = []
    for axis in range(3):
        u, v = (sides[k] for k in range(3) if k != axis)
        grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        faces += [np.insert(grid, axis, side, axis=1) for side in (-half[axis], half[axis])]
    return np.concatenate(faces)


def _cylinder_points(radius: float, height: float, spacing: float) -> Float64:
    angle = np.linspace(0, 2 * np.pi, max(int(np.ceil(2 * np.pi * radius / spacing)), 8), endpoint=False)
    z = np.linspace(-height / 2, height / 2, max(int(np.ceil(height / spacing)), 1) + 1)
    a, h = (grid.ravel() for grid in np.meshgrid(angle, z, indexing="ij"))
    side = np.column_stack([radius * np.cos(a), radius * np.sin(a), h])
    flat = _box_points(np.array([radius, radius, height / 2]), spacing)
    is_cap = (np.abs(flat[:, 2]) == height / 2) & (np.hypot(flat[:, 0], flat[:, 1]) <= radius)
    return np.concatenate([side, flat[is_cap]])


def _recorded(seed: int, primitives: Sequence[Primitive], q: Float64) -> tuple[tuple[RgbdFrame, ...], ...]:
    """Frames of the training cameras, `NUM_TIME_STEPS` times, with a depth camera's noise."""
    model = sample_robot()
    arm = arm_solids(model.urdf.shapes, {link: model.frame_pose(q, link) for link in model.urdf.links})
    training = [camera for camera in cameras(*SIZE) if camera.is_training]
    seen = [(camera, *Renderer(camera, primitives).image(arm)) for camera in training]
    noise = DepthNoise()
    return tuple(
        tuple(
            RgbdFrame(
                stamp_ns=STAMP_NS + 200_000_000 * step,
                camera=camera.name,
                color=color,
                depth=noise.applied(depth, np.random.default_rng([seed, number, step])),
                intrinsics=camera.intrinsics,
                T_world_camera=camera.T_world_camera,
            )
            for number, (camera, color, depth) in enumerate(seen)
        )
        for step in range(NUM_TIME_STEPS)
    )


def _task(rng: np.random.Generator, primitives: Sequence[Primitive]) -> Task:
    model = sample_robot()
    while True:
        start = _drawn_posture(rng, primitives)
        T_world_start = model.frame_pose(start, FRAME)
        for _ in range(20):
            posture = _drawn_posture(rng, primitives)
            T_world_goal = model.frame_pose(posture, FRAME)
            if abs(T_world_goal[1, 3] - T_world_start[1, 3]) >= LEAST_TRAVEL:
                return Task(start=start, T_world_goal=T_world_goal, goal_posture=posture)


def _drawn_posture(rng: np.random.Generator, primitives: Sequence[Primitive]) -> Float64:
    while True:
        T_world_hand = _hand_pose(rng)
        corners = HAND_CORNERS @ T_world_hand[:3, :3].T + T_world_hand[:3, 3]
        if np.min(distance_to(primitives, corners, STAMP_NS)) < LEAST_CLEARANCE:
            continue  # no posture can bring it there
        posture = _free_posture(rng, T_world_hand, primitives)
        if posture is not None:
            return posture


def _hand_pose(rng: np.random.Generator) -> Float64:
    """A hand that points down, tilted a little, with any turn about its axis of up to 60 degrees."""
    tilt, about, turn = rng.uniform(0, TILT), rng.uniform(0, 2 * np.pi), rng.uniform(-np.pi / 3, np.pi / 3)
    z = -np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), np.cos(tilt)])
    x = np.array([np.cos(turn), np.sin(turn), 0.0])
    x = (x - z * (x @ z)) / np.linalg.norm(x - z * (x @ z))
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = rng.uniform(*HAND)
    return T


def _free_posture(rng: np.random.Generator, T_world_hand: Float64, primitives: Sequence[Primitive]) -> Float64 | None:
    """A posture (J,) of the pose, `LEAST_CLEARANCE` from everything and 3 cm from itself; None if none is found."""
    model = sample_robot()
    for _ in range(4):
        q = _inverse(T_world_hand, np.clip(HOME + rng.normal(0, 0.4, len(HOME)), model.lower, model.upper))
        if q is None:
            continue
        centers, radii = model.sphere_centers(q), model.sphere_set.radii
        moving = model.moving_spheres
        clearance = np.min(distance_to(primitives, centers[moving], STAMP_NS) - radii[moving])
        if clearance >= LEAST_CLEARANCE and np.min(pair_gaps(centers, radii, model.self_pairs())[0]) >= 0.03:
            return q
    return None


def _inverse(T_world_hand: Float64, q: Float64) -> Float64 | None:
    """Damped least squares to 0.1 mm and 0.1 mrad, 5 degrees inside the limits; None where it does not get there."""
    model, inside = sample_robot(), np.deg2rad(5.0)
    for _ in range(200):
        error = pose_error(model.frame_pose(q, FRAME), T_world_hand)
        if np.max(np.abs(error)) < 1e-4:
            return q
        jacobian = model.frame_jacobian(q, FRAME)
        q = q + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), np.clip(error, -0.1, 0.1))
        q = np.clip(q, model.lower + inside, model.upper - inside)
    return None

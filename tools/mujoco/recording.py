"""A recording from its seed and index: drawn, rendered, logged, with a file of its truth."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tools.mujoco.cell import Cell
from tools.mujoco.depth import Laser, Stereo, draw_sensor
from tools.mujoco.families import FAMILIES, ORDER
from tools.mujoco.images import Studio, views_of
from tools.mujoco.poses import Float64, inverse, pose, turn_rpy
from tools.mujoco.robots import ROBOTS, Robot, load_robot, write_tight_urdf
from tools.mujoco.stage import DURATION_S, NoPlaceError, Stage
from tools.mujoco.topics import Log, Transform, camera_transforms, log_name, opened_log
from tools.mujoco.truth import World, mujoco_difference, solid_document

RATE, JOINT_RATE, TF_RATE = 10.0, 100.0, 50.0  # [Hz]
FIRST_FRAME = 0.02  # [s]
JOINT_NOISE = 5e-5  # [rad]
SEG_EVERY = 5  # frames
DEPTH_SHARES = {"ideal": 0.2, "mild": 0.3, "real": 0.4, "laser": 0.1}
FORMAT_SHARES = {"mcap": 0.7, "sqlite": 0.15, "bag": 0.15}
TRIES = 20
ON_SITE = 61  # first seed whose robot does not stand at the origin of the log's root frame


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One recording before it is rendered."""

    seed: int
    index: int
    family: str
    depth: str
    sensor: Stereo | Laser | None
    kind: str
    stage: Stage

    @property
    def T_site_world(self) -> Float64 | None:
        """Where the log has the world (4, 4), None at its origin: a cell in a hall, or an arm that hangs or leans."""
        if self.seed < ON_SITE:
            return None
        rng = np.random.default_rng([self.seed, self.index, 3])
        lean = rng.choice([0.0, np.pi / 2, np.pi], p=[0.7, 0.15, 0.15])
        return pose(rng.uniform([-3, -3, 0], [3, 3, 1]), turn_rpy([lean, 0.0, rng.uniform(-np.pi, np.pi)]))

    @property
    def name(self) -> str:
        """Seed and index, family, robot, depth."""
        return f"{self.seed}-{self.index:04d}-{self.family}-{self.stage.robot.name}-{self.depth}"


def draw(seed: int, index: int) -> Plan:
    """The plan of a recording, determined by its seed and index. Families and robots take turns."""
    family = ORDER[index % len(ORDER)]
    robot = load_robot(list(ROBOTS)[(index + index // len(ORDER)) % len(ROBOTS)])
    rng = np.random.default_rng([seed, index])
    depth = str(rng.choice(list(DEPTH_SHARES), p=list(DEPTH_SHARES.values())))
    kind = str(rng.choice(list(FORMAT_SHARES), p=list(FORMAT_SHARES.values())))
    sensor = draw_sensor(depth, rng)
    for _ in range(TRIES):
        try:
            stage = Stage.draw(rng, robot, is_at_rest=FAMILIES[family].is_at_rest)
            FAMILIES[family].draw(stage)
            stage.add_clutter()
        except NoPlaceError:
            continue
        return Plan(seed=seed, index=index, family=family, depth=depth, sensor=sensor, kind=kind, stage=stage)
    raise NoPlaceError(f"{seed}/{index} {family} {robot.name}: expected a scene, found none in {TRIES} tries")


def record(seed: int, index: int, folder: Path) -> None:
    """Draw a recording and write it: the log, truth.json, truth.npz, seg/ and, of a tight robot, its URDF."""
    write(draw(seed, index), folder)


def write(plan: Plan, folder: Path) -> None:
    """Render and log a plan, and write its truth; truth.json comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = plan.stage.robot
    urdf = write_tight_urdf(robot, folder / "robot") if robot.description.is_tight else robot.urdf
    with opened_log(folder, plan.kind) as log:
        _write_log(plan, log, folder / "seg")
    times = np.arange(round(DURATION_S * JOINT_RATE) + 1) / JOINT_RATE
    q = plan.stage.motion.at(times)[0]
    world = World(robot=robot, solids=tuple(plan.stage.solids))
    seen, colliding = world.clearances(times, q)
    worst = int(np.argmin(seen.least))
    np.savez_compressed(
        folder / "truth.npz",
        t=times,
        q=q,
        visual=seen.least,
        collision=colliding.least,
        link=np.array(seen.link),
        object=np.array(seen.solid),
        per=seen.per,
        names=np.array([solid.name for solid in world.obstacles]),
    )
    document = {
        "case": plan.name,
        "seed": plan.seed,
        "index": plan.index,
        "family": plan.family,
        "robot": robot.name,
        "depth": plan.depth,
        "sensor": None if plan.sensor is None else vars(plan.sensor),
        "log": log_name(plan.kind),
        "cams": [camera.name for camera in plan.stage.cameras],
        "rate": RATE,
        "dur": DURATION_S,
        "urdf": str(urdf.relative_to(folder)) if urdf.is_relative_to(folder) else str(urdf),
        "root": robot.root,
        "joints": [joint.name for joint in robot.driven],
        "min_visual": float(seen.least[worst]),
        "min_collision": float(colliding.least.min()),
        "at": float(times[worst]),
        "link": seen.link[worst],
        "object": seen.solid[worst],
        "mujoco_difference": mujoco_difference(world, float(times[worst]), q[worst]),
        "K": {camera.name: camera.lens.matrix.tolist() for camera in plan.stage.cameras},
        "T_site_world": None if plan.T_site_world is None else plan.T_site_world.tolist(),
        "pose_errors": {name: T.tolist() for name, T in plan.stage.pose_errors.items()},
        "phases": {camera.name: camera.phase for camera in plan.stage.cameras},
        "solids": [solid_document(solid) for solid in plan.stage.solids],
    }
    (folder / "truth.json").write_text(json.dumps(document), encoding="utf-8")


def _write_log(plan: Plan, log: Log, seg: Path) -> None:
    stage, robot = plan.stage, plan.stage.robot
    cell = Cell(robot, stage.solids, views_of(stage.cameras), seed=plan.index)
    studio = Studio(cell, stage.cameras, plan.sensor)
    rng = np.random.default_rng([plan.seed, plan.index, 1])
    log.add_transforms(0.0, _static_transforms(plan), is_static=True)
    events = [(float(t), 0, k) for k, t in enumerate(np.arange(0.0, DURATION_S + 1e-9, 1 / JOINT_RATE))]
    for number, camera in enumerate(stage.cameras):
        taken = FIRST_FRAME + camera.phase + np.arange(round(DURATION_S * RATE)) / RATE
        events += [(float(t), 1 + number, k) for k, t in enumerate(taken) if t <= DURATION_S]
        (seg / camera.name).mkdir(parents=True, exist_ok=True)
    for time, what, count in sorted(events):
        q, velocity = (row[0] for row in stage.motion.at(np.array([time])))
        if what == 0:
            _log_state(robot, log, time, q + JOINT_NOISE * rng.standard_normal(len(q)), velocity)
            if count % round(JOINT_RATE / TF_RATE) == 0:
                log.add_transforms(time, _link_transforms(cell, q), is_static=False)
            continue
        camera = stage.cameras[what - 1]
        cell.place(q, time)
        image = studio.image(camera, [plan.seed, plan.index, 2, what, count])
        log.add_image(time, camera, image.color, image.depth)
        if count % SEG_EVERY == 0:
            cv2.imwrite(str(seg / camera.name / f"{count:04d}.png"), 255 * studio.is_robot(camera).astype(np.uint8))
    studio.close()


def _log_state(robot: Robot, log: Log, time: float, q: Float64, velocity: Float64) -> None:
    """The joint state, fingers that are held included."""
    names = [joint.name for joint in robot.driven]
    held = [joint.name for joint in robot.moved if joint.kind == "prismatic"]
    grip = np.full(len(held), robot.description.grip)
    log.add_joints(time, names + held, np.concatenate([q, grip]), np.concatenate([velocity, np.zeros(len(held))]))


def _static_transforms(plan: Plan) -> list[Transform]:
    """Transforms of the world at a site, of the robot's root, and of every camera at its logged pose."""
    out: list[Transform] = [] if plan.T_site_world is None else [("site", "world", plan.T_site_world)]
    if plan.stage.robot.root != "world":
        out.append(("world", plan.stage.robot.root, np.eye(4)))
    for camera in plan.stage.cameras:
        T = camera.T_parent_camera @ plan.stage.pose_errors.get(camera.name, np.eye(4))
        out += camera_transforms(camera, T, camera.link or "world")
    return out


def _link_transforms(cell: Cell, q: Float64) -> list[Transform]:
    poses = cell.link_poses(q[None])
    return [
        (joint.parent, joint.child, inverse(poses[joint.parent][0]) @ poses[joint.child][0])
        for joint in cell.robot.joints
    ]

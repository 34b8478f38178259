"""The problems of a study: environments drawn by a seed, and MotionBenchMaker's from an archive. Also their cameras'
views of an arm at rest, with slightly wrong poses.
"""

import os
import tarfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from scipy.spatial import cKDTree

from experiments.drawn_task import solids_of, task_of
from experiments.environments import ENVIRONMENTS, drawn_texture, ring_of_cameras
from experiments.solids import Solids
from splatctrl_cli import InputError
from splatctrl_cli.blocks import (
    START_NS,
    Camera,
    DepthNoise,
    Float64,
    Perturbation,
    Primitive,
    Renderer,
    RgbdFrame,
    RobotModel,
    arm_solids,
    arm_spheres_yaml,
    arm_urdf,
    back_project,
    pose_at,
    transform_from,
    transform_points,
)

ARCHIVE, ROBOT = "problems.tar.bz2", "panda_spherized.urdf"  # of MotionBenchMaker, in one folder
DATA = "SPLATCTRL_REAL_DATA"  # the folder that may hold vamp_panda
FAMILIES = ("bookshelf_small", "bookshelf_tall", "bookshelf_thin", "box", "cage", "table_pick", "table_under_pick")
PER_FAMILY = 50  # problems, from 1 on
KINDS = {"box": "box", "cylinder": "cylinder", "sphere": "sphere"}  # MoveIt's words and ours
ROOM = {  # size and middle [m] of floor and walls: what stands behind everything, beyond what the arm's map holds
    "floor": ((4.8, 4.4, 0.05), (0.1, 0.0, -1.60)),
    "wall_back": ((0.05, 4.4, 4.0), (-2.00, 0.0, 0.20)),
    "wall_front": ((0.05, 4.4, 4.0), (2.30, 0.0, 0.20)),
    "wall_left": ((4.8, 0.05, 4.0), (0.1, 2.00, 0.20)),
    "wall_right": ((4.8, 0.05, 4.0), (0.1, -2.00, 0.20)),
}
D435 = DepthNoise(baseline=0.05, max_range=6.0)
POSE_ERROR, POSE_TURN = 0.001, 0.05  # [m], [degrees] of each camera: somewhat more than `calibrate` leaves
STEP_NS = 200_000_000  # [ns] between time steps
SEEN_WITHIN = 0.02  # [m] of a measured point: a voxel
Step = tuple[RgbdFrame, ...]
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, kw_only=True)
class ProblemRequest:
    """Run the problem of a name into the folder `out`; problems: MotionBenchMaker's folder, for one of its own;
    methods: of the study; width [px] of the images.
    """

    problem: str
    out: Path
    study: str = "table2"
    problems: Path | None = None
    methods: tuple[str, ...] = ()
    width: int = 320
    force: bool = False
    threads: int = 0


@dataclass(frozen=True, kw_only=True)
class FittedRow:
    """A row of a study of fits: problem, method, reason of a failure, and psnr [dB] of held-out views."""

    environment: str
    number: int
    method: str
    error: str = ""
    psnr: float | None = None


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A motion between two postures (J,) [rad] among objects, world frame; number: the seed of a random problem."""

    environment: str
    number: int
    model: RobotModel
    things: tuple[Primitive, ...]
    start: Float64
    goal: Float64

    @property
    def name(self) -> str:
        """As on the command line."""
        return name_of(self.environment, self.number)

    @property
    def primitives(self) -> tuple[Primitive, ...]:
        """The truth: the things, and the room that they are in."""
        return (*self.things, *room())

    @property
    def solids(self) -> Solids:
        """The same, as a planner asks it."""
        return solids_of(self.primitives)


def name_of(environment: str, number: int) -> str:
    """Of a problem: environment and number."""
    return f"{environment}-{number:04d}"


def archive_of(given: Path | None) -> Path | None:
    """MotionBenchMaker's folder: the one that is given, or that of the data folder, if there is one.

    Raises InputError for a given one without problems or robot.
    """
    if given is None:
        found = Path(os.environ.get(DATA, "")) / "vamp_panda" / "resources" / "panda"
        return found.absolute() if DATA in os.environ and (found / ARCHIVE).is_file() else None
    for name in (ARCHIVE, ROBOT):
        if not (given / name).is_file():
            raise InputError(f"--problems {given}: has no {name}", remedy="give that of the Panda")
    return given.absolute()


def named(name: str, kinds: Collection[str], kind: str) -> tuple[str, int]:
    """Kind (one of `kinds`) and number in a problem's name, KIND-NUMBER. Raises InputError for another name."""
    first, _, number = name.rpartition("-")
    if first not in kinds or not number.isdecimal():
        raise InputError(f"--problem {name}: expected {kind.upper()}-NUMBER", remedy=f"{kind}s: {', '.join(kinds)}")
    return first, int(number)


def read_problem(name: str, archive: Path | None) -> Problem:
    """The problem of a name; archive: the folder of MotionBenchMaker's problems and their robot.

    Raises InputError for a name that is none, a folder without the problem, or one of another robot.
    """
    environment, number = named(name, (*ENVIRONMENTS, *FAMILIES), "environment")
    if environment in ENVIRONMENTS:
        model = simulated_arm()
        task = task_of(environment, number, model)
        return Problem(
            environment=environment,
            number=number,
            model=model,
            things=task.environment.primitives,
            start=task.waypoints[0],
            goal=task.waypoints[-1],
        )
    if archive is None:
        raise InputError(f"--problem {name}: is of MotionBenchMaker", remedy="give its folder with --problems")
    (found,) = read_archive(archive, panda(archive), [(environment, number)])
    return found


def room() -> list[Primitive]:
    """Floor and walls, so that a camera that looks past the objects gets depth."""
    return [
        Primitive(
            name=name,
            kind="box",
            size=size,
            T_world_shape=pose_at(middle),
            texture=drawn_texture(np.random.default_rng(number)),
        )
        for number, (name, (size, middle)) in enumerate(ROOM.items())
    ]


def simulated_arm() -> RobotModel:
    """The arm that `simulate` records."""
    with TemporaryDirectory() as folder:
        urdf, spheres = Path(folder) / "robot.urdf", Path(folder) / "robot_spheres.yaml"
        urdf.write_text(arm_urdf(), encoding="utf-8")
        spheres.write_text(arm_spheres_yaml(), encoding="utf-8")
        return RobotModel.from_urdf(urdf, spheres)


def panda(archive: Path) -> RobotModel:
    """The Panda that the problems are of, with its 59 spheres."""
    return RobotModel.from_urdf(archive / ROBOT)


def read_archive(archive: Path, model: RobotModel, wanted: Sequence[tuple[str, int]] | None = None) -> list[Problem]:
    """The problems by family and number, those `wanted` or all. Raises InputError as `read_problem`."""
    file, texts = archive / ARCHIVE, dict[tuple[str, int, str], bytes]()
    names = {(f"{family}_panda", f"{kind}{n:04d}"): (family, n, kind) for family, n, kind in _members(wanted)}
    try:
        with tarfile.open(file) as members:
            for member in members:
                path = Path(member.name)
                key = names.get((path.parent.name, path.stem))
                content = members.extractfile(member) if key is not None and member.isfile() else None
                if key is not None and content is not None:
                    texts[key] = content.read()
    except (OSError, EOFError, tarfile.TarError) as error:
        raise InputError(f"{file}: cannot be read: {error}", remedy="give MotionBenchMaker's archive") from None
    found = sorted({(family, number) for family, number, _ in texts})
    lacking = [name_of(*each) for each in wanted or () if tuple(each) not in found]
    if lacking or not found:
        what = ", ".join(lacking) or "problem"
        raise InputError(f"{file}: has no {what}", remedy="give MotionBenchMaker's archive")
    return [_problem(family, number, texts, model, file) for family, number in found]


def _members(wanted: Sequence[tuple[str, int]] | None) -> list[tuple[str, int, str]]:
    every = [(family, number) for family in FAMILIES for number in range(1, PER_FAMILY + 1)]
    return [(*each, kind) for each in (every if wanted is None else wanted) for kind in ("scene", "request")]


def _problem(
    family: str, number: int, texts: Mapping[tuple[str, int, str], bytes], model: RobotModel, file: Path
) -> Problem:
    where = f"{file}: {name_of(family, number)}"
    try:
        request, scene = (yaml.load(texts[family, number, kind], Loader) for kind in ("request", "scene"))
        state = request["start_state"]["joint_state"]
        (constraints,) = request["goal_constraints"]
        start = dict(zip(state["name"], state["position"], strict=True))
        goal = {c["joint_name"]: c["position"] for c in constraints["joint_constraints"]}
        things = scene["world"]["collision_objects"]
        solids = tuple(each for thing in things for each in _primitives(thing))
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise InputError(f"{where}: damaged: {type(error).__name__}: {error}") from None
    return Problem(
        environment=family,
        number=number,
        model=model,
        things=solids,
        start=_posture(start, model, where),
        goal=_posture(goal, model, where),
    )


def _primitives(thing: Mapping[str, Any]) -> list[Primitive]:
    """A MoveIt collision object's solids, with a texture each."""
    made = []
    for number, (solid, pose) in enumerate(zip(thing["primitives"], thing["primitive_poses"], strict=True)):
        size = tuple(float(value) for value in solid["dimensions"])
        name = f"{thing['id']}.{number}"
        seed = [len(thing["id"]), sum(map(ord, name))]
        made.append(
            Primitive(
                name=name,
                kind=KINDS[solid["type"]],
                size=size[::-1] if solid["type"] == "cylinder" else size,  # MoveIt: height, then radius
                T_world_shape=transform_from(pose["position"], pose["orientation"]),
                texture=drawn_texture(np.random.default_rng(seed)),
            )
        )
    return made


def _posture(by_name: Mapping[str, float], model: RobotModel, where: str) -> Float64:
    lacking = [name for name in model.joint_names if name not in by_name]
    if lacking:
        raise InputError(
            f"{where}: is of another robot: expected joint {lacking[0]}, got {', '.join(by_name) or 'none'}",
            remedy=f"give the folder with the robot of these problems as {ROBOT}",
        )
    return np.array([by_name[name] for name in model.joint_names], dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Views:
    """Time steps of frames, one of each camera, with the arm at rest at the problem's start."""

    steps: tuple[Step, ...]

    @property
    def frames(self) -> list[RgbdFrame]:
        """All of them, by time."""
        return [frame for step in self.steps for frame in step]

    def has_seen(self, points_world: Float64) -> list[bool]:
        """Mask (Q,) of points (Q, 3) with a camera's measurement within `SEEN_WITHIN`."""
        measured = np.concatenate([_points(frame) for frame in self.steps[0]])
        away = cKDTree(measured).query(points_world)[0] if len(measured) else np.full(len(points_world), np.inf)
        return [bool(each <= SEEN_WITHIN) for each in np.asarray(away)]


def views_of(problem: Problem, num_cameras: int, *, width: int, num_steps: int) -> Views:
    """Views of the first cameras of the ring, with noise, and pose errors like a calibration's."""
    cameras = ring_of_cameras(num_cameras, width, 3 * width // 4)
    arm = solids_at(problem.model, problem.start)
    return recorded(cameras, problem.primitives, arm, seed=problem.number, num_steps=num_steps)


def solids_at(model: RobotModel, q: Float64) -> list[Primitive]:
    """An arm's shapes as solids at joint positions q (J,)."""
    return arm_solids(model.urdf.shapes, {link: model.frame_pose(q, link) for link in model.urdf.links})


def recorded(
    cameras: Sequence[Camera],
    primitives: Sequence[Primitive],
    arm: Sequence[Primitive],
    *,
    seed: int,
    num_steps: int,
    first: int = 0,
) -> Views:
    """Time steps of frames from the step `first` on, with noise and pose errors drawn by `seed`."""
    images = [Renderer(camera, primitives, color_rays=0).image(arm) for camera in cameras]
    calibrated = Perturbation(pose_error=POSE_ERROR, pose_turn=POSE_TURN, seed=seed)
    poses = [calibrated.pose(camera.name, camera.T_world_camera) for camera in cameras]

    def frame(step: int, number: int) -> RgbdFrame:
        camera, (color, depth) = cameras[number], images[number]
        rng = np.random.default_rng([seed, number, step])
        return RgbdFrame(
            stamp_ns=START_NS + STEP_NS * step,
            camera=camera.name,
            color=color,
            depth=D435.applied(depth, rng, focal=camera.intrinsics.fx),
            intrinsics=camera.intrinsics,
            T_world_camera=poses[number],
        )

    steps = range(first, first + num_steps)
    return Views(steps=tuple(tuple(frame(step, n) for n in range(len(cameras))) for step in steps))


def _points(frame: RgbdFrame) -> Float64:
    """(Q, 3) [m], world, that a frame measured."""
    points = back_project(frame.intrinsics, frame.depth)[frame.depth > 0]
    return np.asarray(transform_points(frame.T_world_camera, points))

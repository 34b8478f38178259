"""The 350 Panda problems of MotionBenchMaker: MoveIt scenes of boxes and cylinders, and requests, in one archive."""

import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatctrl_cli.geometry import transform_from
from splatctrl_cli.planner.solid_scene import Ball, Cuboid, Rod, Solid, Solids
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel

ROBOT = Path("vamp_panda/resources/panda")
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One problem: start and goal (J,) [rad], in the order of the robot's joints."""

    family: str
    number: str
    scene: Solids
    start: Float64
    goal: Float64

    @property
    def name(self) -> str:
        """Family and number."""
        return f"{self.family} {self.number}"


def panda(real_data: Path) -> RobotModel:
    """The Panda with its 59 spheres."""
    return RobotModel.from_urdf(real_data / ROBOT / "panda_spherized.urdf")


def read_problems(real_data: Path, model: RobotModel) -> list[Problem]:
    """Every problem of the archive, by family and number."""
    texts: dict[tuple[str, str, str], bytes] = {}
    with tarfile.open(real_data / ROBOT / "problems.tar.bz2") as archive:
        for member in archive:
            content = archive.extractfile(member) if member.isfile() else None
            if content is not None:
                path = Path(member.name)
                texts[path.parent.name, path.stem[-4:], path.stem[:-4]] = content.read()
    problems = []
    for family, number, kind in sorted(texts):
        if kind == "request":
            request = yaml.load(texts[family, number, "request"], Loader)
            scene = yaml.load(texts[family, number, "scene"], Loader)
            problems.append(_problem(family.removesuffix("_panda"), number, request, scene, model))
    return problems


def _problem(family: str, number: str, request: Any, scene: Any, model: RobotModel) -> Problem:
    state = request["start_state"]["joint_state"]
    start = dict(zip(state["name"], state["position"], strict=True))
    (constraints,) = request["goal_constraints"]
    goal = {c["joint_name"]: c["position"] for c in constraints["joint_constraints"]}
    solids = [solid for thing in scene["world"]["collision_objects"] for solid in _solids(thing)]
    return Problem(
        family=family,
        number=number,
        scene=Solids(solids=solids),
        start=_posture(start, model),
        goal=_posture(goal, model),
    )


def _solids(thing: Mapping[str, Any]) -> list[Solid]:
    solids: list[Solid] = []
    for primitive, pose in zip(thing["primitives"], thing["primitive_poses"], strict=True):
        T = transform_from(pose["position"], pose["orientation"])
        size = [float(v) for v in primitive["dimensions"]]
        if primitive["type"] == "box":
            solids.append(Cuboid(size=np.array(size), T_world_shape=T))
        elif primitive["type"] == "cylinder":  # MoveIt: height, then radius
            solids.append(Rod(radius=size[1], length=size[0], T_world_shape=T))
        elif primitive["type"] == "sphere":
            solids.append(Ball(center=T[:3, 3], radius=size[0]))
        else:
            raise ValueError(f"{thing['id']}: no solid of type {primitive['type']}")
    return solids


def _posture(by_name: Mapping[str, float], model: RobotModel) -> Float64:
    return np.array([by_name[name] for name in model.joint_names], dtype=np.float64)

"""Robots as their vendors describe them: links, joints, visual meshes, collision meshes."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cache
from importlib.metadata import files
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray

from tools.mujoco.poses import Float64, pose, turn_rpy

DISTRIBUTION = "example-robot-data"
FACES_PER_PIECE = 3000  # a piece is one colour of one link; finer meshes are decimated
GREY = (0.75, 0.75, 0.76)


@dataclass(frozen=True, kw_only=True)
class Description:
    """A robot of the distribution: its URDF, and bounds [rad] of a motion's first posture.

    tip: the last link; reach [m]: how far it extends along its axis `out`; grip [m]: position of the fingers.
    is_tight: visual meshes replace its collision meshes.
    """

    urdf: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    tip: str
    reach: float
    out: tuple[float, float, float] = (0.0, 0.0, 1.0)
    grip: float = 0.0
    is_tight: bool = False


_PANDA = {
    "urdf": "panda_description/urdf/panda.urdf",
    "low": (-0.7, -0.6, -0.4, -2.6, -0.4, 1.6, 0.3),
    "high": (0.7, 0.4, 0.4, -1.6, 0.4, 2.6, 1.2),
    "tip": "panda_hand",
    "reach": 0.10,
    "grip": 0.035,
}
_UR = {
    "low": (-0.8, -1.9, 1.2, -2.2, -1.9, -1.0),
    "high": (0.8, -1.2, 2.1, -1.0, -1.2, 1.0),
    "tip": "wrist_3_link",
    "reach": 0.09,
    "out": (0.0, 1.0, 0.0),
}
ROBOTS = {
    "panda": Description(**_PANDA),  # type: ignore[arg-type]
    "panda_tight": Description(**_PANDA, is_tight=True),  # type: ignore[arg-type]
    "ur5": Description(urdf="ur_description/urdf/ur5_joint_limited_robot.urdf", **_UR),  # type: ignore[arg-type]
    "ur10": Description(urdf="ur_description/urdf/ur10_joint_limited_robot.urdf", **_UR),  # type: ignore[arg-type]
    "xarm7": Description(
        urdf="xarm_description/urdf/xarm7.urdf",
        low=(-0.8, -0.5, -0.4, 0.8, -0.4, 0.8, -0.5),
        high=(0.8, 0.4, 0.4, 1.7, 0.4, 1.7, 0.5),
        tip="link7",
        reach=0.03,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A mesh of one colour in its link's frame: vertices (V, 3) [m], faces (F, 3), RGB in [0, 1]."""

    vertices: Float64
    faces: NDArray[np.int32]
    rgb: tuple[float, float, float]

    @property
    def triangles(self) -> Float64:
        """Corners (F, 3, 3) [m]."""
        return self.vertices[self.faces]


@dataclass(frozen=True, kw_only=True)
class Joint:
    """kind `revolute`, `prismatic` or `fixed`; limits in rad or m, velocity in rad/s or m/s."""

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: Float64
    axis: Float64
    lower: float
    upper: float
    velocity: float


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot's joints in tree order, and the pieces of each link."""

    name: str
    description: Description
    urdf: Path
    root: str
    joints: tuple[Joint, ...]
    visual: dict[str, tuple[Piece, ...]]
    collision: dict[str, tuple[Piece, ...]]

    @property
    def moved(self) -> tuple[Joint, ...]:
        """Every joint that is not fixed."""
        return tuple(joint for joint in self.joints if joint.kind != "fixed")

    @property
    def driven(self) -> tuple[Joint, ...]:
        """The revolute joints."""
        return tuple(joint for joint in self.joints if joint.kind == "revolute")

    @property
    def fixed_links(self) -> frozenset[str]:
        """The root, and links joined to it only by fixed joints."""
        found = {self.root}
        for joint in self.joints:
            if joint.kind == "fixed" and joint.parent in found:
                found.add(joint.child)
        return frozenset(found)


@cache
def robots_folder() -> Path:
    """The distribution's folder of robots. Raises LookupError if it is not installed."""
    for file in files(DISTRIBUTION) or ():
        if file.name == "panda.urdf":
            return Path(str(file.locate())).resolve().parents[2]
    raise LookupError(f"{DISTRIBUTION}: expected panda.urdf among its files")


@cache
def load_robot(name: str) -> Robot:
    """A robot of the table `ROBOTS`, its meshes decimated."""
    description = ROBOTS[name]
    urdf = robots_folder() / description.urdf
    tree = ET.parse(urdf).getroot()
    joints = tuple(_joint(entry) for entry in tree.findall("joint"))
    children = {joint.child for joint in joints}
    links = [str(entry.get("name")) for entry in tree.findall("link")]
    visual = {str(entry.get("name")): _pieces(entry, "visual") for entry in tree.findall("link")}
    collision = {str(entry.get("name")): _pieces(entry, "collision") for entry in tree.findall("link")}
    return Robot(
        name=name,
        description=description,
        urdf=urdf,
        root=next(link for link in links if link not in children),
        joints=_in_tree_order(joints),
        visual=visual,
        collision=visual if description.is_tight else collision,
    )


def write_tight_urdf(robot: Robot, folder: Path) -> Path:
    """Write a robot's URDF with its visual meshes as collision meshes, and the meshes, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = ET.parse(robot.urdf)
    for entry in tree.getroot().findall("link"):
        name = str(entry.get("name"))
        for old in (*entry.findall("visual"), *entry.findall("collision")):
            entry.remove(old)
        if not robot.visual[name]:
            continue
        whole = trimesh.util.concatenate([trimesh.Trimesh(p.vertices, p.faces) for p in robot.visual[name]])
        whole.export(folder / f"{name}.stl")
        for kind in ("visual", "collision"):
            geometry = ET.SubElement(ET.SubElement(entry, kind), "geometry")
            ET.SubElement(geometry, "mesh", filename=f"{name}.stl")
    path = folder / f"{robot.name}.urdf"
    tree.write(path, encoding="utf-8", xml_declaration=True)
    return path


def _in_tree_order(joints: tuple[Joint, ...]) -> tuple[Joint, ...]:
    """Parents before children, otherwise as the URDF lists them."""
    done: list[Joint] = []
    rest = list(joints)
    children = {joint.child for joint in joints}
    known = {joint.parent for joint in joints} - children
    while rest:
        joint = next(one for one in rest if one.parent in known)
        rest.remove(joint)
        done.append(joint)
        known.add(joint.child)
    return tuple(done)


def _joint(entry: ET.Element) -> Joint:
    kind = str(entry.get("type")).replace("continuous", "revolute")
    axis, limit = entry.find("axis"), entry.find("limit")
    numbers = {} if limit is None else limit.attrib
    return Joint(
        name=str(entry.get("name")),
        kind=kind,
        parent=_attribute(entry, "parent", "link"),
        child=_attribute(entry, "child", "link"),
        T_parent_joint=_origin(entry),
        axis=np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis.get("xyz", "1 0 0")),
        lower=float(numbers.get("lower", -np.pi)),
        upper=float(numbers.get("upper", np.pi)),
        velocity=float(numbers.get("velocity", 1.0)),
    )


def _pieces(link: ET.Element, kind: str) -> tuple[Piece, ...]:
    found: list[Piece] = []
    for entry in link.findall(kind):
        geometry = entry.find("geometry")
        assert geometry is not None
        T = _origin(entry)
        for mesh, rgb in _meshes(geometry[0]):
            vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
            faces = np.asarray(mesh.faces, dtype=np.int32)
            if len(faces) > FACES_PER_PIECE:
                kept, faces = fast_simplification.simplify(
                    np.asarray(vertices, np.float32), faces, target_count=FACES_PER_PIECE
                )
                vertices, faces = np.asarray(kept, np.float64), np.asarray(faces, np.int32)
            found.append(Piece(vertices=np.asarray(vertices, np.float64), faces=faces, rgb=rgb))
    return tuple(found)


def _meshes(shape: ET.Element) -> list[tuple[trimesh.Trimesh, tuple[float, float, float]]]:
    """The welded meshes of one URDF shape with their colours, scaled, in metres."""
    if shape.tag == "box":
        return [(trimesh.creation.box(_numbers(shape.attrib["size"])), GREY)]
    if shape.tag == "cylinder":
        size = {"radius": float(shape.attrib["radius"]), "height": float(shape.attrib["length"])}
        return [(trimesh.creation.cylinder(**size), GREY)]
    if shape.tag == "sphere":
        return [(trimesh.creation.icosphere(radius=float(shape.attrib["radius"])), GREY)]
    path = robots_folder() / shape.attrib["filename"].rpartition("/robots/")[2]
    scene = trimesh.load(path, force="scene")
    scale = _numbers(shape.get("scale", "1 1 1"))
    out = []
    for mesh in scene.dump():
        rgb = _rgb(mesh)
        bare = trimesh.Trimesh(mesh.vertices * scale, mesh.faces, process=False)
        bare.merge_vertices(merge_tex=True, merge_norm=True)
        bare.update_faces(bare.nondegenerate_faces())
        if len(bare.faces):
            out.append((bare, rgb))
    return out


def _rgb(mesh: trimesh.Trimesh) -> tuple[float, float, float]:
    """The diffuse colour of a mesh's material; grey without a material."""
    material = getattr(mesh.visual, "material", None)
    if material is None:
        return GREY
    color = np.asarray(material.main_color, dtype=np.float64)[:3] / 255
    return (float(color[0]), float(color[1]), float(color[2]))


def _origin(entry: ET.Element) -> Float64:
    origin = entry.find("origin")
    if origin is None:
        return np.eye(4)
    return pose(_numbers(origin.get("xyz", "0 0 0")), turn_rpy(_numbers(origin.get("rpy", "0 0 0"))))


def _attribute(entry: ET.Element, tag: str, name: str) -> str:
    found = entry.find(tag)
    assert found is not None
    return str(found.get(name))


def _numbers(text: str) -> Float64:
    return np.array([float(word) for word in text.split()])

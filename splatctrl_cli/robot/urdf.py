"""URDF contents apart from kinematics: links, joints, shapes. Untrusted XML is safe."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml import ElementTree

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.formats.unpacking import read_text
from splatctrl_cli.records import Float64

MOVABLE = ("revolute", "continuous", "prismatic")
LIMITED = ("revolute", "prismatic")


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A link's primitive: `box` (full x, y, z), `cylinder` (radius, length along z), `sphere` (radius).

    size [m]; T_link_shape (4, 4) maps the shape's frame, at its middle, to the link.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    T_link_shape: Float64


@dataclass(frozen=True, kw_only=True)
class MeshShape:
    """A link's collision mesh: URDF file name, scale (3,), T_link_mesh (4, 4)."""

    link: str
    filename: str
    scale: tuple[float, ...]
    T_link_mesh: Float64


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint: T_parent_child (4, 4) at 0; mimic: (joint, multiplier, offset) or None."""

    name: str
    kind: str
    parent: str
    child: str
    T_parent_child: Float64
    mimic: tuple[str, float, float] | None


@dataclass(frozen=True, kw_only=True)
class UrdfFile:
    """Checked text of a URDF, with links, joints and collision shapes.

    A capsule becomes a cylinder and two spheres. other_shapes: (link, tag) of other collision elements; solid_links:
    links with a collision or visual element.
    """

    path: Path
    text: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    shapes: tuple[Shape, ...]
    meshes: tuple[MeshShape, ...]
    other_shapes: tuple[tuple[str, str], ...]
    solid_links: tuple[str, ...]

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        children = {joint.child for joint in self.joints}
        return next(link for link in self.links if link not in children)

    @property
    def collision_links(self) -> tuple[str, ...]:
        named = {
            *(s.link for s in self.shapes),
            *(m.link for m in self.meshes),
            *(link for link, _ in self.other_shapes),
        }
        return tuple(link for link in self.links if link in named)

    def rigid_bodies(self, movable: Collection[str] | None = None) -> dict[str, tuple[str, Float64]]:
        """Leader of each link's rigid body, and T_leader_link (4, 4).

        Fixed joints merge links; the link nearest to the root leads. movable: joints that move (default: all not
        fixed); other joints are at 0.
        """
        still = {
            joint.child: joint
            for joint in self.joints
            if (joint.kind == "fixed" if movable is None else joint.name not in movable)
        }
        bodies: dict[str, tuple[str, Float64]] = {}
        for link in self.links:
            leader, T = link, np.eye(4)
            while leader in still:
                T = still[leader].T_parent_child @ T
                leader = still[leader].parent
            bodies[link] = (leader, T)
        return bodies

    @property
    def grippers(self) -> tuple[str, ...]:
        """Joints typical of fingers.

        Several prismatic joints on one rigid body, or mimics and the joints they follow, if they carry no other
        joint.
        """
        movable = [joint for joint in self.joints if joint.kind != "fixed"]
        leader = {link: led for link, (led, _) in self.rigid_bodies().items()}
        sliding = Counter(leader[joint.parent] for joint in movable if joint.kind == "prismatic")
        copied = {joint.mimic[0] for joint in movable if joint.mimic is not None}
        names = {
            joint.name
            for joint in movable
            if joint.mimic is not None
            or joint.name in copied
            or (joint.kind == "prismatic" and sliding[leader[joint.parent]] > 1)
        }
        carries_others = {name for joint in movable if joint.name not in names for name in self._before(joint)}
        return tuple(joint.name for joint in movable if joint.name in names - carries_others)

    def fingers(self, moved: Collection[str]) -> tuple[str, ...]:
        """`grippers` that `moved` joints carry, but do not move.

        None leads to a moved joint, or shares a mimic with one.
        """
        by_name = {joint.name: joint for joint in self.joints}
        busy = set(moved).union(*(self._before(by_name[name]) for name in moved if name in by_name))
        steps = [{joint.name, joint.mimic[0]} for joint in self.joints if joint.mimic is not None]
        busy = busy.union(*(pair for pair in steps if pair & set(moved)))
        return tuple(
            name for name in self.grippers if name not in busy and set(self._before(by_name[name])) & set(moved)
        )

    def _before(self, joint: Joint) -> Iterator[str]:
        by_child = {joint.child: joint for joint in self.joints}
        while joint.parent in by_child:
            joint = by_child[joint.parent]
            yield joint.name

    def add_followers(self, locked: Mapping[str, float]) -> dict[str, float]:
        """Values of `locked` joints, and of joints that mimic them."""
        followers = {
            joint.name: joint.mimic[1] * locked[joint.mimic[0]] + joint.mimic[2]
            for joint in self.joints
            if joint.mimic is not None and joint.mimic[0] in locked and joint.kind != "fixed"
        }
        return {**followers, **locked}


def read_urdf(path: Path, text: str | None = None) -> UrdfFile:
    """Read and check the URDF at `path`, or `text` under that name.

    Raises InputError for no URDF, several roots, missing limits, a zero axis, or no movable joint.
    """
    with refuse_faults(lambda _: f"{path}: expected a URDF, got bytes that are not text", UnicodeDecodeError):
        text = read_text(path, "give the robot's URDF file") if text is None else text
    # ValueError: what defusedxml forbids
    with refuse_faults(f"{path}: expected a URDF, got broken XML", ElementTree.ParseError, ValueError):
        root = ElementTree.fromstring(text)
    refuse_if(root.tag != "robot", f"{path}: expected a URDF with root <robot>, got <{root.tag}>")
    links = tuple(_attribute(path, element, "name") for element in root.findall("link"))
    twice = [link for link in links if links.count(link) > 1]
    refuse_if(
        twice,
        f"{path}: link '{''.join(twice[:1])}' is defined twice",
        remedy="give the expanded URDF of one robot",
    )
    joints = list(root.findall("joint"))
    refuse_if(
        not any(joint.get("type") in MOVABLE for joint in joints),
        f"{path}: expected movable joints, got none",
        remedy="an unexpanded xacro looks like this; expand it first: xacro FILE.xacro > FILE.urdf",
    )
    _check_tree(path, links, joints)
    shapes = [
        shape
        for link in root.findall("link")
        for collision in link.findall("collision")
        for shape in _shapes(path, str(link.get("name")), collision)
    ]
    solid = tuple(
        str(link.get("name"))
        for link in root.findall("link")
        if link.find("collision") is not None or link.find("visual") is not None
    )
    return UrdfFile(
        path=path,
        text=text,
        links=links,
        joints=tuple(_joint(path, joint) for joint in joints),
        shapes=tuple(shape for shape in shapes if isinstance(shape, Shape)),
        meshes=tuple(shape for shape in shapes if isinstance(shape, MeshShape)),
        other_shapes=tuple(shape for shape in shapes if isinstance(shape, tuple)),
        solid_links=solid,
    )


def visual_urdf(urdf: UrdfFile, without: Collection[str] = ()) -> UrdfFile:
    """URDF in which visual geometry replaces collision geometry, except in links `without`."""
    root = ElementTree.fromstring(urdf.text)
    for link in root.findall("link"):
        is_seen = link.get("name") not in without
        seen = [visual for visual in link.findall("visual") if is_seen and visual.find("geometry") is not None]
        for collision in link.findall("collision") if seen else ():
            link.remove(collision)
        for visual in seen:
            visual.tag = "collision"
    return read_urdf(urdf.path, ElementTree.tostring(root, encoding="unicode"))


def _check_tree(path: Path, links: tuple[str, ...], joints: list[Any]) -> None:
    for joint in joints:
        name = _attribute(path, joint, "name")
        for role in ("parent", "child"):
            element = joint.find(role)
            link = None if element is None else element.get("link")
            refuse_if(link not in links, f"{path}: joint '{name}': {role} link {link!r} does not exist")
    children = {joint.find("child").get("link") for joint in joints}
    roots = [link for link in links if link not in children]
    got = ", ".join(roots) or "none (the joints form a loop)"
    what = f"{path}: expected one root link, got {got}"
    refuse_if(len(roots) != 1, what, remedy="join the links with fixed joints")


def _joint(path: Path, joint: Any) -> Joint:
    where = f"{path}: joint '{joint.get('name')}'"
    kind = _attribute(path, joint, "type")
    if kind in LIMITED:
        _check_limits(where, kind, joint.find("limit"))
    axis, child = joint.find("axis"), joint.find("child").get("link")
    if kind in MOVABLE and axis is not None and not np.linalg.norm(_numbers(f"{where}: axis", axis.get("xyz"), 3)):
        raise InputError(
            f"{where}: axis: expected a direction, got {axis.get('xyz')!r}: link '{child}' would never move",
            remedy='write <axis xyz="..."/> as in the robot\'s own URDF, or type="fixed" where it does not move',
        )
    mimic = joint.find("mimic")
    follows = None
    if mimic is not None:
        factor, offset = (
            _numbers(where, mimic.get(key, text), 1)[0] for key, text in (("multiplier", "1"), ("offset", "0"))
        )
        follows = (_attribute(path, mimic, "joint"), factor, offset)
    return Joint(
        name=str(joint.get("name")),
        kind=kind,
        parent=joint.find("parent").get("link"),
        child=child,
        T_parent_child=_origin(where, joint.find("origin")),
        mimic=follows,
    )


def _check_limits(where: str, kind: str, limit: Any) -> None:
    remedy = 'write <limit lower="..." upper="..." velocity="..." effort="..."/>, from the data sheet of the robot'
    refuse_if(limit is None, f"{where}: {kind}: expected limits, got none", remedy=remedy)
    lower, upper = (_numbers(f"{where}: limit {key}", limit.get(key, "0"), 1)[0] for key in ("lower", "upper"))
    refuse_if(lower >= upper, f"{where}: limits: expected lower < upper, got {lower:g} and {upper:g}", remedy=remedy)
    for key in ("velocity", "effort"):
        refuse_if(limit.get(key) is None, f"{where}: limits: expected {key}, got none", remedy=remedy)
    refuse_if(
        _numbers(f"{where}: limit velocity", limit.get("velocity"), 1)[0] <= 0,
        f"{where}: limits: expected a velocity above 0, got {limit.get('velocity')}",
        remedy=remedy,
    )


def _shapes(path: Path, link: str, collision: Any) -> Sequence[Shape | MeshShape | tuple[str, str]]:
    geometry = collision.find("geometry")
    first = next(iter(() if geometry is None else geometry), None)
    element = require(first, f"{path}: link '{link}': collision without geometry")
    where = f"{path}: link '{link}': {element.tag}"
    T_link_shape = _origin(where, collision.find("origin"))
    if element.tag == "mesh":
        scale = _numbers(f"{where}: scale", element.get("scale", "1 1 1"), 3)
        refuse_if(0 in scale, f"{where}: scale: expected three numbers that are not 0, got {scale}")
        return [
            MeshShape(
                link=link, filename=_attribute(path, element, "filename"), scale=scale, T_link_mesh=T_link_shape
            )
        ]
    if element.tag == "box":
        size = _numbers(where, element.get("size"), 3)
    elif element.tag in {"cylinder", "capsule"}:
        size = _numbers(where, element.get("radius"), 1) + _numbers(where, element.get("length"), 1)
    elif element.tag == "sphere":
        size = _numbers(where, element.get("radius"), 1)
    else:
        return [(link, str(element.tag))]
    refuse_if(min(size) <= 0, f"{where}: expected sizes above 0, got {size}")
    if element.tag == "capsule":
        return _capsule(link, size, T_link_shape)
    return [Shape(link=link, kind=element.tag, size=size, T_link_shape=T_link_shape)]


def _capsule(link: str, size: tuple[float, ...], T_link_shape: Float64) -> list[Shape]:
    radius, length = size
    parts = [Shape(link=link, kind="cylinder", size=size, T_link_shape=T_link_shape)]
    for z in (-0.5 * length, 0.5 * length):
        T = T_link_shape.copy()
        T[:3, 3] += z * T[:3, 2]
        parts.append(Shape(link=link, kind="sphere", size=(radius,), T_link_shape=T))
    return parts


def _origin(where: str, origin: Any) -> Float64:
    T = np.eye(4)
    if origin is None:
        return T
    T[:3, 3] = _numbers(where, origin.get("xyz", "0 0 0"), 3)
    roll, pitch, yaw = _numbers(where, origin.get("rpy", "0 0 0"), 3)
    T[:3, :3] = _rotate_about("z", yaw) @ _rotate_about("y", pitch) @ _rotate_about("x", roll)
    return T


def _rotate_about(axis: str, angle: float) -> Float64:
    c, s = np.cos(angle), np.sin(angle)
    rows = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(rows[axis], dtype=np.float64)


def _numbers(where: str, text: str | None, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in (text or "").split())
    except ValueError:
        values = ()
    refuse_if(
        len(values) != count or not np.all(np.isfinite(values)),
        f"{where}: expected {count} number{'s' * (count > 1)}, got {text!r}",
    )
    return values


def _attribute(path: Path, element: Any, name: str) -> str:
    value = element.get(name)
    refuse_if(not value, f"{path}: <{element.tag}> without {name}")
    return str(value)

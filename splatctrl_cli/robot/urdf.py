"""What a URDF says apart from its kinematics: links, joints and primitive shapes. Untrusted XML is read safely."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml import ElementTree

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Float64

MOVABLE = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A primitive of one link: `box` (size = full x, y, z), `cylinder` (radius, length along z), `sphere` (radius).

    size [m]; T_link_shape (4, 4) maps the shape's own frame, at its middle, to the link.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    T_link_shape: Float64


@dataclass(frozen=True, kw_only=True)
class UrdfFile:
    """The checked text of a URDF, its link names, (parent, child) links of its joints and its collision shapes.

    num_meshes counts the collision meshes, which are not among the shapes. solid_links have a collision or visual
    element: there is something to bump into.
    """

    path: Path
    text: str
    links: tuple[str, ...]
    parents: tuple[tuple[str, str], ...]
    shapes: tuple[Shape, ...]
    num_meshes: int
    solid_links: tuple[str, ...]


def read_urdf(path: Path) -> UrdfFile:
    """The URDF at `path`, once it is known to be one robot with at least one movable joint.

    Raises InputError for a file that is missing or no URDF, several root links, or no movable joint (which is what
    an unexpanded xacro looks like).
    """
    text, root = _parse(path)
    links = tuple(_attribute(path, element, "name") for element in root.findall("link"))
    if len(set(links)) < len(links):
        twice = next(link for link in links if links.count(link) > 1)
        raise InputError(f"{path}: link '{twice}' is defined twice", remedy="give the expanded URDF of one robot")
    joints = list(root.findall("joint"))
    if not any(joint.get("type") in MOVABLE for joint in joints):
        raise InputError(
            f"{path}: expected movable joints, got none",
            remedy="an unexpanded xacro looks like this; expand it first: xacro FILE.xacro > FILE.urdf",
        )
    _check_tree(path, links, joints)
    shapes: list[Shape] = []
    num_meshes = 0
    for link in root.findall("link"):
        for collision in link.findall("collision"):
            shape = _shape(path, link.get("name"), collision)
            if shape is None:
                num_meshes += 1
            else:
                shapes.append(shape)
    solid = tuple(
        str(link.get("name"))
        for link in root.findall("link")
        if link.find("collision") is not None or link.find("visual") is not None
    )
    parents = tuple((joint.find("parent").get("link"), joint.find("child").get("link")) for joint in joints)
    return UrdfFile(
        path=path,
        text=text,
        links=links,
        parents=parents,
        shapes=tuple(shapes),
        num_meshes=num_meshes,
        solid_links=solid,
    )


def _parse(path: Path) -> tuple[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", remedy="give the robot's URDF file") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected a URDF, got bytes that are no text") from None
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:  # ValueError: what defusedxml forbids
        raise InputError(f"{path}: expected a URDF, got broken XML: {error}") from None
    if root.tag != "robot":
        raise InputError(f"{path}: expected a URDF with root <robot>, got <{root.tag}>")
    return text, root


def _check_tree(path: Path, links: tuple[str, ...], joints: list[Any]) -> None:
    children = set()
    for joint in joints:
        name = _attribute(path, joint, "name")
        for role in ("parent", "child"):
            element = joint.find(role)
            link = None if element is None else element.get("link")
            if link not in links:
                raise InputError(f"{path}: joint '{name}': {role} link {link!r} does not exist")
            if role == "child":
                children.add(link)
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        got = ", ".join(roots) or "none (the joints form a loop)"
        raise InputError(f"{path}: expected one root link, got {got}", remedy="join the links with fixed joints")


def _shape(path: Path, link: str, collision: Any) -> Shape | None:
    geometry = collision.find("geometry")
    element = None if geometry is None else next(iter(geometry), None)
    if element is None:
        raise InputError(f"{path}: link '{link}': collision without geometry")
    where = f"{path}: link '{link}': {element.tag}"
    if element.tag == "box":
        size = _numbers(where, element.get("size"), 3)
    elif element.tag == "cylinder":
        size = _numbers(where, element.get("radius"), 1) + _numbers(where, element.get("length"), 1)
    elif element.tag == "sphere":
        size = _numbers(where, element.get("radius"), 1)
    else:
        return None
    if min(size) <= 0:
        raise InputError(f"{where}: expected sizes above 0, got {size}")
    origin = collision.find("origin")
    return Shape(link=link, kind=element.tag, size=size, T_link_shape=_origin(where, origin))


def _origin(where: str, origin: Any) -> Float64:
    T = np.eye(4)
    if origin is None:
        return T
    T[:3, 3] = _numbers(where, origin.get("xyz", "0 0 0"), 3)
    roll, pitch, yaw = _numbers(where, origin.get("rpy", "0 0 0"), 3)
    T[:3, :3] = _about("z", yaw) @ _about("y", pitch) @ _about("x", roll)
    return T


def _about(axis: str, angle: float) -> Float64:
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
    if len(values) != count or not np.all(np.isfinite(values)):
        raise InputError(f"{where}: expected {count} number{'s' * (count > 1)}, got {text!r}")
    return values


def _attribute(path: Path, element: Any, name: str) -> str:
    value = element.get(name)
    if not value:
        raise InputError(f"{path}: <{element.tag}> without {name}")
    return str(value)

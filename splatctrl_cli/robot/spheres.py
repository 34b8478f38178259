"""Collision spheres of a robot: from a YAML file in cuRobo's layout, or from a URDF that has only spheres."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot.urdf import UrdfFile

LAYOUT = "collision_spheres: {LINK: [{center: [x, y, z], radius: r}, ...]}"


def read_spheres(path: Path) -> SphereSet:
    """The spheres of a YAML file [m], by link: `collision_spheres` at the top or under robot_cfg.kinematics.

    A radius of 0 or less is cuRobo's way to switch a sphere off; such spheres are left out.
    Raises InputError for a missing file, another layout, or no sphere at all.
    """
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", remedy="give a spheres YAML file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid YAML: {error}") from None
    by_link = _table(tree)
    if by_link is None:
        raise InputError(f"{path}: expected the layout {LAYOUT}")
    links: list[str] = []
    numbers: list[list[float]] = []
    for link, spheres in by_link.items():
        if not isinstance(spheres, list):
            raise InputError(f"{path}: link '{link}': expected a list of spheres, got {spheres!r}", remedy=LAYOUT)
        for index, sphere in enumerate(spheres):
            row = _sphere(f"{path}: link '{link}': sphere {index}", sphere)
            if row[3] > 0:
                links.append(str(link))
                numbers.append(row)
    if not links:
        raise InputError(f"{path}: expected collision spheres, got none", remedy=LAYOUT)
    table = np.array(numbers, dtype=np.float64)
    return SphereSet(links=tuple(links), centers=table[:, :3].copy(), radii=table[:, 3].copy())


def spheres_of(urdf: UrdfFile) -> SphereSet:
    """The spheres of a URDF whose collision geometry is spheres and nothing else.

    Raises InputError where it has none, or holds other shapes too, which the spheres would leave uncovered.
    """
    others = urdf.num_meshes + sum(shape.kind != "sphere" for shape in urdf.shapes)
    if others or not urdf.shapes:
        raise InputError(
            f"{urdf.path}: expected collision geometry of spheres only, got {others} other shapes",
            remedy=f"give a spheres YAML file ({LAYOUT})",
        )
    return SphereSet(
        links=tuple(shape.link for shape in urdf.shapes),
        centers=np.array([shape.T_link_shape[:3, 3] for shape in urdf.shapes]),
        radii=np.array([shape.size[0] for shape in urdf.shapes]),
    )


def matched_links(spheres: SphereSet, urdf: UrdfFile, path: Path) -> tuple[SphereSet, tuple[str, ...]]:
    """`spheres` by the URDF's link names, and the links left out because the URDF lacks them (a hand not mounted).

    Where no name agrees, names are compared without their first part: a set for `panda_link1` fits `fr3_link1`.
    Raises InputError when nothing fits even so.
    """
    names = {link: link for link in urdf.links}
    asked = spheres.links
    if not any(link in names for link in asked):
        names = {_without_prefix(link): link for link in urdf.links}
        asked = tuple(_without_prefix(link) for link in asked)
    kept = [index for index, link in enumerate(asked) if link in names]
    if not kept:
        raise InputError(
            f"{path}: none of its links is in {urdf.path}", remedy=f"links there: {', '.join(urdf.links)}"
        )
    matched = SphereSet(
        links=tuple(names[asked[index]] for index in kept), centers=spheres.centers[kept], radii=spheres.radii[kept]
    )
    left_out = {spheres.links[index] for index, link in enumerate(asked) if link not in names}
    return matched, tuple(sorted(left_out))


def _without_prefix(link: str) -> str:
    return link.partition("_")[2] or link


def _table(tree: Any) -> dict[Any, Any] | None:
    if isinstance(tree, dict) and "robot_cfg" in tree:
        tree = tree["robot_cfg"]
    if isinstance(tree, dict) and "kinematics" in tree:
        tree = tree["kinematics"]
    table = tree.get("collision_spheres") if isinstance(tree, dict) else None
    return table if isinstance(table, dict) else None


def _sphere(where: str, sphere: Any) -> list[float]:
    try:
        row = [float(value) for value in [*sphere["center"], sphere["radius"]]]
    except (TypeError, KeyError, ValueError):
        row = []
    if len(row) != 4 or not np.all(np.isfinite(row)):
        raise InputError(f"{where}: expected {{center: [x, y, z], radius: r}}, got {sphere!r}")
    return row

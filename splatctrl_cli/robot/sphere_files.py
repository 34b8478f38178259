"""Collision spheres of a robot: files, matching to URDF links, and joints' lever arms.

Files are URDFs, and YAML of this tool, robometrics and cuRobo. As in cuRobo (NVlabs/curobo, cuda_robot_generator.py),
`collision_sphere_buffer`, a number or one per link, adds to every radius; a sphere whose radius is then not above 0
is switched off. `collision_spheres` may name a file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatctrl_cli.config.fixed import CARRIED_CELL
from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.formats.unpacking import read_text
from splatctrl_cli.kernels.chain import PRISMATIC, Chain
from splatctrl_cli.records import Box, Float64, SphereSet
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf

RENAMED = (
    "sphere links were matched without the first part of their names; is it the same robot? "
    "Spheres are taken in frames of the same name, which may be turned: see what `splatctrl robot check` says"
)


def spheres_of(urdf: UrdfFile) -> SphereSet:
    """`own_spheres`. Raises InputError without spheres."""
    spheres = own_spheres(urdf)
    others = len(urdf.meshes) + len(urdf.other_shapes) + sum(shape.kind != "sphere" for shape in urdf.shapes)
    refuse_if(
        not len(spheres.radii),
        f"{urdf.path}: expected collision geometry of spheres only, got {others} other shapes",
        remedy="give a spheres YAML file, or fit one with: splatctrl robot spheres",
    )
    return spheres


def own_spheres(urdf: UrdfFile) -> SphereSet:
    """Spheres of a URDF, none if it has other collision geometry."""
    has_others = urdf.meshes or urdf.other_shapes or any(shape.kind != "sphere" for shape in urdf.shapes)
    shapes = () if has_others else urdf.shapes
    return SphereSet(
        links=tuple(shape.link for shape in shapes),
        centers=np.array([shape.T_link_shape[:3, 3] for shape in shapes]).reshape(-1, 3),
        radii=np.array([shape.size[0] for shape in shapes]),
    )


def add_boxes(spheres: SphereSet, boxes: Sequence[tuple[str, Box]]) -> SphereSet:
    """Add spheres that cover boxes in link frames, one per `CARRIED_CELL`."""
    links, centers, radii = [*spheres.links], [spheres.centers], [spheres.radii]
    for link, box in boxes:
        size = box.upper - box.lower
        counts = np.ceil(size / CARRIED_CELL - 1e-9).astype(np.int64)
        cells = np.argwhere(np.ones(counts, bool))
        links += [link] * len(cells)
        centers.append(box.lower + (cells + 0.5) * size / counts)
        radii.append(np.full(len(cells), 0.5 * np.linalg.norm(size / counts)))
    return SphereSet(links=tuple(links), centers=np.concatenate(centers), radii=np.concatenate(radii))


def match_links(spheres: SphereSet, urdf: UrdfFile, name: str) -> tuple[SphereSet, tuple[str, ...]]:
    """Spheres by the URDF's link names, and other links, whose spheres are left out.

    If no name agrees, names are compared without their first part: `panda_link1` fits `fr3_link1`. Raises InputError
    about `name` if nothing fits.
    """
    names = {link: link for link in urdf.links}
    file_links = spheres.links
    if are_links_renamed(spheres, urdf):
        names = {link.partition("_")[2] or link: link for link in urdf.links}
        file_links = tuple(link.partition("_")[2] or link for link in file_links)
    indices = [index for index, link in enumerate(file_links) if link in names]
    refuse_if(
        file_links and not indices,
        f"{name}: none of its links is in {urdf.path}",
        remedy=f"links there: {', '.join(urdf.links)}",
    )
    matched = SphereSet(
        links=tuple(names[file_links[index]] for index in indices),
        centers=spheres.centers[indices],
        radii=spheres.radii[indices],
    )
    return matched, tuple(
        sorted({spheres.links[index] for index, link in enumerate(file_links) if link not in names})
    )


def are_links_renamed(spheres: SphereSet, urdf: UrdfFile) -> bool:
    return not set(spheres.links) & set(urdf.links)


def lever_arms(chain: Chain, lower: Float64, upper: Float64) -> Float64:
    """Bounds (S, J) on a centre's travel per radian (or metre) within the limits.

    In each body's frame, the sphere's centre stays within a ball. At a revolute joint, the ball grows by its centre's
    distance from the axis, and its radius is the bound. A prismatic joint has the bound 1, a joint that does not move
    the sphere 0.
    """
    levers = np.zeros((len(chain.sphere_body), len(chain.parent) - 1))
    for s, (start, offset) in enumerate(zip(chain.sphere_body, chain.offset, strict=True)):
        middle, radius, body = np.asarray(offset, dtype=np.float64), 0.0, int(start)
        while body > 0:
            j, axis = body - 1, chain.axis[body]
            if chain.kind[body] == PRISMATIC:
                levers[s, j] = 1.0
                middle = middle + axis * (lower[j] + upper[j]) / 2
                radius += (upper[j] - lower[j]) / 2
            else:
                along = axis * float(axis @ middle)
                radius += float(np.linalg.norm(middle - along))
                levers[s, j], middle = radius, along
            middle = chain.placement[body, :, :3] @ middle + chain.placement[body, :, 3]
            body = int(chain.parent[body])
    return levers


LAYOUT = "collision_spheres: {LINK: [{center: [x, y, z], radius: r}, ...]}"
URDF_SUFFIXES = (".urdf", ".xml")


@dataclass(frozen=True, kw_only=True)
class SphereFile:
    """A sphere file: layout (such as "cuRobo YAML"), spheres, number switched off."""

    path: Path
    layout: str
    spheres: SphereSet
    num_off: int


def read_spheres(path: Path) -> SphereSet:
    """Spheres of a file [m] (`read_sphere_file`)."""
    return read_sphere_file(path).spheres


def read_sphere_file(path: Path) -> SphereFile:
    """Read the spheres of a YAML file or a URDF.

    YAML has `collision_spheres` at the top or under robot_cfg.kinematics, by link or as Lula's list, or an XRDF's
    groups. Raises InputError for an unreadable file, another layout, a non-finite number, or no sphere.
    """
    if path.suffix.lower() in URDF_SUFFIXES:
        return SphereFile(path=path, layout="URDF", spheres=spheres_of(read_urdf(path)), num_off=0)
    tree = _yaml(path)
    is_xrdf = isinstance(tree, dict) and tree.get("format") == "xrdf"
    section = _xrdf(path, tree) if is_xrdf else _section(tree)
    table = section.get("collision_spheres")
    is_lula = isinstance(table, list) and all(isinstance(entry, dict) for entry in table)
    table = _join(path, table or []) if is_lula else table
    source = path
    if isinstance(table, str):
        source = path.parent / table
        table = _section(_yaml(source)).get("collision_spheres")
    if not isinstance(table, dict):
        raise InputError(
            f"{source}: expected the layout {LAYOUT}", remedy="or a URDF whose collision shapes are spheres"
        )
    buffers = _buffers(path, section.get("collision_sphere_buffer", 0.0), table)
    rows = [
        (str(link), _sphere(f"{source}: link '{link}': sphere {index}", sphere), buffers.get(str(link), 0.0))
        for link, spheres in table.items()
        for index, sphere in enumerate(_check_list(source, link, spheres))
    ]
    on = [(link, (*row[:3], row[3] + buffer)) for link, row, buffer in rows if row[3] + buffer > 0]
    off = f", all {len(rows)} of radius 0 or less" if rows else ""
    refuse_if(not on, f"{source}: expected collision spheres, got none{off}", remedy=LAYOUT)
    numbers = np.array([row for _, row in on], dtype=np.float64)
    return SphereFile(
        path=path,
        layout="XRDF" if is_xrdf else "Lula YAML" if is_lula else "YAML" if section is tree else "cuRobo YAML",
        spheres=SphereSet(
            links=tuple(link for link, _ in on), centers=numbers[:, :3].copy(), radii=numbers[:, 3].copy()
        ),
        num_off=len(rows) - len(on),
    )


def spheres_yaml(spheres: SphereSet, comments: Sequence[str] = ()) -> str:
    """YAML text of `spheres` by link, at full precision, with `comments` on top."""
    lines = [*(f"# {comment}" for comment in comments), "collision_spheres:"]
    for link in dict.fromkeys(spheres.links):
        lines.append(f"  {link}:")
        for owner, center, radius in zip(spheres.links, spheres.centers, spheres.radii, strict=True):
            if owner == link:
                x, y, z = (repr(float(value) + 0.0) for value in center)
                lines.append(f"    - {{center: [{x}, {y}, {z}], radius: {float(radius)!r}}}")
    return "\n".join(lines) + "\n"


def _yaml(path: Path) -> Any:
    remedy = "give a spheres YAML file"
    with refuse_faults(f"{path}: not valid YAML", yaml.YAMLError, UnicodeDecodeError, remedy=f"{remedy} or a URDF"):
        return yaml.safe_load(read_text(path, remedy))


def _section(tree: Any) -> dict[Any, Any]:
    for key in ("robot_cfg", "kinematics"):
        if isinstance(tree, dict) and key in tree:
            tree = tree[key]
    return tree if isinstance(tree, dict) else {}


def _join(path: Path, entries: list[dict[Any, Any]]) -> dict[Any, Any]:
    table: dict[Any, Any] = {}
    for entry in entries:
        for link, spheres in entry.items():
            table[link] = [*table.get(link, []), *_check_list(path, link, spheres)]
    return table


def _xrdf(path: Path, tree: dict[Any, Any]) -> dict[Any, Any]:
    section = tree.get("collision") or tree.get("world_collision")
    collision, groups = (value if isinstance(value, dict) else {} for value in (section, tree.get("geometry")))
    name = collision.get("geometry", next(iter(groups), None) if len(groups) == 1 else None)
    group = groups.get(str(name))
    if not isinstance(group, dict) or "spheres" not in group:
        known = ", ".join(map(str, groups)) or "none"
        raise InputError(
            f"{path}: XRDF: expected spheres in the group '{name}', got groups {known}",
            remedy="name a group with spheres in collision: {geometry: NAME}",
        )
    return {
        "collision_spheres": group["spheres"],
        "collision_sphere_buffer": collision.get("buffer_distance") or 0.0,
    }


def _buffers(path: Path, buffer: Any, table: dict[Any, Any]) -> dict[str, float]:
    by_link = buffer if isinstance(buffer, dict) else dict.fromkeys(table, buffer)
    buffers = {}
    for link, value in by_link.items():
        refuse_if(
            isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value),
            f"{path}: collision_sphere_buffer: expected numbers [m], got {value!r} for '{link}'",
        )
        buffers[str(link)] = float(value)
    return buffers


def _check_list(path: Path, link: object, spheres: Any) -> list[Any]:
    if not isinstance(spheres, list):
        raise InputError(f"{path}: link '{link}': expected a list of spheres, got {spheres!r}", remedy=LAYOUT)
    return spheres


def _sphere(where: str, sphere: Any) -> list[float]:
    try:
        row = [float(value) for value in [*sphere["center"], sphere["radius"]]]
    except (TypeError, KeyError, ValueError):
        row = []
    refuse_if(
        len(row) != 4 or not np.all(np.isfinite(row)),
        f"{where}: expected {{center: [x, y, z], radius: r}}, got {sphere!r}",
        remedy="finite, in metres",
    )
    return row


def sphere_names(spheres: SphereSet) -> tuple[str, ...]:
    """Each sphere's link and number on it: ``panda_hand[2]``."""
    return tuple(f"{link}[{spheres.links[:index].count(link)}]" for index, link in enumerate(spheres.links))

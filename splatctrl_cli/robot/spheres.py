"""Collision spheres of a robot: those of a URDF that has only spheres, and sets by the link names of another; and how
far a joint can move a sphere, whatever the posture, so that a planner can trust the space between two samples.
"""

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.kernels.chain import PRISMATIC, Chain
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.urdf import UrdfFile

RENAMED = (
    "sphere links were matched without the first part of their names; is it the same robot? "
    "Spheres are taken in frames of the same name, which may be turned: see what `splatctrl robot check` says"
)


def spheres_of(urdf: UrdfFile) -> SphereSet:
    """The spheres of a URDF whose collision geometry is spheres and nothing else.

    Raises InputError where it has none, or holds other shapes too, which the spheres would leave uncovered.
    """
    others = len(urdf.meshes) + len(urdf.other_shapes) + sum(shape.kind != "sphere" for shape in urdf.shapes)
    if others or not urdf.shapes:
        raise InputError(
            f"{urdf.path}: expected collision geometry of spheres only, got {others} other shapes",
            remedy="give a spheres YAML file, or fit one with: splatctrl robot spheres",
        )
    return SphereSet(
        links=tuple(shape.link for shape in urdf.shapes),
        centers=np.array([shape.T_link_shape[:3, 3] for shape in urdf.shapes]),
        radii=np.array([shape.size[0] for shape in urdf.shapes]),
    )


def matched_links(spheres: SphereSet, urdf: UrdfFile, name: str) -> tuple[SphereSet, tuple[str, ...]]:
    """`spheres`, called `name` in errors, by the URDF's link names, and the links that the URDF lacks.

    A link that it lacks, such as a hand not mounted, is left out.
    Where no name agrees, names are compared without their first part: a set for `panda_link1` fits `fr3_link1`.
    Raises InputError when nothing fits even so.
    """
    names = {link: link for link in urdf.links}
    asked = spheres.links
    if are_links_renamed(spheres, urdf):
        names = {_without_prefix(link): link for link in urdf.links}
        asked = tuple(_without_prefix(link) for link in asked)
    kept = [index for index, link in enumerate(asked) if link in names]
    if asked and not kept:
        raise InputError(
            f"{name}: none of its links is in {urdf.path}", remedy=f"links there: {', '.join(urdf.links)}"
        )
    matched = SphereSet(
        links=tuple(names[asked[index]] for index in kept), centers=spheres.centers[kept], radii=spheres.radii[kept]
    )
    left_out = {spheres.links[index] for index, link in enumerate(asked) if link not in names}
    return matched, tuple(sorted(left_out))


def are_links_renamed(spheres: SphereSet, urdf: UrdfFile) -> bool:
    """Whether `matched_links` compares names without their first part: the two have no name in common."""
    return not set(spheres.links) & set(urdf.links)


def _without_prefix(link: str) -> str:
    return link.partition("_")[2] or link


def lever_arms(chain: Chain, lower: Float64, upper: Float64) -> Float64:
    """(S, J) upper bounds, over every posture within lower, upper (J,), of a centre's travel per radian (or metre).

    From the sphere towards the base: about its own joint it keeps to a circle, which a ball about the circle's middle
    on the axis holds; carried by the next joint, the ball's middle keeps to a circle in turn, and the ball that holds
    it is as much larger as the middle is away from that axis. 0 where the joint does not move the sphere.
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

"""The robot in the scene: where its spheres are, and how its splats move with them."""

from dataclasses import dataclass, fields

import numpy as np

from splatctrl_cli.records import Float32, Float64


@dataclass(frozen=True, kw_only=True)
class RobotPosture:
    """Where the robot's spheres are: centers (S, 3) [m], world; radii (S,) [m]; T_world_link (S, 4, 4)."""

    centers: Float64
    radii: Float64
    T_world_link: Float64


POSTURE_NAMES = tuple(field.name for field in fields(RobotPosture))


def carried(points: Float32, before: RobotPosture, after: RobotPosture) -> Float32:
    """Points (N, 3) [m], world, moved rigidly with the link of the sphere whose surface each is nearest to.

    Between two frames the arm moves by centimetres; splats that stay behind would be removed as a trail and the arm
    re-seeded every frame. The paper does not move them.
    """
    gap = np.linalg.norm(points[:, None] - before.centers[None], axis=2) - before.radii
    sphere = np.argmin(np.abs(gap), axis=1)
    T = after.T_world_link @ np.linalg.inv(before.T_world_link)
    moved = np.einsum("nij,nj->ni", T[sphere, :3, :3], points) + T[sphere, :3, 3]
    return np.asarray(moved, np.float32)

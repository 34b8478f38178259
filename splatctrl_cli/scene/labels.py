"""Which splats are the robot's or a person's, and which only were (III-C)."""

import numpy as np

from splatctrl_cli.records import Bool, Float32, Float64, Label
from splatctrl_cli.scene.buffer import SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture


def relabel(buffer: SplatBuffer, occupancy: OccupancyMap, robot: RobotPosture | None) -> Bool:
    """Label the splats anew; returns those (M,) that were robot or human and now are objects: trails.

    Without a posture the robot's splats keep their label. A splat in the robot is the robot's, whatever a mask says.
    """
    labels = np.where(human_splats(buffer, occupancy), np.uint8(Label.HUMAN), np.uint8(Label.OBJECT))
    if robot is None:
        labels[buffer.labels == Label.ROBOT] = Label.ROBOT
    else:
        labels[robot_splats(buffer, occupancy, robot.centers, robot.radii)] = Label.ROBOT
    is_trail: Bool = (buffer.labels != Label.OBJECT) & (labels == Label.OBJECT)
    buffer.labels[:] = labels
    return is_trail


def robot_splats(buffer: SplatBuffer, occupancy: OccupancyMap, centers: Float64, radii: Float64) -> Bool:
    """Splats (M,) of the robot: those in voxels that its spheres meet, then within a margin of a sphere itself."""
    margin = occupancy.config.robot_margin
    occupancy.mark_robot(centers, radii + margin)
    is_robot = buffer.is_alive & (occupancy.entity_at(buffer.centers) & Label.ROBOT > 0)
    is_robot[is_robot] = inside_spheres(buffer.centers[is_robot], centers, radii, margin)
    return is_robot


def human_splats(buffer: SplatBuffer, occupancy: OccupancyMap) -> Bool:
    """Splats (M,) of people: those in a voxel that a masked pixel hit.

    One that is human already stays so while any of the eight nearest voxels is: the optimiser moves splats about
    their surface, and the surface is one voxel thick.
    """
    is_in = occupancy.entity_at(buffer.centers) & Label.HUMAN > 0
    was_human = buffer.is_alive & (buffer.labels == Label.HUMAN)
    is_near = was_human.copy()
    is_near[was_human] = occupancy.entity_around(buffer.centers[was_human]) & Label.HUMAN > 0
    return np.asarray(buffer.is_alive & (is_in | is_near))


def inside_spheres(points: Float32, centers: Float64, radii: Float64, margin: float) -> Bool:
    """Points (N, 3) within `margin` [m] of a sphere of (S, 3), (S,) [m]."""
    inside = np.zeros(len(points), bool)
    for center, radius in zip(centers, radii, strict=True):
        inside |= np.sum((points - center) ** 2, axis=1) <= (radius + margin) ** 2
    return inside

"""Labels of splats, and trails of the robot and people (III-C)."""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.config import OccupancyConfig, fixed
from splatctrl_cli.records import Bool, Float32, Label, RgbdFrame, UInt8
from splatctrl_cli.scene.buffer import BACKDROP, SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.self_mask import PixelKind, SelfMask, pixels_at, tolerance_at
from splatctrl_cli.voxels import SOLID

Seen = Sequence[tuple[RgbdFrame, SelfMask]]


def relabel(
    buffer: SplatBuffer, occupancy: OccupancyMap, robot: RobotPosture | None, seen: Seen = (), least: float = np.inf
) -> Bool:
    """Relabel the splats; return trails (M,): robot or human before, object now.

    Without a posture, robot splats keep their label. Robot pixels overrule human masks. A robot splat shown to be an
    object is no trail; its radius becomes at most `least` [m].
    """
    labels = np.where(human_splats(buffer, occupancy), np.uint8(Label.HUMAN), np.uint8(Label.OBJECT))
    if robot is None:
        labels[buffer.labels == Label.ROBOT] = Label.ROBOT
        is_shown = np.zeros(len(labels), bool)
    else:
        is_robot, is_shown = robot_splats(buffer, occupancy, robot, seen)
        labels[is_robot] = Label.ROBOT
    labels[buffer.labels == BACKDROP] = BACKDROP
    was_robot = buffer.labels == Label.ROBOT
    is_trail: Bool = (buffer.labels != Label.OBJECT) & (labels == Label.OBJECT) & ~(was_robot & is_shown)
    turned = np.flatnonzero(was_robot & is_shown & (labels != Label.ROBOT))
    buffer.set_radius(turned, np.minimum(buffer.radii[turned], np.float32(least)))
    buffer.labels[:] = labels
    return is_trail


def robot_splats(buffer: SplatBuffer, occupancy: OccupancyMap, robot: RobotPosture, seen: Seen) -> tuple[Bool, Bool]:
    """Splats (M,) of the robot, and those that a pixel shows to be an object.

    The pixel whose depth a splat explains best decides. Hidden splats keep their label; the robot's must be within
    `see_through` of its body. Others well inside the body become robot (in solid voxels, if all is drawn).
    """
    alive, config = buffer.is_alive, occupancy.config
    kind = shown_kinds(buffer.centers, seen, config)
    was_robot = alive & (buffer.labels == Label.ROBOT)
    is_solid = occupancy.entity_at(buffer.centers) & SOLID > 0
    is_robot = alive & (kind == PixelKind.ROBOT)
    unseen = np.flatnonzero(alive & (kind == PixelKind.NOTHING) & (was_robot | ~is_solid))
    reach = np.where(was_robot[unseen], config.see_through, -fixed.WELL_INSIDE)
    is_robot[unseen] = robot.is_within(buffer.centers[unseen], reach)
    solid = np.flatnonzero(alive & (kind == PixelKind.NOTHING) & ~was_robot & is_solid)
    is_robot[solid] = robot.holds(buffer.centers[solid], fixed.WELL_INSIDE)
    return is_robot, np.asarray(alive & (kind == PixelKind.OBJECT))


def shown_kinds(centers: Float32, seen: Seen, config: OccupancyConfig) -> UInt8:
    """`PixelKind` (N,) of the pixel with depth nearest to centers (N, 3) [m], world.

    OBJECT within `see_through`, unless nearer to the rendered robot; ROBOT within its tolerance, not behind it; else
    NOTHING.
    """
    best = np.full(len(centers), np.inf, np.float32)
    kinds = np.full(len(centers), PixelKind.NOTHING, np.uint8)
    for frame, mask in seen:
        pixel, z = pixels_at(frame, centers)
        is_inside = pixel >= 0
        kind, rendered = mask.kinds.ravel()[pixel], mask.robot_depth.ravel()[pixel]
        measured = frame.depth.ravel()[pixel]
        gap = np.abs(z - measured)
        is_hidden = (rendered > 0) & (np.abs(z - rendered) < gap)
        is_object = (kind == PixelKind.OBJECT) & (gap <= config.see_through) & ~is_hidden
        is_robot = (kind == PixelKind.ROBOT) & (gap <= tolerance_at(measured, config))
        is_told = is_inside & (is_object | is_robot) & (gap < best)
        best[is_told], kinds[is_told] = gap[is_told], kind[is_told]
    return kinds


def human_splats(buffer: SplatBuffer, occupancy: OccupancyMap) -> Bool:
    """Splats (M,) in voxels that human pixels hit.

    They stay human while one of the eight nearest voxels is.
    """
    is_in = occupancy.entity_at(buffer.centers) & Label.HUMAN > 0
    was_human = buffer.is_alive & (buffer.labels == Label.HUMAN)
    is_near = was_human.copy()
    is_near[was_human] = occupancy.entity_around(buffer.centers[was_human]) & Label.HUMAN > 0
    return np.asarray(buffer.is_alive & (is_in | is_near))

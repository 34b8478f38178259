"""Labels of splats, trails of the robot and people (III-C), and objects near the robot.

Objects near the robot are seen worst, and their distances matter most.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatctrl_cli.config import OccupancyConfig, SceneConfig, fixed
from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Bool, Float32, Index, Label, RgbdFrame, SplatSet, UInt8
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.surface import RobotSurface
from splatctrl_cli.scene.buffer import BACKDROP, Seeds, SplatBuffer
from splatctrl_cli.scene.occupancy import OccupancyMap
from splatctrl_cli.scene.posture import RobotPosture
from splatctrl_cli.scene.seeding import Each, gap_seeds, world_points
from splatctrl_cli.scene.self_mask import (
    PixelKind,
    SelfMask,
    farthest_within,
    find_outline,
    grow_box,
    nearest_within,
    pixels_at,
    pixels_of,
    tolerance_at,
)
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

    The pixel with depth nearest to the splat decides. Hidden splats keep their label; robot splats only within
    `see_through` of the body. Other hidden splats well inside the body become robot (in solid voxels, only if all is
    drawn).
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

    OBJECT: its depth is within `see_through`, and the rendered robot is no nearer. ROBOT: its depth is within
    tolerance. NOTHING: neither.
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

    Human splats stay human while one of the eight nearest voxels is.
    """
    is_in = occupancy.entity_at(buffer.centers) & Label.HUMAN > 0
    was_human = buffer.is_alive & (buffer.labels == Label.HUMAN)
    is_near = was_human.copy()
    is_near[was_human] = occupancy.entity_around(buffer.centers[was_human]) & Label.HUMAN > 0
    return np.asarray(buffer.is_alive & (is_in | is_near))


def contact_pixels(frame: RgbdFrame, mask: SelfMask, robot: RobotPosture) -> Bool:
    """Pixels (H, W) of objects within `CONTACT_REACH` of moving links."""
    chosen, outline = np.zeros(mask.kinds.shape, bool), find_outline(mask.robot_depth > 0)
    if outline is None:
        return chosen
    reach = pixels_of(fixed.CONTACT_REACH, frame, mask.robot_depth)
    box = grow_box(outline, reach, chosen.shape)
    shown, depth, is_near = mask.robot_depth[box], frame.depth[box], mask.kinds[box] == PixelKind.OBJECT
    is_near &= depth > nearest_within(shown, shown > 0, reach) - fixed.CONTACT_REACH  # a quick superset
    chosen[box] = is_near & (depth < farthest_within(shown, reach) + fixed.CONTACT_REACH + fixed.CONTACT_THICKNESS)
    chosen[chosen] = robot.is_within(world_points(frame, chosen), fixed.CONTACT_REACH, to_moving=True)
    return chosen


def count_carried(
    declared: Declarations, frame: RgbdFrame, mask: SelfMask, robot: RobotPosture, bare: RobotSurface, time_s: float
) -> None:
    """Count declared boxes that explain robot pixels which the `bare` surface does not explain.

    bare: surface without carried boxes; time_s: since the first joint state.
    """
    surface, T_world_link = robot.seen_at(frame.stamp_ns)
    poses = dict(zip(surface.links, T_world_link, strict=True))
    points = world_points(frame, mask.kinds == PixelKind.ROBOT)
    is_own = bare.distance(bare.poses(poses), points) < fixed.CONTACT_REACH / 2
    for link in dict.fromkeys(link for link, _ in declared.carried_at(time_s)):
        declared.is_carried(link, transform_points(invert_transform(poses[link]), points[~is_own]), time_s)


def contact_seeds(
    seen: Seen,
    mappable: Sequence[Bool],
    robot: RobotPosture,
    objects: SplatSet,
    config: SceneConfig,
    *,
    num_threads: int = 1,
    each: Each = map,
) -> Seeds:
    """Seeds on objects near the robot where no splat's centre is within `contact_radius`.

    Their radius is half of `contact_radius`: larger splats protrude from a plane. mappable: pixels (H, W) of each
    frame.
    """
    radius = config.contact_radius
    near_robot = each(lambda one, pixels: contact_pixels(one[0], one[1], robot) & pixels, seen, mappable)
    seeds = gap_seeds(
        [(frame, pixels) for (frame, _), pixels in zip(seen, near_robot, strict=True)],
        np.zeros((0, 3), np.float32),
        radius,
        replace(objects, radii=np.full(len(objects), radius, np.float32)),
        replace(config, max_gap=0.0, max_radius=radius, radius_per_edge=1.0),
        stride=1,
        num_threads=num_threads,
        each=each,
    )
    return replace(seeds, radii=0.5 * seeds.radii)


def lasts_at_fixed_links(
    robot: RobotPosture,
    frames: Sequence[RgbdFrame],
    lasting: Sequence[Bool],
    config: OccupancyConfig,
    points: Float32,
) -> Bool:
    """True for points (K, 3) [m], world, away from fixed links or on `lasting` pixels (H, W)."""
    distance = robot.distance(points)
    is_kept = (distance > fixed.ROBOT_REACH) | (distance >= robot.distance(points, to_moving=True))
    for frame, pixels in zip(frames, lasting, strict=True):
        pixel, z = pixels_at(frame, points)
        depth = frame.depth.ravel()[pixel]
        is_kept |= (pixel >= 0) & pixels.ravel()[pixel] & (np.abs(z - depth) <= tolerance_at(depth, config))
    return np.asarray(is_kept)


def hidden_objects(
    buffer: SplatBuffer,
    robot: RobotPosture | None,
    seen: Seen,
    config: OccupancyConfig,
    reach: float = fixed.ROBOT_REACH,
) -> Index:
    """Slots (K,) of objects within `reach` [m] of the robot or base that no pixel shows.

    Fitting would pull their splats out of the object.
    """
    if robot is None:
        return np.zeros(0, np.intp)
    slots = np.flatnonzero(buffer.is_alive & (buffer.labels != Label.ROBOT))
    slots = slots[robot.is_within(buffer.centers[slots], reach)]
    return np.asarray(slots[shown_kinds(buffer.centers[slots], seen, config) != PixelKind.OBJECT], np.intp)
